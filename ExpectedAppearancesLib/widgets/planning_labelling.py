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
from ..textures.library import LABELS_SUFFIX, check_texture
from .planning_qt import Child, allow, library_command

PROPOSAL_MODULE = "ExpectedAppearancesLib.textures.proposal"


class Labelling:
    """One photograph at a time. Its nodes are the user's to draw on, and are removed when it is saved or discarded."""

    def __init__(self, panel):
        self.panel, self.ui = panel, panel.ui
        self.nodes: dict = {}
        self._name, self._image = "", None
        self._child: Child | None = None
        self._folder: tempfile.TemporaryDirectory | None = None
        ui = self.ui
        ui.editLabelsButton.connect("clicked(bool)", lambda _checked=False: self.edit())
        ui.useLabelsButton.connect("clicked(bool)", lambda _checked=False: self.save())
        ui.dropLabelsButton.connect("clicked(bool)", lambda _checked=False: self.stop())

    @property
    def reason(self) -> str:
        """Why no other photograph can be added now."""
        return _("Save or discard the photograph that is being labelled first.") if self._name else ""

    def refresh(self) -> None:
        ui = self.ui
        ui.labellingFrame.visible = bool(self._name)
        waiting = _("The vessels are being proposed.") if self._child else ""
        allow(ui.editLabelsButton, waiting, _("Correct the proposed vessels in the Segment Editor."))
        allow(ui.useLabelsButton, waiting, _("Add photograph and labels to the textures."))
        allow(ui.dropLabelsButton, "", _("Forget the photograph."))
        ui.labellingHint.text = waiting or _(
            "{name}: correct the proposed vessels in the Segment Editor, then come back and save."
        ).format(name=self._name)

    def start(self, name: str, image_rgb: np.ndarray) -> None:
        """Propose labels in a process of its own, and open the Segment Editor on them."""
        self.stop()
        self._name, self._image = name, image_rgb
        self._folder = tempfile.TemporaryDirectory(prefix="expected-appearances-")
        photograph, labels = (Path(self._folder.name) / n for n in ("photograph.png", "labels.png"))
        files.write_png(photograph, image_rgb)
        command, environment = library_command(PROPOSAL_MODULE, str(photograph), str(labels))
        self._child = Child(command, lambda code, output: self._proposed(code, output, labels), environment)
        self.panel.refresh_soon()

    def _proposed(self, code: int, output: str, path: Path) -> None:
        self._child = None
        labels = np.full(self._image.shape[:2], PARENCHYMA, np.uint8)
        try:
            if code == 0:
                labels = files.read_label_map(path)
            else:
                words = output.strip().splitlines()[-1:] or [""]
                slicer.util.warningDisplay(
                    _("No vessels could be proposed ({reason}). Draw them yourself.").format(reason=words[0])
                )
        except InputError as error:
            slicer.util.warningDisplay(str(error))
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
        """Write NAME.png and NAME.labels.png into the textures folder, or say why not."""
        labels = labelling.labels_of(self.nodes)
        folder = self.panel.session.textures_folder(self.panel.parameters)
        image_path, labels_path = folder / f"{self._name}.png", folder / f"{self._name}{LABELS_SUFFIX}"
        problems = check_texture(image_path, self._image, labels_path, labels)
        if problems:
            slicer.util.errorDisplay("\n\n".join(problems), windowTitle=_("Not saved yet"))
            return
        try:
            # Labels first: a photograph without labels would make the whole folder unusable.
            files.write_png(labels_path, labels)
            files.write_png(image_path, self._image)
        except InputError as error:
            slicer.util.errorDisplay(str(error))
            return
        self.stop()

    def stop(self) -> None:
        """Forget the photograph and take its nodes out of the scene."""
        if self._child:
            self._child.stop()
            self._child = None
        remove_nodes(self.panel.scene, self.nodes)
        if self._folder:
            self._folder.cleanup()
            self._folder = None
        self._name, self._image = "", None
        self.panel.refresh_soon()
