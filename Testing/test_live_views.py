"""The microscope's view gets the pixels that Slicer by itself would draw, for less work."""

from __future__ import annotations

import cases
import numpy as np
import pytest

from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.geometry.camera import Camera
from ExpectedAppearancesLib.geometry.pose import look_at
from ExpectedAppearancesLib.live.frames import LiveFrame
from ExpectedAppearancesLib.live.overlay import OverlayMaker
from ExpectedAppearancesLib.live.session import LiveResult
from ExpectedAppearancesLib.registration.predictor import Prediction

slicer = pytest.importorskip("slicer")

import vtk  # noqa: E402
from live_cases import choice_of, node_with, record, send, wait_for  # noqa: E402
from mrml_views import SliceView, ThreeDView, new_application  # noqa: E402
from vtk.util.numpy_support import vtk_to_numpy  # noqa: E402

from ExpectedAppearancesLib.mrml import live_views  # noqa: E402
from ExpectedAppearancesLib.mrml.live_controller import LiveController  # noqa: E402
from ExpectedAppearancesLib.mrml.live_scene import LiveScene, OverlayOptions  # noqa: E402
from ExpectedAppearancesLib.mrml.live_views import LiveViews  # noqa: E402

CAMERA = Camera(480, 270, 1000.0, 1000.0, 250.0, 125.0)
POSE = look_at(np.array([25.0, -18.0, 90.0]), np.array([1.0, 0.5, -2.0]), np.array([0.2, 1.0, 0.0]))
SIZE = (320, 240)  # the frame falls between the view's pixels, and above and below it the view is empty


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("views")
    paths = cases.write_inputs(folder)
    return Case.create(folder / "case", paths["vessels.vtp"], paths["cortex.vtp"], CAMERA)


def result_of(case, accepted=True, seed=0) -> LiveResult:
    image = np.random.default_rng(seed).integers(0, 255, (CAMERA.height, CAMERA.width, 3), dtype=np.uint8)
    overlay = OverlayMaker(case.vessels).make(CAMERA, POSE) if accepted else None
    prediction = Prediction(POSE, accepted, 0.9, 5.0)
    return LiveResult(LiveFrame(image, 0.0, seed), case.vessels_sha256, image, CAMERA, prediction, overlay)


@pytest.fixture
def application():
    return new_application()


@pytest.fixture
def watched(case):
    """The frame in the live panel's view, and in one that Slicer draws by itself."""
    scene, logic = new_application()
    ours, plain = SliceView(scene, logic, "Microscope", SIZE), SliceView(scene, logic, "Plain", SIZE)
    live, views = LiveScene(scene, case), LiveViews(ours.logic, lambda: None)
    live.show(result_of(case))

    def layers() -> tuple[np.ndarray, np.ndarray]:
        views.follow(live, True)
        live_views.align_slice(plain.node, live.camera, live.camera_to_world, live.plane_mm)
        live_views.fit_slice(plain.node, live.camera, live.plane_mm)
        live_views.show_layers(plain.composite, live.frame, live.fill, live.fill_opacity)
        return blended(ours), blended(plain)

    return live, views, ours, layers


def blended(view) -> np.ndarray:
    """uint8 (H, W, 4) of the layers as the view draws them."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    producer = view.logic.GetImageDataConnection().GetProducer()
    producer.Update()
    return vtk_to_numpy(producer.GetOutput().GetPointData().GetScalars()).reshape(SIZE[1], SIZE[0], -1).copy()


def filters_above(view) -> list[str]:
    """Classes of all that works for the view's picture."""
    found, todo = [], [view.logic.GetImageDataConnection().GetProducer()]
    while todo:
        producer = todo.pop()
        found.append(producer.GetClassName())
        for port in range(producer.GetNumberOfInputPorts()):
            for i in range(producer.GetNumberOfInputConnections(port)):
                todo.append(producer.GetInputConnection(port, i).GetProducer())
    return found


def test_the_same_pixels_without_the_work_that_nobody_sees(watched):
    _live, _views, ours, layers = watched
    mine, plain = layers()
    assert plain.shape == mine.shape and len(np.unique(plain)) > 100
    np.testing.assert_array_equal(mine, plain)
    assert (plain[:20, :, 3] == 0).all()  # the empty part is transparent, as it is on the slice in 3D
    assert ours.logic.GetBackgroundLayer().GetReslice().GetSlabSliceSpacingFraction() == 1.0
    assert "vtkImageRGBToHSI" not in filters_above(ours)


def test_a_threshold_that_the_user_sets_is_one_of_intensity_and_can_be_taken_off(watched):
    live, views, ours, layers = watched
    before = layers()[0]
    display = live.frame.GetDisplayNode()
    display.SetThreshold(100, 255)
    display.SetApplyThreshold(True)
    mine, plain = layers()
    assert 0.05 < (plain != before).any(axis=2).mean() < 0.9
    np.testing.assert_array_equal(mine, plain)
    display.SetApplyThreshold(False)
    mine, plain = layers()
    np.testing.assert_array_equal(mine, before)
    assert "vtkImageRGBToHSI" not in filters_above(ours)
    views.leave()
    again = LiveViews(ours.logic, lambda: None)
    again.follow(live, True)
    display.SetApplyThreshold(True)
    again.follow(live, False)
    assert "vtkImageRGBToHSI" in filters_above(ours)


def test_a_colour_window_that_the_user_sets_is_applied(watched):
    live, _views, _ours, layers = watched
    before = layers()[0]
    live.frame.GetDisplayNode().SetWindowLevelMinMax(60, 160)
    mine, plain = layers()
    assert (mine != before).any()
    np.testing.assert_array_equal(mine, plain)


def test_hidden_vessels_leave_an_empty_layer_which_goes_with_the_users_wish_only(case, watched):
    """A layer that comes and goes makes Slicer write the view's annotations anew, which holds the panel up."""
    live, views, ours, _layers = watched

    def pixels() -> np.ndarray:
        views.follow(live, False)
        assert ours.composite.GetLabelVolumeID() == live.fill.GetID()
        return vtk_to_numpy(live.fill.GetImageData().GetPointData().GetScalars())

    for seed, accepted in ((1, True), (2, False), (3, True)):
        live.show(result_of(case, accepted=accepted, seed=seed))
        assert pixels().any() == accepted
    live.set_overlay_visible(False)
    assert not pixels().any()
    live.set_overlay_visible(True)
    assert pixels().any()
    live.set_options(OverlayOptions(fill=False))
    views.follow(live, False)
    assert ours.composite.GetLabelVolumeID() is None


def test_nothing_of_the_patient_is_drawn_over_a_frame_without_a_pose(case, application):
    """The segmentation that the vessels were taken from is in the scene, too, and is cut by each slice view's plane:
    under the words NO OVERLAY its vessels lay over the picture, where the pose before had them."""
    scene, logic = application
    view, live = SliceView(scene, logic, "Microscope", (CAMERA.width, CAMERA.height)), LiveScene(scene, case)
    views = LiveViews(view.logic, lambda: None)
    planned = scene.AddNewNodeByClass("vtkMRMLModelNode", "Planned")  # is drawn as segments are, by default
    planned.SetAndObservePolyData(live.models["Vessels"].GetPolyData())
    planned.CreateDefaultDisplayNodes()
    planned.GetDisplayNode().SetVisibility2D(True)
    for seed, accepted in enumerate((True, False, True, False)):
        result = result_of(case, accepted, seed)
        live.show(result)
        views.follow(live, seed == 0)
        view.draw_layers()
        over = (view.pixels() != result.image_rgb).any(axis=2).sum()
        assert (over > 1000) if accepted else (over == 0)
        assert live.camera_to_ras == pytest.approx(_matrix(live.transform.GetMatrixTransformToWorld))
    live.show_truth(result_of(case).overlay, CAMERA)  # aligned by hand to a frame that was refused
    views.follow(live, False)
    planned.SetDisplayVisibility(False)
    shown = view.pixels()
    assert (shown != result.image_rgb).any(axis=2).sum() > 500
    live.put_picture_aside(False)
    live_views.align_slice(view.node, CAMERA, live.picture_to_world, live.plane_mm)
    np.testing.assert_array_equal(view.pixels(), shown)
    live.put_picture_aside(True)
    views.leave()
    assert live.frame.GetParentTransformNode() is live.transform
    live.close()


def test_the_mri_is_cut_along_the_optical_axis_only_while_the_pose_holds(case, application):
    """No words stand over that view: what is seen in it must be of this frame."""
    scene, logic = application
    ours, mri = SliceView(scene, logic, "Microscope", SIZE), SliceView(scene, logic, "MicroscopeMRI", SIZE)
    scan_id = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "MRI").GetID()
    live = LiveScene(scene, case)
    views = LiveViews(ours.logic, lambda: None, lambda: (mri.node, mri.composite, scan_id))
    for accepted in (True, False, True):
        live.show(result_of(case, accepted))
        views.follow(live, False)
        assert mri.composite.GetBackgroundVolumeID() == (scan_id if accepted else None)
        assert mri.node.GetSliceVisible() == accepted
        to_slice = np.linalg.inv(vtk_matrix_values(mri.node.GetSliceToRAS()))
        axis = live.camera_to_world @ np.array([(0, 0, 0, 1), (0, 0, live.plane_mm, 1)]).T
        np.testing.assert_allclose((to_slice @ axis)[2], 0, atol=1e-6)


def test_lines_that_were_not_wanted_are_those_of_the_frame_when_they_are(case, watched):
    """They are not worked out while they are hidden, so they must be when they are shown."""
    live, _views, _ours, _layers = watched
    live.set_options(OverlayOptions(outline=False, box=False))
    shifted = result_of(case, seed=3)
    shifted.overlay.box_px[:] += 7
    shifted.overlay.outline_px[:] += 7
    live.show(shifted)
    live.set_options(OverlayOptions(outline=True, box=True))
    for role, points_px in (("box", shifted.overlay.box_px), ("outline", shifted.overlay.outline_px)):
        points = live.lines[role].GetPolyData()
        assert points.GetNumberOfPoints() == len(points_px)
        x_mm, y_mm, z_mm = points.GetPoint(0)
        drawn_px = x_mm / z_mm * CAMERA.fx + CAMERA.cx, y_mm / z_mm * CAMERA.fy + CAMERA.cy
        np.testing.assert_allclose(drawn_px, points_px[0], atol=1e-6)
        assert live.lines[role].GetDisplayNode().GetVisibility()


def test_views_follow_when_the_user_moves_the_models_under_a_frame_that_is_held(application, phantom, model, frames):
    """Frozen, aligned or replayed, no new frame comes that would put views and camera right."""
    scene, logic = application
    view = SliceView(scene, logic, "Microscope", SIZE)
    controller = LiveController(scene, LiveViews(view.logic, lambda: None))
    browser, _predicted = record(controller, scene, phantom, model, frames[1][:2])

    def move_and_look(step) -> None:
        for angle in (20, 50):  # first under a transform at all, then that is moved
            moved = vtk.vtkTransform()
            moved.Translate(40, -25, 60)
            moved.RotateWXYZ(angle, 1, 2, -0.5)
            patient.SetMatrixTransformToParent(moved.GetMatrix())
            if controller.alignment is None:
                for node in controller.live.models.values():
                    node.SetAndObserveTransformNodeID(patient.GetID())
            step()
            assert apart_mm(view.node, controller.live) < 1e-6
            np.testing.assert_allclose(
                controller.live.camera_to_world, _matrix(patient.GetMatrixTransformToWorld) @ camera_to_ras()
            )

    def camera_to_ras():
        return _matrix(controller.live.transform.GetMatrixTransformToParent)

    patient = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "Patient moved")
    controller.replay(browser)
    move_and_look(lambda: controller.replay(browser))
    controller.start(choice_of(phantom, stale_s=60), single=True, model=model)
    wait_for(controller, lambda s: s.new)
    move_and_look(controller.tick)
    controller.begin_alignment().set_pose(frames[0][3])
    controller.tick()
    move_and_look(controller.tick)
    controller.finish_alignment(keep=True)
    truth = controller.truth
    move_and_look(controller.tick)
    assert controller.truth is truth and controller.live.lines["truth"].GetDisplayNode().GetVisibility()
    controller.close()


@pytest.mark.parametrize("held", [False, True])
def test_no_overlay_where_the_vessels_in_the_scene_were_changed(application, phantom, model, frames, held):
    """Hardened, a transform moves the vessels for good, and no camera followed: through it they lay elsewhere than in
    the picture behind them, as green as before."""
    scene, _logic = application
    controller = LiveController(scene)
    stream = node_with(scene, frames[1][0])
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: s.new)
    send(stream, frames[1][1])
    assert wait_for(controller, lambda s: s.new).verdict.shows_overlay
    if held:
        controller.freeze()
    moved = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "Patient moved")
    matrix = vtk.vtkMatrix4x4()
    matrix.SetElement(0, 3, 30)
    moved.SetMatrixTransformToParent(matrix)
    vessels = controller.live.models["Vessels"]
    vessels.SetAndObserveTransformNodeID(moved.GetID())
    assert controller.tick().verdict.shows_overlay
    vessels.HardenTransform()
    send(stream, frames[1][2])
    status = controller.tick() if held else wait_for(controller, lambda s: s.new)
    assert not status.verdict.shows_overlay and not controller.live.overlay_visible
    assert "hardened" in status.verdict.detail
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: s.new)
    send(stream, frames[1][3])
    assert wait_for(controller, lambda s: s.new).verdict.shows_overlay
    controller.close()


def test_the_views_stay_there_while_a_frame_is_held(application, phantom, model, frames):
    """Zoomed or turned, vessels would lie on other parts of the picture behind them, under words that they belong to
    it."""
    scene, logic = application
    view = SliceView(scene, logic, "Microscope", SIZE)
    through = ThreeDView(scene, logic, "MicroscopeCamera", (160, 120))
    controller = LiveController(scene, LiveViews(view.logic, lambda: (through.node, through.camera_node, (160, 120))))
    node_with(scene, frames[1][0])
    controller.start(choice_of(phantom, stale_s=60), single=True, model=model)
    wait_for(controller, lambda s: s.new)
    camera = through.camera_node.GetCamera()
    for move in (lambda: camera.Dolly(1.5), lambda: camera.Azimuth(20), lambda: camera.SetParallelProjection(True)):
        move()
        controller.tick()
        np.testing.assert_allclose(camera.GetPosition(), controller.live.camera_to_world[:3, 3])
        assert not camera.GetParallelProjection()
    offset_mm = view.logic.GetSliceOffset()
    view.logic.SetSliceOffset(offset_mm + 5)  # the mouse's wheel: the outline was left without its picture
    controller.tick()
    assert view.logic.GetSliceOffset() == pytest.approx(offset_mm) and apart_mm(view.node, controller.live) < 1e-6
    view.logic.SetSliceOffset(offset_mm)
    view.node.SetXYZOrigin(3, 4, 0)  # panning is the user's
    controller.tick()
    assert view.node.GetXYZOrigin()[:2] == (3, 4)
    controller.stop()
    away = camera.GetPosition()
    controller.tick()
    assert camera.GetPosition() == away and away[2] > 10_000
    controller.close()


def apart_mm(slice_node, live) -> float:
    """Of the frame's corners from the plane of the slice."""
    width, height = live.camera.width - 1, live.camera.height - 1
    corners = np.array([(0, 0, 0, 1), (width, 0, 0, 1), (0, height, 0, 1)], float).T
    world = live.camera_to_world @ _matrix(live.frame.GetIJKToRASMatrix) @ corners
    slice_to_world = vtk_matrix_values(slice_node.GetSliceToRAS())
    return float(np.abs((np.linalg.inv(slice_to_world) @ world)[2]).max())


def _matrix(get) -> np.ndarray:
    matrix = vtk.vtkMatrix4x4()
    get(matrix)
    return vtk_matrix_values(matrix)


def vtk_matrix_values(matrix) -> np.ndarray:
    return np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])
