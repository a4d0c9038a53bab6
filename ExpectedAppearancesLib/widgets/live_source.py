"""The section that chooses a case and where its frames come from."""

from __future__ import annotations

from ..live.choice import Choice, SourceKind, problems_of
from ..live.frames import FrameSettings
from .refreshing import quiet

KINDS = (SourceKind.PATH, SourceKind.DEVICE, SourceKind.NODE)


class SourceSection:
    """parameters: callable that gives the parameter node, or None. changed: called after the user changed something."""

    def __init__(self, ui, parameters, changed):
        self._ui, self._parameters, self._changed = ui, parameters, changed
        self._paths = {"casePath": ui.casePathLineEdit, "sourcePath": ui.sourcePathLineEdit}
        self._paths["cameraPath"] = ui.cameraPathLineEdit
        for name, edit in self._paths.items():
            # Its own signal is not sent for a path that is emptied, nor for another kind of file than it asks for.
            text = edit.findChild("QLineEdit")
            text.connect("textChanged(QString)", lambda path, n=name: self._on_path(n, path))
        # Slicer's own binding allows one class of node only, and no abstract one.
        ui.sourceNodeComboBox.connect("currentNodeChanged(vtkMRMLNode*)", self._on_node)
        ui.kindComboBox.connect("currentIndexChanged(int)", self._on_kind)

    def choice(self) -> Choice:
        p = self._parameters()
        return Choice(
            case_path=p.casePath,
            kind=SourceKind(p.sourceKind),
            path=p.sourcePath,
            device=p.device,
            node_name=p.sourceNode.GetID() if p.sourceNode is not None else "",
            camera_path=p.cameraPath,
            repeat=p.repeat,
            only_new=p.onlyNew,
            rate_hz=p.rateHz,
            stale_s=p.staleMs / 1000,
            steady=p.steady,
            frames=FrameSettings(p.flipRows, p.cropBorders, p.longestPx),
        )

    def problem(self) -> str:
        """Why nothing can be started, or ''."""
        return "\n".join(problems_of(self.choice())) if self._parameters() is not None else ""

    def refresh(self, running: bool) -> None:
        """From the parameter node to the widgets that Slicer does not bind itself."""
        p, ui = self._parameters(), self._ui
        if p is None:
            return
        for name, edit in self._paths.items():
            if edit.currentPath != getattr(p, name):
                edit.currentPath = getattr(p, name)
        if ui.sourceNodeComboBox.currentNode() is not p.sourceNode:
            ui.sourceNodeComboBox.setCurrentNode(p.sourceNode)
        kind = SourceKind(p.sourceKind)
        if ui.kindComboBox.currentIndex != KINDS.index(kind):
            with quiet(ui.kindComboBox):
                ui.kindComboBox.currentIndex = KINDS.index(kind)
        for shown, widgets in (
            (kind is SourceKind.PATH, (ui.pathLabel, ui.sourcePathLineEdit)),
            (kind is SourceKind.DEVICE, (ui.deviceLabel, ui.deviceLineEdit)),
            (kind is SourceKind.NODE, (ui.nodeLabel, ui.sourceNodeComboBox)),
        ):
            for widget in widgets:
                widget.visible = shown
        for widget in (ui.casePathLineEdit, ui.kindComboBox, ui.sourcePathLineEdit, ui.deviceLineEdit):
            widget.enabled = not running
        ui.sourceNodeComboBox.enabled = ui.moreCollapsibleButton.enabled = not running

    def _on_path(self, name: str, path: str) -> None:
        p = self._parameters()
        if p is not None and getattr(p, name) != path:
            setattr(p, name, path)
            self._changed()

    def _on_node(self, node) -> None:
        p = self._parameters()
        if not self._ui.sourceNodeComboBox.enabled:  # it runs: where its volume left the scene Slicer takes any other
            return
        if p is not None and p.sourceNode is not node:
            p.sourceNode = node
            self._changed()

    def _on_kind(self, index: int) -> None:
        p = self._parameters()
        if p is not None and p.sourceKind != KINDS[index].value:
            p.sourceKind = KINDS[index].value
            self._changed()
