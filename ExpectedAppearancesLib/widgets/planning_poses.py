"""Section Craniotomy and poses: where the microscope may look from, seen in 3D and through any of its cameras."""

from __future__ import annotations

import numpy as np
import slicer
from slicer.i18n import tr as _

from ..errors import InputError
from ..mrml import planning
from ..planning.steps import StepState
from .planning_look import Looking
from .planning_qt import Stepper, allow
from .planning_run import RunControls, in_the_way, started
from .planning_section import NodeWatch, Section, changed
from .refreshing import quiet

SHOWN_CAMERAS = 40


class PosesSection(Section):
    name = "poses"
    title = "Craniotomy and poses"

    def setup(self) -> None:
        ui = self.ui
        self._stepper = Stepper()
        self._looking = Looking(self.panel)
        self._cameras: dict = {}
        self._drawn = None  # what the cameras show
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
        events = (node.PointModifiedEvent, node.PointRemovedEvent, node.TransformModifiedEvent) if node else ()
        self._watch.watch(node, *events)
        reason = _("Taken from the field of view; untick to set it.") if p.distanceAuto else ""
        allow(ui.nearestSlider, reason, _("Nearest working distance."))
        allow(ui.farthestSlider, reason, _("Farthest working distance."))
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
        reason = problem or ("" if p.lookThrough else _("Tick the box to look through a camera."))
        allow(ui.poseSlider, reason, _("Which camera is looked through."))
        self._refresh_cameras(p, sampler)
        self._looking.refresh(p if self.panel.entered and p.lookThrough else None, sampler)
        blocked = problem
        if self.session.case(p) is None:
            blocked = self.step.text
        elif self.panel.steps["case"].state.value == "stale":
            blocked = _("Save the case first: {reason}").format(reason=self.panel.steps["case"].text)
        blocked = in_the_way(self.panel, "render") or self.session.waiting(p) or blocked
        manifest, state = self.panel.recorded.manifest, self.step.state
        begun = bool(manifest and manifest["stages"].get("render"))
        self.controls.refresh(blocked, begun and state is StepState.READY, state is StepState.DONE, self.step.text)

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
        yield
        self._cameras["frustums"] = planning.line_model(
            self.panel.scene, self._cameras.get("frustums"), planning.FRUSTUMS, polydata, planning.FRUSTUM_COLOUR
        )
        self.ui.posesProblem.visible = False

    def leave(self) -> None:
        self._stepper.stop()
        planning.remove_nodes(self.panel.scene, self._cameras)
        self._drawn = None
        self._looking.stop()

    def close(self) -> None:
        self._watch.watch(None)
        self.leave()

    def on_node(self, node) -> None:
        changed(self.parameters, "craniotomyNode", node)

    def on_place(self) -> None:
        """Let the user click a point on the cortex."""
        p = self.parameters
        node = p.craniotomyNode
        # More than one point are a list of the user's own, such as landmarks.
        if node is None or not node.IsA("vtkMRMLMarkupsFiducialNode") or node.GetNumberOfControlPoints() > 1:
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
