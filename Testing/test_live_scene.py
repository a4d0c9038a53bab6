"""The live panel's nodes and views on slicer-core's real MRML, measured in pixels against OpenCV."""

from __future__ import annotations

import cases
import cv2
import numpy as np
import pytest

from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.geometry.camera import Camera
from ExpectedAppearancesLib.geometry.pose import look_at
from ExpectedAppearancesLib.geometry.silhouette import Silhouette
from ExpectedAppearancesLib.live.frames import LiveFrame
from ExpectedAppearancesLib.live.overlay import OverlayMaker
from ExpectedAppearancesLib.live.session import LiveResult
from ExpectedAppearancesLib.registration.predictor import Prediction

slicer = pytest.importorskip("slicer")

from mrml_views import SliceView, ThreeDView, new_application  # noqa: E402

from ExpectedAppearancesLib.mrml import live_views  # noqa: E402
from ExpectedAppearancesLib.mrml.live_align import Alignment  # noqa: E402
from ExpectedAppearancesLib.mrml.live_scene import PREDICTED_RGB, LiveScene, OverlayOptions  # noqa: E402

CAMERA = Camera(640, 480, 1350.0, 1350.0, 350.0, 215.0)  # off-centre on purpose
POSE = look_at(np.array([25.0, -18.0, 90.0]), np.array([1.0, 0.5, -2.0]), np.array([0.2, 1.0, 0.0]))
OTHER_POSE = look_at(np.array([-20.0, 10.0, 100.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))


@pytest.fixture(scope="module", params=["LPS", "RAS"])
def case(request, tmp_path_factory):
    """In LPS the models are turned about the patient's axis on their way into Slicer's world."""
    folder = tmp_path_factory.mktemp("live")
    paths = cases.write_inputs(folder)
    return Case.create(folder / "case", paths["vessels.vtp"], paths["cortex.vtp"], CAMERA, request.param)


def result_of(case, pose=POSE, accepted=True, camera=CAMERA, seed=0, taken_s=0.0) -> LiveResult:
    image = np.random.default_rng(seed).integers(60, 120, (camera.height, camera.width, 3), dtype=np.uint8)
    overlay = OverlayMaker(case.vessels).make(camera, pose) if accepted else None
    frame = LiveFrame(image, taken_s, seed, f"frame {seed}")
    return LiveResult(frame, case.vessels_sha256, image, camera, Prediction(pose, accepted, 0.9, 5.0), overlay)


def project(points_mm, pose, camera=CAMERA) -> np.ndarray:
    rotation = cv2.Rodrigues(np.ascontiguousarray(pose[:3, :3]))[0]
    return cv2.projectPoints(points_mm, rotation, pose[:3, 3], camera.matrix, None)[0].reshape(-1, 2)


def drawn_silhouette(case, pose, camera, size) -> np.ndarray:
    """Lines of the silhouette's projected edges, drawn by OpenCV: 0 on a line, 255 elsewhere."""
    edges = Silhouette(case.vessels.vertices_mm, case.vessels.triangles).edges(pose)
    pixels = project(case.vessels.vertices_mm, pose, camera)
    canvas = np.full(size[::-1], 255, np.uint8)
    for first, second in edges:
        ends = [np.rint(pixels[i] * 16).astype(int).tolist() for i in (first, second)]
        cv2.line(canvas, *ends, 0, 1, cv2.LINE_8, 4)
    return canvas


def apart(case, pose, camera, drawn) -> tuple[np.ndarray, np.ndarray]:
    """Distances in px: of the drawn pixels from the projected silhouette, and of its pixels from the drawn ones."""
    fine = 8
    large = camera.resized(camera.width * fine, camera.height * fine)
    lines = drawn_silhouette(case, pose, large, (large.width, large.height))
    from_lines = cv2.distanceTransform(lines, cv2.DIST_L2, 5) / fine
    rows, columns = np.nonzero(drawn)
    at = [np.rint((index + 0.5) * fine - 0.5).astype(int) for index in (rows, columns)]
    expected = drawn_silhouette(case, pose, camera, (camera.width, camera.height)) == 0
    from_drawn = cv2.distanceTransform(np.where(drawn, 0, 255).astype(np.uint8), cv2.DIST_L2, 5)
    return from_lines[at[0], at[1]], from_drawn[expected]


def is_colour(pixels, rgb, within=60) -> np.ndarray:
    return np.abs(pixels.astype(int) - np.array(rgb) * 255).sum(axis=-1) < within


@pytest.fixture
def application():
    return new_application()


def shown(application, case, size=(640, 480), options=None):
    scene, logic = application
    view = SliceView(scene, logic, "Microscope", size)
    live = LiveScene(scene, case)
    live.set_options(options or OverlayOptions(fill=False))
    live.lines["outline"].GetDisplayNode().SetSliceIntersectionThickness(1)  # thin enough to measure
    result = result_of(case)
    live.show(result)
    draw(view, live)
    return view, live, result


def draw(view, live, fit=True):
    live_views.align_slice(view.node, live.camera, live.camera_to_world, live.plane_mm)
    if fit:
        live_views.fit_slice(view.node, live.camera, live.plane_mm)
    live.set_view_pixel(live_views.view_pixel_mm(view.node))
    live_views.show_layers(view.composite, live.frame, live.fill, live.fill_opacity)
    view.draw_layers()


def test_outline_lies_within_a_pixel_of_the_projected_silhouette(application, case):
    view, _live, result = shown(application, case)
    pixels = view.pixels()
    drawn = is_colour(pixels, PREDICTED_RGB)
    assert drawn.sum() > 500
    far_px, near_px = apart(case, POSE, CAMERA, drawn)
    assert far_px.max() <= 1.0  # none is drawn elsewhere
    assert near_px.max() < 1.5  # none is left out; both are pixels here, and neighbours across a corner are 1.4 apart
    # The frame itself is shown pixel for pixel.
    same = np.abs(pixels.astype(int) - result.image_rgb).max(axis=2) <= 1
    assert same[~cv2.dilate(drawn.astype(np.uint8), np.ones((3, 3))).astype(bool)].mean() > 0.999


def test_frame_and_outline_hold_when_the_models_are_deformed(application, case):
    """As for brain shift: the camera does not hang under what has no matrix."""
    import vtk

    scene, _logic = application
    view, live, _result = shown(application, case)
    warp = vtk.vtkThinPlateSplineTransform()
    ends = [vtk.vtkPoints(), vtk.vtkPoints()]
    for number, at in enumerate(((0, 0, 0), (50, 0, 0), (0, 50, 0), (0, 0, 50), (50, 50, 50))):
        ends[0].InsertNextPoint(*at)
        ends[1].InsertNextPoint(at[0] + 3 * number, at[1] - 2, at[2] + 30)
    warp.SetSourceLandmarks(ends[0])
    warp.SetTargetLandmarks(ends[1])
    warp.SetBasisToR()
    node = scene.AddNewNodeByClass("vtkMRMLTransformNode", "Brain shift")
    node.SetAndObserveTransformToParent(warp)
    for model in live.models.values():
        model.SetAndObserveTransformNodeID(node.GetID())
    result = result_of(case, OTHER_POSE, seed=1)
    live.show(result)
    draw(view, live)
    pixels = view.pixels()
    drawn = is_colour(pixels, PREDICTED_RGB)
    far_px, near_px = apart(case, OTHER_POSE, CAMERA, drawn)
    assert drawn.sum() > 500 and far_px.max() <= 1.0 and near_px.max() < 1.5
    assert (np.abs(pixels.astype(int) - result.image_rgb).max(axis=2) <= 1).mean() > 0.9


def test_outline_and_view_hold_when_the_user_transforms_the_models(application, case):
    import vtk

    scene, logic = application
    view, live, _result = shown(application, case)
    moved = vtk.vtkTransform()
    moved.Translate(40, -25, 60)
    moved.RotateWXYZ(50, 1, 2, -0.5)
    node = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "Patient moved")
    node.SetMatrixTransformToParent(moved.GetMatrix())
    for model in live.models.values():
        model.SetAndObserveTransformNodeID(node.GetID())
    live.show(result_of(case, OTHER_POSE, seed=1))
    draw(view, live)
    drawn = is_colour(view.pixels(), PREDICTED_RGB)
    far_px, near_px = apart(case, OTHER_POSE, CAMERA, drawn)
    assert drawn.sum() > 500 and far_px.max() <= 1.0 and near_px.max() < 1.5
    # The vessels themselves, where they lie now, are seen there too.
    through = ThreeDView(scene, logic, "MicroscopeCamera", (640, 480))
    for each in (*live.lines.values(), live.frustum, live.models["Cortex"]):
        each.GetDisplayNode().SetVisibility(False)
    vessels = live.models["Vessels"].GetDisplayNode()
    vessels.SetColor(1, 1, 1)
    vessels.SetLighting(False)
    through.node.SetBackgroundColor(0, 0, 0)
    through.node.SetBackgroundColor2(0, 0, 0)
    through.window.Render()
    live_views.aim_camera(through.camera_node, (640, 480), CAMERA, live.camera_to_world, live.plane_mm)
    seen = through.pixels().min(axis=2) > 128
    expected = OverlayMaker(case.vessels).make(CAMERA, OTHER_POSE).fill.astype(bool)
    assert (seen & expected).sum() / (seen | expected).sum() > 0.97


def test_outline_stays_on_the_vessels_when_a_new_pose_comes(application, case):
    view, live, _result = shown(application, case)
    live.show(result_of(case, OTHER_POSE, seed=1))
    draw(view, live, fit=True)
    drawn = is_colour(view.pixels(), PREDICTED_RGB)
    far_px, near_px = apart(case, OTHER_POSE, CAMERA, drawn)
    assert drawn.sum() > 500
    assert far_px.max() <= 1.0 and near_px.max() < 1.5


def test_fill_covers_the_vessels_and_its_opacity_is_the_users(application, case):
    from ExpectedAppearancesLib.masks.renderer import MaskRenderer

    view, live, result = shown(application, case, options=OverlayOptions(outline=False, fill_opacity=1.0))
    drawn = is_colour(view.pixels(), PREDICTED_RGB)
    below = type(case.cortex)(case.cortex.vertices_mm - [0, 0, 40], case.cortex.triangles)
    with MaskRenderer(case.vessels, below, CAMERA) as renderer:
        expected = renderer.render(POSE) == 2
    assert (drawn & expected).sum() / (drawn | expected).sum() > 0.97
    live.set_options(OverlayOptions(outline=False, fill_opacity=0.5))
    draw(view, live)
    pixels = view.pixels().astype(float)
    mixed = (result.image_rgb + np.array(PREDICTED_RGB) * 255) / 2
    inside = cv2.erode(expected.astype(np.uint8), np.ones((5, 5))).astype(bool)
    assert np.abs(pixels - mixed)[inside].max() < 4


def test_box_is_the_projected_bounding_box(application, case):
    view, _live, _result = shown(application, case, options=OverlayOptions(outline=False, fill=False, box=True))
    drawn = is_colour(view.pixels(), (1.0, 0.82, 0.2))
    low, high = case.vessels.vertices_mm.min(axis=0), case.vessels.vertices_mm.max(axis=0)
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    inside = [c for c in np.rint(project(corners, POSE)).astype(int) if 0 <= c[0] < 640 and 0 <= c[1] < 480]
    assert len(inside) >= 3
    near_px = cv2.distanceTransform(np.where(drawn, 0, 255).astype(np.uint8), cv2.DIST_L2, 5)
    assert max(near_px[v, u] for u, v in inside) <= 1.5


@pytest.mark.parametrize("hide", ["refused", "asked"])
def test_nothing_of_the_overlay_survives_its_frame(application, case, hide):
    view, live, _result = shown(application, case, options=OverlayOptions(box=True))
    plain = result_of(case, accepted=False, seed=5)
    if hide == "refused":
        live.show(plain)
    else:
        live.set_overlay_visible(False)
        plain = _result
    draw(view, live)
    pixels = view.pixels()
    assert np.abs(pixels.astype(int) - plain.image_rgb).max() <= 1
    assert not live.frustum.GetDisplayNode().GetVisibility()


def test_view_through_the_camera_shows_the_vessels_where_the_frame_has_them(application, case):
    scene, logic = application
    live = LiveScene(scene, case)
    live.show(result_of(case))
    view = ThreeDView(scene, logic, "MicroscopeCamera", (800, 480))  # wider than the frame
    view.node.SetBackgroundColor(0, 0, 0)
    view.node.SetBackgroundColor2(0, 0, 0)
    vessels = live.models["Vessels"].GetDisplayNode()
    vessels.SetColor(1, 1, 1)
    vessels.SetLighting(False)
    for name, node in live.models.items():
        if name != "Vessels":
            node.GetDisplayNode().SetVisibility(False)
    for node in (*live.lines.values(), live.frustum):
        node.GetDisplayNode().SetVisibility(False)
    view.window.Render()
    live_views.aim_camera(view.camera_node, (800, 480), CAMERA, live.camera_to_ras, live.plane_mm)
    drawn = view.pixels().min(axis=2) > 128
    expected = OverlayMaker(case.vessels).make(CAMERA, POSE).fill.astype(bool)
    drawn_in_frame = drawn[:, 80:720]
    assert (drawn_in_frame & expected).sum() / (drawn_in_frame | expected).sum() > 0.97
    live_views.look_away(view.camera_node)
    assert not (view.pixels().min(axis=2) > 128).any()


def test_view_through_the_camera_has_the_frame_behind_the_vessels(application, case):
    scene, logic = application
    live = LiveScene(scene, case)
    result = result_of(case)
    result.image_rgb[:] = cv2.GaussianBlur(result.image_rgb, None, 3)
    result.image_rgb[:40, :60] = (0, 0, 255)
    live.show(result)
    view = ThreeDView(scene, logic, "MicroscopeCamera", (640, 480))
    other = ThreeDView(scene, logic, "MicroscopeOverview", (64, 48))
    live.show_backdrop(view.node.GetID())
    for node in (*live.models.values(), *live.lines.values(), live.frustum):
        node.GetDisplayNode().SetVisibility(False)
    for one in (view, other):
        one.window.Render()
        live_views.aim_camera(one.camera_node, one.window.GetSize(), CAMERA, live.camera_to_ras, live.plane_mm)
        one.node.SetBackgroundColor(0, 1, 0)
        one.node.SetBackgroundColor2(0, 1, 0)
    pixels = view.pixels()
    assert np.abs(pixels.astype(int) - result.image_rgb)[5:-5, 5:-5].mean() < 2
    assert (other.pixels() == [0, 255, 0]).all()
    # A recording that is looked at gives the frame an image of its own.
    from ExpectedAppearancesLib.mrml.vtk_data import set_image

    live.frame.SetAndObserveImageData(None)
    set_image(live.frame, np.ascontiguousarray(result.image_rgb[:, ::-1]))
    live.show_backdrop(view.node.GetID())
    assert np.abs(view.pixels().astype(int) - result.image_rgb[:, ::-1])[5:-5, 5:-5].mean() < 2
    live.show(result_of(case, accepted=False))
    live.show_backdrop(view.node.GetID())
    assert (view.pixels() == [0, 255, 0]).all()


def test_banner_is_read_over_the_view_and_goes_without_a_trace(application, case):
    from vtkmodules.vtkRenderingCore import vtkActor2D

    from ExpectedAppearancesLib.mrml.live_banner import Banner

    view, _live, _result = shown(application, case)
    before = view.pixels()
    banner = Banner(view.renderer)
    assert banner.say("NO OVERLAY", (0.75, 0.08, 0.1))
    assert not banner.say("NO OVERLAY", (0.75, 0.08, 0.1))
    pixels = view.pixels()
    red = is_colour(pixels, (0.75, 0.08, 0.1))
    assert red[2].all() and red[-3].all() and red[:, 2].all() and red[:, -3].all()
    assert (pixels[8:60] > 200).all(axis=2).any()  # white letters
    np.testing.assert_array_equal(pixels[80:400, 20:620], before[80:400, 20:620])
    view.renderer.AddViewProp(vtkActor2D())  # as an outline that is drawn for the first time, across the words
    assert banner.say("NO OVERLAY", (0.75, 0.08, 0.1)) and not banner.say("NO OVERLAY", (0.75, 0.08, 0.1))
    assert view.renderer.GetViewProps().GetLastProp().IsA("vtkTextActor")
    banner.remove()
    np.testing.assert_array_equal(view.pixels(), before)


def test_a_frame_of_another_size_is_shown_whole_and_true(application, case):
    view, live, _result = shown(application, case)
    smaller = Camera(400, 480, 1350.0, 1350.0, 350.0 - 120, 215.0)
    assert live.show(result_of(case, camera=smaller, seed=3))
    draw(view, live)
    pixels = view.pixels()
    drawn = is_colour(pixels, PREDICTED_RGB)[:, 120:520]
    far_px, near_px = apart(case, POSE, smaller, drawn)
    assert drawn.sum() > 300 and far_px.max() <= 1.0 and near_px.max() < 1.5


def test_three_hundred_frames_leave_as_many_nodes_observers_and_bytes_as_three(application, case):
    import gc

    scene, _logic = application
    view, live, _result = shown(application, case, options=OverlayOptions(box=True))
    results = [
        result_of(case, pose, accepted, seed=i)
        for i, (pose, accepted) in enumerate([(POSE, True), (OTHER_POSE, True), (POSE, False)])
    ]

    def go(count):
        for i in range(count):
            live.show(results[i % 3])
            draw(view, live)
        gc.collect()
        return scene.GetNumberOfNodes(), len([o for o in gc.get_objects() if type(o).__name__.startswith("vtk")])

    first = go(9)
    assert go(300) == first


def test_no_display_node_is_saved_whose_node_is_not(application, case):
    """A loaded scene would keep it for ever, and each time it is saved again one more."""
    scene, _logic = application
    live = LiveScene(scene, case)
    live.show(result_of(case))
    live.show_backdrop("vtkMRMLViewNode1")
    alignment = Alignment(live, case, POSE)
    nodes = [scene.GetNthNode(i) for i in range(scene.GetNumberOfNodes())]
    displayed = [n for n in nodes if hasattr(n, "GetDisplayNode") and n.GetDisplayNode() is not None]
    unsaved = [n for n in displayed if not n.GetSaveWithScene()]
    assert len(unsaved) >= 6
    assert [n.GetName() for n in unsaved if n.GetDisplayNode().GetSaveWithScene()] == []
    alignment.finish()
    live.close()


def test_closing_takes_every_node_away_and_the_next_session_leaves_no_second(application, case):
    scene, _logic = application
    before = scene.GetNumberOfNodes()
    live = LiveScene(scene, case)
    live.show(result_of(case))
    count = scene.GetNumberOfNodes()
    again = LiveScene(scene, case)
    again.show(result_of(case))
    assert scene.GetNumberOfNodes() == count
    again.close()
    left = [scene.GetNthNode(i).GetName() for i in range(scene.GetNumberOfNodes())][before:]
    assert scene.GetNumberOfNodes() == before, left
