"""Section Craniotomy and poses: where the microscope may look from, seen in 3D and through any of its cameras."""

from __future__ import annotations

import numpy as np
import slicer
from slicer.i18n import tr as _

from ..errors import InputError
from ..mrml import planning
from ..poses.craniotomy import disc_under_vessels
from .planning_qt import Stepper, allow, quiet, single_shot
from .planning_run import RunControls, in_the_way, started
from .planning_section import NodeWatch, Section, changed

SHOWN_CAMERAS = 40
PREVIEW_HEIGHT_PX = 320  # a label map of this size is drawn in some 30 ms without a graphics card
SLICE = "Red"


class PosesSection(Section):
    name = "poses"
    title = "Craniotomy and poses"

    def setup(self) -> None:
        ui = self.ui
        self._stepper = Stepper()
        self._look_timer = single_shot(20, self._look)
        self._cameras: dict = {}
        self._seen: dict = {}
        self._drawn = self._looked = None  # what the cameras and the label map show
        self._renderer = None  # (meshes, camera), MaskRenderer
        self._slice_before = None
        self._watch = NodeWatch(self.panel.refresh_soon)
        self.controls = RunControls(
            self.panel.runs["render"],
            ui.renderButton,
            ui.renderCancelButton,
            ui.renderProgress,
            ui.renderLine,
            _("Draw the label map of every pose: what each camera would see of vessels and cortex."),
        )
        ui.craniotomySelector.connect("currentNodeChanged(vtkMRMLNode*)", self.on_node)
        ui.placePointButton.connect("clicked(bool)", lambda _checked=False: self.on_place())
        ui.renderButton.connect("clicked(bool)", lambda _checked=False: self.on_render())
        ui.renderCancelButton.connect("clicked(bool)", lambda _checked=False: self.controls.watch.cancel())

    def refresh(self) -> None:
        p, ui = self.parameters, self.ui
        marked = p.craniotomySource.value == "marked"
        ui.craniotomyRow.visible = marked
        with quiet(ui.craniotomySelector):
            ui.craniotomySelector.setCurrentNode(p.craniotomyNode)
        node = p.craniotomyNode if marked else None
        self._watch.watch(node, *((node.PointModifiedEvent, node.PointRemovedEvent) if node else ()))
        for box in (ui.nearestSlider, ui.farthestSlider):
            allow(box, _("Taken from the field of view; untick to set it.") if p.distanceAuto else "", "")
        reason = _("A quarter of the vessels' radius; untick to set it.") if p.lateralAuto else ""
        allow(ui.lateralSlider, reason, _("Largest distance of the point looked at from the craniotomy's centre."))
        with quiet(ui.poseSlider):
            ui.poseSlider.maximum = max(p.poseCount - 1, 0)
        changed(p, "poseIndex", min(p.poseIndex, p.poseCount - 1))
        try:
            sampler = self.session.sampler(p)
            problem = ""
        except InputError as error:
            sampler, problem = None, str(error)
        if sampler is not None and self.panel.help.reason("planning"):
            sampler, problem = None, self.panel.help.reason("planning")
        self._show_automatic(p, sampler)
        allow(ui.showCamerasCheck, problem, _("Draw the sampled cameras in the 3D view."))
        allow(ui.lookThroughCheck, problem, _("Show in the Red slice view what the camera would see."))
        allow(ui.poseSlider, problem or ("" if p.lookThrough else _("Tick the box to look through a camera.")), "")
        self._refresh_cameras(p, sampler)
        self._look_timer.start()
        blocked = problem
        if self.session.case(p) is None:
            blocked = self.step.text
        elif self.panel.steps["case"].state.value == "stale":
            blocked = _("Save the case first: {reason}").format(reason=self.panel.steps["case"].text)
        blocked = in_the_way(self.panel, "render") or blocked
        self.controls.refresh(blocked, unfinished=False, said=self.step.text)

    def _show_automatic(self, p, sampler) -> None:
        """What the automatic ranges come to, in the disabled fields."""
        if sampler is None:
            return
        nearest, farthest = sampler.ranges.working_distance_mm
        for automatic, values in (
            (p.distanceAuto, {"nearestMm": nearest, "farthestMm": farthest}),
            (p.lateralAuto, {"lateralMm": sampler.ranges.lateral_offset_mm}),
        ):
            if automatic:
                for name, value in values.items():
                    if abs(getattr(p, name) - value) > 0.05:
                        changed(p, name, round(float(value), 1))

    def _refresh_cameras(self, p, sampler) -> None:
        wanted = (
            (sampler, min(p.poseCount, SHOWN_CAMERAS)) if sampler and p.showCameras and self.panel.entered else None
        )
        if wanted == self._drawn:
            return
        self._drawn = wanted
        if wanted is None:
            self._stepper.stop()
            planning.remove_nodes(self.panel.scene, self._cameras)
            self.ui.posesProblem.visible = False
        else:
            self._stepper.start(self._draw_cameras(*wanted, self.session.space(p)))

    def _draw_cameras(self, sampler, count: int, space: str):
        """Draws more and more cameras, a piece at each step."""
        poses = []
        for index in range(count):
            try:
                poses.append(sampler.sample(index))
            except InputError as error:
                planning.remove_nodes(self.panel.scene, self._cameras)
                self.ui.posesProblem.text = str(error)
                self.ui.posesProblem.visible = True
                return
            yield
        lengths_mm = planning.frustum_lengths_mm(np.stack(poses), sampler.craniotomy.centre_world_mm)
        polydata = planning.frustum_polydata(sampler.camera, np.stack(poses), lengths_mm, space)
        self._cameras["frustums"] = planning.line_model(
            self.panel.scene, self._cameras.get("frustums"), planning.FRUSTUMS, polydata, planning.FRUSTUM_COLOUR
        )
        self.ui.posesProblem.visible = False

    def _look(self) -> None:
        """Show the label map of the chosen pose, or take it away."""
        p = self.parameters
        if p is None:
            return
        try:
            wanted = p.lookThrough and self.panel.entered and not self.panel.help.reason("planning")
            sampler = self.session.sampler(p) if wanted else None
            vessels, cortex = (self.session.mesh(p, name) for name in ("vessels", "cortex"))
        except InputError:
            sampler = None
        if sampler is None:
            self._stop_looking()
            return
        wanted = (sampler, p.poseIndex, p.poseCount, cortex)
        if wanted == self._looked:
            return
        try:
            pose = sampler.sample(p.poseIndex)
        except InputError as error:
            self.ui.lookCaption.text = str(error)
            return
        space, scene = self.session.space(p), self.panel.scene
        camera = sampler.camera
        scale = min(1.0, PREVIEW_HEIGHT_PX / camera.height)
        camera = camera.resized(round(camera.width * scale), round(camera.height * scale))
        renderer = self._renderer_of(vessels, cortex, sampler, camera)
        labels = renderer.render(pose)
        plane_mm = planning.plane_through(sampler.craniotomy.centre_world_mm, pose)
        with slicer.util.RenderBlocker():  # a busy Slicer would draw each change on its own
            volume = planning.show_mask(scene, self._seen, labels, camera, pose, plane_mm, space)
            self._seen["camera"] = planning.line_model(
                scene,
                self._seen.get("camera"),
                planning.LOOKED_THROUGH,
                planning.frustum_polydata(camera, pose[None], np.array([plane_mm]), space),
                planning.LOOKED_THROUGH_COLOUR,
                2.0,
            )
            self._show_slice(volume, camera, pose, plane_mm, space)
        tilt, distance_mm = planning.view_direction(pose, sampler.craniotomy)
        self.ui.lookCaption.text = _("Camera {number} of {count}: tilt {tilt:.0f}°, {distance:.0f} mm away").format(
            number=p.poseIndex + 1, count=p.poseCount, tilt=tilt, distance=distance_mm
        )
        self._looked = wanted

    def _renderer_of(self, vessels, cortex, sampler, camera):
        from ..masks.renderer import MaskRenderer

        # Meshes compare by identity. Without a cortex the disc below the vessels depends on the axis.
        key = (vessels, cortex, camera, None if cortex else tuple(sampler.craniotomy.outward_axis))
        if self._renderer is None or self._renderer[0] != key:
            self._drop_renderer()
            parenchyma = cortex or disc_under_vessels(vessels, sampler.craniotomy.outward_axis)
            self._renderer = (key, MaskRenderer(vessels, parenchyma, camera))
        return self._renderer[1]

    def _drop_renderer(self) -> None:
        if self._renderer is not None:
            self._renderer[1].close()
            self._renderer = None

    def _show_slice(self, volume, camera, pose, plane_mm: float, space: str) -> None:
        scene = self.panel.scene
        slice_node = scene.GetNodeByID(f"vtkMRMLSliceNode{SLICE}")
        composite = scene.GetNodeByID(f"vtkMRMLSliceCompositeNode{SLICE}")
        if slice_node is None or composite is None:
            return
        if self._slice_before is None:
            self._slice_before = _SliceBefore(slice_node, composite)
        planning.look_at_mask(slice_node, camera, pose, plane_mm, space)
        composite.SetBackgroundVolumeID(None)
        composite.SetForegroundVolumeID(None)
        composite.SetLabelVolumeID(volume.GetID())
        composite.SetLabelOpacity(1.0)

    def _stop_looking(self) -> None:
        self._looked = None
        self.ui.lookCaption.text = ""
        if self._slice_before is None and not self._seen and self._renderer is None:
            return
        with slicer.util.RenderBlocker():
            if self._slice_before is not None:
                self._slice_before.restore(self.panel.scene)
                self._slice_before = None
            planning.remove_nodes(self.panel.scene, self._seen)
        self._drop_renderer()

    def leave(self) -> None:
        self._stepper.stop()
        self._look_timer.stop()
        planning.remove_nodes(self.panel.scene, self._cameras)
        self._drawn = None
        self._stop_looking()

    def close(self) -> None:
        self._watch.watch(None)
        self.leave()

    def on_node(self, node) -> None:
        changed(self.parameters, "craniotomyNode", node)

    def on_place(self) -> None:
        """Let the user click a point on the cortex."""
        p = self.parameters
        node = p.craniotomyNode
        if node is None or not node.IsA("vtkMRMLMarkupsFiducialNode"):
            node = self.panel.scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", _("Craniotomy"))
            node.CreateDefaultDisplayNodes()
            changed(p, "craniotomyNode", node)
        node.RemoveAllControlPoints()
        slicer.modules.markups.logic().SetActiveList(node)
        slicer.modules.markups.logic().StartPlaceMode(False)

    def on_render(self) -> None:
        p = self.parameters
        try:
            arguments = self.session.render_arguments(p)
        except InputError as error:
            slicer.util.errorDisplay(str(error))
            return
        started(self.panel, self.controls.watch, arguments)


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

    def restore(self, scene) -> None:
        slice_node, composite = scene.GetNodeByID(self._slice_id), scene.GetNodeByID(self._composite_id)
        if slice_node is None or composite is None:
            return
        slice_node.GetSliceToRAS().DeepCopy(self._to_ras)
        slice_node.UpdateMatrices()
        slice_node.SetFieldOfView(*self._field_of_view)
        background, foreground, label, opacity = self._volumes
        composite.SetBackgroundVolumeID(background)
        composite.SetForegroundVolumeID(foreground)
        composite.SetLabelVolumeID(label)
        composite.SetLabelOpacity(opacity)
