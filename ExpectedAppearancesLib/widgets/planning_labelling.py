"""A photograph on its way to being a texture: vessels proposed, corrected in the Segment Editor, saved."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import slicer
from slicer.i18n import tr as _

from .. import files
from ..errors import InputError
from ..masks.labels import PARENCHYMA
from ..mrml import labelling
from ..mrml.planning import remove_nodes
from ..textures.photograph import IMAGE, LABELS
from .planning_qt import Child, allow, library_command, problems_in

PHOTOGRAPH_MODULE = "ExpectedAppearancesLib.textures.photograph"


class Labelling:
    """One photograph at a time. Its nodes are the user's to draw on, and are removed when it is saved or discarded."""

    def __init__(self, panel):
        self.panel, self.ui = panel, panel.ui
        self.nodes: dict = {}
        self._name, self._image = "", None
        self._textures = Path()  # where it will be kept
        self._child: Child | None = None
        self._saving = False
        self._folder: tempfile.TemporaryDirectory | None = None
        ui = self.ui
        ui.editLabelsButton.connect("clicked(bool)", lambda _checked=False: self.edit())
        ui.useLabelsButton.connect("clicked(bool)", lambda _checked=False: self.save())
        ui.dropLabelsButton.connect("clicked(bool)", lambda _checked=False: self.finish())

    @property
    def reason(self) -> str:
        """Why no other photograph can be added now."""
        return _("Save or discard the photograph that is being labelled first.") if self._name else ""

    def refresh(self) -> None:
        ui = self.ui
        ui.labellingFrame.visible = bool(self._name)
        waiting = _("The vessels are being proposed.") if self._child else ""
        waiting = _("The photograph is being saved.") if self._saving else waiting
        allow(ui.editLabelsButton, waiting, _("Correct the proposed vessels in the Segment Editor."))
        allow(ui.useLabelsButton, waiting, _("Add photograph and labels to the textures."))
        allow(ui.dropLabelsButton, "", _("Forget the photograph."))
        ui.labellingHint.text = waiting or _(
            "{name}: correct the proposed vessels in the Segment Editor, then come back and save."
        ).format(name=self._name)

    def start(self, name: str, photograph: Path, textures: Path) -> None:
        """Read it and propose labels in a process of its own, then open the Segment Editor on them.

        textures: folder that it is added to, in which no other texture has this name.
        """
        self.stop()
        self._name, self._textures = name, textures
        self._folder = tempfile.TemporaryDirectory(prefix="expected-appearances-")
        command, environment = library_command(PHOTOGRAPH_MODULE, "read", str(photograph), self._folder.name)
        self._child = Child(command, self._proposed, environment)
        self.panel.refresh_soon()

    def _proposed(self, code: int, output: str) -> None:
        self._child = None
        folder = Path(self._folder.name)
        if not (folder / IMAGE).is_file():
            slicer.util.errorDisplay("\n\n".join(problems_in(output)), windowTitle=_("Photograph"))
            self.stop()
            return
        self._image = np.load(folder / IMAGE, allow_pickle=False)
        if code == 0:
            labels = np.load(folder / LABELS, allow_pickle=False)
        else:
            labels = np.full(self._image.shape[:2], PARENCHYMA, np.uint8)
            slicer.util.warningDisplay(
                _("No vessels could be proposed ({reason}). Draw them yourself.").format(reason=problems_in(output)[-1])
            )
        self.nodes = labelling.add_photograph(self.panel.scene, self._name, self._image, labels)
        self.edit()
        self.panel.refresh_soon()

    def edit(self) -> None:
        """Open the Segment Editor on the photograph."""
        if slicer.util.mainWindow() is None:
            return
        slicer.util.selectModule("SegmentEditor")
        editor = slicer.modules.segmenteditor.widgetRepresentation().self().editor
        editor.setSegmentationNode(self.nodes["segmentation"])
        set_source = getattr(editor, "setSourceVolumeNode", None) or editor.setMasterVolumeNode
        set_source(self.nodes["grey"])
        slicer.util.setSliceViewerLayers(background=self.nodes["colour"], foreground=None, label=None, fit=True)

    def save(self) -> None:
        """Write NAME.png and NAME.labels.png into their folder in a process of its own, or say why not."""
        path = Path(self._folder.name) / LABELS
        try:
            with files.writing(path):
                np.save(path, labelling.labels_of(self.nodes))
        except InputError as error:
            slicer.util.errorDisplay(str(error), windowTitle=_("Not saved yet"))
            return
        kept = (self._folder.name, str(self._textures), self._name)
        command, environment = library_command(PHOTOGRAPH_MODULE, "keep", *kept)
        self._child, self._saving = Child(command, self._saved, environment), True
        self.panel.refresh_soon()

    def _saved(self, code: int, output: str) -> None:
        self._child, self._saving = None, False
        if code == 0:
            self.finish()
        else:
            slicer.util.errorDisplay("\n\n".join(problems_in(output)), windowTitle=_("Not saved yet"))
        self.panel.refresh_soon()

    def finish(self) -> None:
        """`stop`, and turn the slice views from where the photograph was to the scan, which would be seen as a blur."""
        seen = bool(self.nodes)
        self.stop()
        if seen:
            self.panel.sections["case"].show_scan()

    def stop(self) -> None:
        """Forget the photograph and take its nodes out of the scene."""
        if self._child:
            self._child.stop()
            self._child = None
        remove_nodes(self.panel.scene, self.nodes)
        if self._folder:
            self._folder.cleanup()
            self._folder = None
        self._name, self._image, self._saving = "", None, False
        self.panel.refresh_soon()
