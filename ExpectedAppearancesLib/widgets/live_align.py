"""The section for true poses: handles, sliders and landmarks over a frozen frame, and how far the prediction is off."""

from __future__ import annotations

import numpy as np
import slicer
from slicer.i18n import tr as _

from ..errors import InputError
from ..mrml.live_align import add_landmark_lists
from ..mrml.live_controller import LiveController
from ..mrml.scene import remove_node
from .refreshing import quiet, set_text

SLIDERS = ("shiftX", "shiftY", "shiftZ", "turnX", "turnY", "turnZ")


class AlignSection:
    """say: shows a text to the user."""

    def __init__(self, ui, controller: LiveController, say):
        self._ui, self._controller, self._say = ui, controller, say
        self._start: np.ndarray | None = None
        self._lists: tuple | None = None
        self._sliders = [getattr(ui, f"{name}Slider") for name in SLIDERS]
        self._moving_sliders = False
        self._aligning: bool | None = None
        self._difference: tuple | None = None
        ui.alignButton.connect("toggled(bool)", self._on_align)
        for slider in self._sliders:
            slider.connect("valueChanged(double)", self._on_slider)
            slider.enabled = False
        ui.frameLandmarkButton.connect("clicked(bool)", lambda _checked=False: self._pick(0))
        ui.meshLandmarkButton.connect("clicked(bool)", lambda _checked=False: self._pick(1))
        ui.clearLandmarksButton.connect("clicked(bool)", lambda _checked=False: self._clear())
        ui.solveButton.connect("clicked(bool)", lambda _checked=False: self._solve())
        ui.saveTruthButton.connect("clicked(bool)", lambda _checked=False: self._save())

    def show(self, can_align: bool) -> None:
        """Called on every tick: follow the handles, count the landmarks, compare the poses."""
        ui, aligning = self._ui, self._controller.alignment is not None
        if ui.alignButton.checked != aligning:
            with quiet(ui.alignButton):
                ui.alignButton.checked = aligning
        if not aligning and self._start is not None:
            self._end()
        ui.alignButton.enabled = can_align or aligning
        if self._aligning is not aligning:
            self._aligning = aligning
            ui.alignButton.text = _("Keep this pose") if aligning else _("Align the vessels to this frame")
            for widget in (*self._sliders, ui.frameLandmarkButton, ui.meshLandmarkButton, ui.clearLandmarksButton):
                widget.enabled = aligning
        if aligning:
            self._follow_handles()
            self._show_landmarks()
        self._show_difference()

    def close(self) -> None:
        """The alignment is over, or its scene is gone."""
        self._end()

    def _on_align(self, checked: bool) -> None:
        try:
            if checked:
                self._start = self._controller.begin_alignment().camera_from_world
                self._lists = add_landmark_lists(self._controller.live)
            else:
                self._controller.finish_alignment(keep=True)
                self._end()
        except InputError as error:
            self._say(str(error))

    def _on_slider(self, _value: float) -> None:
        if self._moving_sliders or self._start is None or self._controller.alignment is None:
            return
        values = np.array([slider.value for slider in self._sliders])
        self._controller.nudge(values[:3], values[3:], self._start)

    def _follow_handles(self) -> None:
        """Sliders show where the handles are; only far enough apart that no rounding goes back and forth."""
        if self._start is None:
            return
        wanted = np.concatenate(self._controller.nudges(self._start))
        if any(abs(value) > slider.maximum for slider, value in zip(self._sliders, wanted)):
            # Landmarks and handles go farther than sliders, which begin anew there: the next touch must not go back.
            self._start = self._controller.alignment.camera_from_world
            wanted = np.zeros(6)
        if np.abs(wanted - [slider.value for slider in self._sliders]).max() < 0.06:
            return
        self._moving_sliders = True
        for slider, value in zip(self._sliders, wanted):
            slider.value = float(value)
        self._moving_sliders = False

    def _pick(self, which: int) -> None:
        """Let the next clicks place landmarks into one of the lists."""
        if self._lists is None:
            return
        selection = slicer.app.applicationLogic().GetSelectionNode()
        selection.SetReferenceActivePlaceNodeClassName("vtkMRMLMarkupsFiducialNode")
        selection.SetActivePlaceNodeID(self._lists[which].GetID())
        interaction = slicer.app.applicationLogic().GetInteractionNode()
        interaction.SetPlaceModePersistence(0)
        interaction.SetCurrentInteractionMode(interaction.Place)

    def _clear(self) -> None:
        for node in self._lists or ():
            node.RemoveAllControlPoints()

    def _show_landmarks(self) -> None:
        counts = [node.GetNumberOfControlPoints() for node in self._lists or ()] or [0, 0]
        pairs = min(counts)
        self._ui.solveButton.enabled = pairs >= 4 and counts[0] == counts[1]
        text = _("{frame} in the frame, {mesh} on the vessels; at least 4 of each are needed, in the same order.")
        set_text(self._ui.landmarksLabel, text.format(frame=counts[0], mesh=counts[1]))

    def _solve(self) -> None:
        try:
            rms_px = self._controller.align_to_landmarks(*self._lists)
            text = _("Aligned by landmarks; they are {rms} px off on average (RMS).")
            self._say(text.format(rms=f"{rms_px:.2f}"), done=True)
        except InputError as error:
            self._say(str(error))

    def _show_difference(self) -> None:
        key = (id(self._controller.truth), id(self._controller.result))
        if key == self._difference:
            return
        self._difference = key
        self._ui.saveTruthButton.enabled = self._controller.truth is not None
        difference = self._controller.difference()
        if difference is None:
            set_text(self._ui.differenceLabel, "")
            return
        text = _(
            "Predicted (blue) from true (green): ADD {add} mm, reprojection {px} px, rotation {deg}°, shift {mm} mm"
        )
        set_text(
            self._ui.differenceLabel,
            text.format(
                add=f"{difference.add_mm:.2f}",
                px=f"{difference.reprojection_px:.1f}",
                deg=f"{difference.rotation_deg:.2f}",
                mm=f"{difference.translation_mm:.2f}",
            ),
        )

    def _save(self) -> None:
        folder = self._ui.truthPathLineEdit.currentPath
        if not folder:
            self._say(_("Choose a folder for the true poses."))
            return
        try:
            path = self._controller.save_truth(folder)
            self._say(_("Saved to {path}.").format(path=path), done=True)
        except InputError as error:
            self._say(str(error))

    def _stop_picking(self) -> None:
        """With its list gone, the next click would put a point into a new one."""
        logic = slicer.app.applicationLogic()
        picked_into = logic.GetSelectionNode().GetActivePlaceNodeID()
        if picked_into in [node.GetID() for node in self._lists]:
            interaction = logic.GetInteractionNode()
            interaction.SetCurrentInteractionMode(interaction.ViewTransform)

    def _end(self) -> None:
        if self._lists:
            self._stop_picking()
        for node in self._lists or ():
            if node.GetScene() is not None:
                remove_node(node.GetScene(), node)
        self._lists = self._start = None
        self._moving_sliders = True
        for slider in self._sliders:
            slider.value = 0.0
        self._moving_sliders = False
        set_text(self._ui.landmarksLabel, _("No landmarks yet; 4 pairs are needed."))
        self._ui.solveButton.enabled = False
