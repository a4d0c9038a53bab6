"""A look through one of the sampled cameras: its label map in a slice view, drawn by a process of its own."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from slicer.i18n import tr as _

from ..errors import InputError
from ..masks import asked
from ..mrml import planning
from .planning_qt import Asking, Stepper
from .refreshing import set_text

PREVIEW_HEIGHT_PX = 320  # a label map of this size is drawn in some 30 ms without a graphics card
SLICE = "Red"


class Looking:
    """Asks for label maps and shows those that come; what the slice view showed before returns at the end."""

    def __init__(self, panel):
        self.panel = panel
        self._asking = Asking("label maps", self._on_answer)
        self._showing = Stepper()
        self._wanted: tuple | None = None  # sampler, pose, number of poses, cortex: asked for
        self._views: dict[int, tuple] = {}  # number of a question -> sampler, camera, pose, caption
        self._meshes: tuple = (None, None, None)  # vessels, cortex, their folder
        self._folder: tempfile.TemporaryDirectory | None = None
        self._seen: dict = {}
        self._slice_before: _SliceBefore | None = None

    def refresh(self, parameters, sampler) -> None:
        """Show what the chosen camera sees; with None for either, no longer."""
        session = self.panel.session
        try:
            meshes = tuple(session.mesh(parameters, name) for name in ("vessels", "cortex")) if parameters else ()
        except InputError:
            sampler = None
        if parameters is None or sampler is None:
            self._leave_off()
            return
        wanted = (sampler, parameters.poseIndex, parameters.poseCount, meshes[1])
        if wanted == self._wanted:
            return
        self._wanted = wanted
        try:
            pose = sampler.sample(parameters.poseIndex)
        except InputError as error:
            self._say(str(error))
            return
        camera = sampler.camera
        scale = min(1.0, PREVIEW_HEIGHT_PX / camera.height)
        camera = camera.resized(round(camera.width * scale), round(camera.height * scale))
        tilt, distance_mm = planning.view_direction(pose, sampler.craniotomy)
        caption = _("Camera {number} of {count}: tilt {tilt:.0f}°, {distance:.0f} mm away").format(
            number=parameters.poseIndex + 1, count=parameters.poseCount, tilt=tilt, distance=distance_mm
        )
        if not self._seen:
            self._say(_("What the camera sees is being drawn."))
        try:
            folder = self._folder_of(*meshes)
        except OSError as error:  # the disk is full
            self._say(str(error))
            return
        number = max(self._views, default=0) + 1
        self._views[number] = (sampler, camera, pose, caption)
        question = asked.question(folder, camera, sampler.craniotomy.outward_axis, pose)
        self._asking.ask(question | {"number": number})

    def stop(self) -> None:
        """At once, as before the scene is closed: nothing is shown, no process is left."""
        self._asking.stop()
        self._leave_off()
        self._showing.finish()
        if self._folder is not None:
            self._folder.cleanup()
            self._folder, self._meshes = None, (None, None, None)

    def _folder_of(self, vessels, cortex) -> Path:
        """Where the process finds the meshes, which compare by identity."""
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="expected-appearances-")
        if self._meshes[0] is not vessels or self._meshes[1] is not cortex:
            old, folder = self._meshes[2], Path(tempfile.mkdtemp(dir=self._folder.name))
            asked.write_meshes(folder, vessels, cortex)
            self._meshes = (vessels, cortex, folder)
            if old is not None:
                shutil.rmtree(old, ignore_errors=True)
        return self._meshes[2]

    def _on_answer(self, question: dict, answer: dict) -> None:
        number = question["number"]
        view = self._views.get(number)
        self._views = {later: kept for later, kept in self._views.items() if later > number}
        # While the slider moves, each camera that has been drawn is shown; one of other ranges or models never.
        if view is None or self._wanted is None or view[0] is not self._wanted[0]:
            return
        if "answer" in answer:
            self._showing.start(self._show(asked.label_map(answer["answer"]), *view))
        else:
            self._say(answer.get("problem") or answer["failed"])

    def _show(self, labels: np.ndarray, sampler, camera, pose: np.ndarray, caption: str) -> Iterator[None]:
        scene, space = self.panel.scene, self.panel.session.space(self.panel.parameters)
        plane_mm = planning.plane_through(sampler.craniotomy.centre_world_mm, pose)
        volume = planning.show_mask(scene, self._seen, labels, camera, pose, plane_mm, space)
        yield
        lines = planning.frustum_polydata(camera, pose[None], np.array([plane_mm]), space)
        self._seen["camera"] = planning.line_model(
            scene, self._seen.get("camera"), planning.LOOKED_THROUGH, lines, planning.LOOKED_THROUGH_COLOUR, 2.0
        )
        yield
        yield from self._show_slice(volume, camera, pose, plane_mm, space)
        self._say(caption)

    def _show_slice(self, volume, camera, pose, plane_mm: float, space: str) -> Iterator[None]:
        scene = self.panel.scene
        slice_node = scene.GetNodeByID(f"vtkMRMLSliceNode{SLICE}")
        composite = scene.GetNodeByID(f"vtkMRMLSliceCompositeNode{SLICE}")
        if slice_node is None or composite is None:
            return
        if self._slice_before is None:
            self._slice_before = _SliceBefore(slice_node, composite)
        self._slice_before.notice(composite)
        planning.look_at_mask(slice_node, camera, pose, plane_mm, space)
        yield
        modifying = composite.StartModify()
        composite.SetBackgroundVolumeID(None)
        composite.SetForegroundVolumeID(None)
        composite.SetLabelVolumeID(volume.GetID())
        composite.SetLabelOpacity(1.0)
        composite.EndModify(modifying)

    def _leave_off(self) -> None:
        """Nothing is to be seen any more; it is taken away a piece at a time."""
        if self._wanted is None:
            return
        self._wanted, self._views = None, {}
        self._asking.forget()
        self._showing.start(self._take_away())

    def _take_away(self) -> Iterator[None]:
        self._say("")
        if self._slice_before is not None:
            before, self._slice_before = self._slice_before, None
            before.restore(self.panel.scene)
            yield
        while self._seen:
            planning.remove_nodes(self.panel.scene, dict([self._seen.popitem()]))
            yield

    def _say(self, text: str) -> None:
        set_text(self.panel.ui.lookCaption, text)


class _SliceBefore:
    """What a slice view showed, to show it again."""

    def __init__(self, slice_node, composite):
        self._slice_id, self._composite_id = slice_node.GetID(), composite.GetID()
        self._to_ras = [slice_node.GetSliceToRAS().GetElement(i, j) for i in range(4) for j in range(4)]
        self._field_of_view = tuple(slice_node.GetFieldOfView())
        self._volumes = (
            composite.GetBackgroundVolumeID(),
            composite.GetForegroundVolumeID(),
            composite.GetLabelVolumeID(),
            composite.GetLabelOpacity(),
        )

    def notice(self, composite) -> None:
        """What was put behind the label map meanwhile, such as the MRI of a case that was opened, stays afterwards."""
        shown = composite.GetBackgroundVolumeID(), composite.GetForegroundVolumeID()
        if any(shown):
            self._volumes = (*shown, *self._volumes[2:])

    def restore(self, scene) -> None:
        slice_node, composite = scene.GetNodeByID(self._slice_id), scene.GetNodeByID(self._composite_id)
        if slice_node is None or composite is None:
            return
        self.notice(composite)
        slice_node.GetSliceToRAS().DeepCopy(self._to_ras)
        slice_node.UpdateMatrices()
        slice_node.SetFieldOfView(*self._field_of_view)
        background, foreground, label, opacity = self._volumes
        composite.SetBackgroundVolumeID(background)
        composite.SetForegroundVolumeID(foreground)
        composite.SetLabelVolumeID(label)
        composite.SetLabelOpacity(opacity)
