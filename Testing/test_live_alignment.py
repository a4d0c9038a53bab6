"""Poses by hand in a scene: handles, sliders, landmarks, and true poses that are collected."""

from __future__ import annotations

import numpy as np
import pytest

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.demo.phantom import covered_frame
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.live.trust import Sight
from ExpectedAppearancesLib.registration.poses_file import read_poses

slicer = pytest.importorskip("slicer")

from live_cases import SMALL, add_of, camera_to_ras_of, choice_of, node_with, send, wait_for  # noqa: E402
from mrml_views import SliceView, ThreeDView, new_application  # noqa: E402

from ExpectedAppearancesLib.mrml.live_controller import LiveController  # noqa: E402
from ExpectedAppearancesLib.mrml.live_views import LiveViews  # noqa: E402


@pytest.fixture
def application():
    return new_application()


def holding_a_frame(scene, phantom, model) -> LiveController:
    controller = LiveController(scene)
    controller.start(choice_of(phantom, stale_s=60), single=True, model=model)
    wait_for(controller, lambda s: s.new)
    return controller


def pick_in_frame(in_frame, seen_mm: np.ndarray, plane_mm: float) -> None:
    """A landmark on the image plane where the frame shows a point (3,), camera mm."""
    in_frame.SetNthControlPointPosition(in_frame.AddControlPoint(0, 0, 0), *(seen_mm * plane_mm / seen_mm[2]))


def test_alignment_by_handles_sliders_and_landmarks_gives_the_true_pose(application, phantom, model, frames):
    scene, _logic = application
    true = frames[0][2]
    node_with(scene, frames[1][2])
    controller = holding_a_frame(scene, phantom, model)
    before = scene.GetNumberOfNodes()
    alignment = controller.begin_alignment()
    start = alignment.camera_from_world
    # Sliders: 5 mm to the right moves the vessels 5 mm along the camera's x.
    controller.nudge(np.array([5.0, 0, 0]), np.zeros(3), start)
    assert add_of(phantom, start, alignment.camera_from_world) == pytest.approx(5.0, abs=1e-6)
    controller.tick()
    difference = controller.difference()
    assert difference.add_mm == pytest.approx(5.0, abs=1e-3)
    assert controller.live.lines["truth"].GetDisplayNode().GetVisibility()
    shift, turn = controller.nudges(start)
    np.testing.assert_allclose(shift, [5, 0, 0], atol=1e-6)
    np.testing.assert_allclose(turn, 0, atol=1e-6)
    # Handles: the user turns the transform in the scene; the vessels hang under it.
    import vtk

    turned = vtk.vtkTransform()
    turned.Translate(3, -2, 1)
    turned.RotateZ(4)
    alignment.handles.SetMatrixTransformToParent(turned.GetMatrix())
    moved = camera_to_ras_of(alignment.handles)
    ras = np.diag([-1.0, -1.0, 1.0, 1.0])
    np.testing.assert_allclose(alignment.camera_from_world, start @ ras @ moved @ ras, atol=1e-9)
    # Landmarks picked where the true pose has them.
    from ExpectedAppearancesLib.mrml.live_align import add_landmark_lists

    in_frame, on_mesh = add_landmark_lists(controller.live)
    vertices = phantom.case.vessels.vertices_mm[:: len(phantom.case.vessels.vertices_mm) // 6][:6]
    in_camera = vertices @ true[:3, :3].T + true[:3, 3]
    for point, seen in zip(vertices, in_camera):
        on_mesh.AddControlPoint(*(point * [-1, -1, 1]))
        pick_in_frame(in_frame, seen, controller.live.plane_mm)
    assert controller.align_to_landmarks(in_frame, on_mesh) < 0.01
    assert add_of(phantom, true, alignment.camera_from_world) < 0.01
    controller.finish_alignment(keep=True)
    assert add_of(phantom, true, controller.truth) < 0.01
    assert controller.difference().add_mm < 0.3
    for node in (in_frame, on_mesh):
        scene.RemoveNode(node)
    assert controller.live.models["Vessels"].GetParentTransformNode() is None
    assert scene.GetNumberOfNodes() <= before + 2  # the landmark lists' display nodes
    controller.close()


def test_alignment_holds_when_the_user_transforms_the_models(application, phantom, model, frames):
    """Landmarks are picked where the vessels are seen: moved by the user's transform, and by the handles."""
    import vtk

    from ExpectedAppearancesLib.mrml.live_align import add_landmark_lists

    scene, _logic = application
    true = frames[0][2]
    node_with(scene, frames[1][2])
    controller = holding_a_frame(scene, phantom, model)
    patient = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "Patient moved")
    moved = vtk.vtkTransform()
    moved.Translate(40, -25, 60)
    moved.RotateWXYZ(50, 1, 2, -0.5)
    patient.SetMatrixTransformToParent(moved.GetMatrix())
    models = controller.live.models.values()
    for node in models:
        node.SetAndObserveTransformNodeID(patient.GetID())
    controller.live.follow_models()

    alignment = controller.begin_alignment()
    start = alignment.camera_from_world
    assert add_of(phantom, start, controller.result.camera_from_world) < 1e-6
    controller.nudge(np.array([4.0, -3.0, 6.0]), np.array([5.0, 2.0, -9.0]), start)
    in_frame, on_mesh = add_landmark_lists(controller.live)
    vertices = phantom.case.vessels.vertices_mm[:: len(phantom.case.vessels.vertices_mm) // 6][:6]
    in_camera = vertices @ true[:3, :3].T + true[:3, 3]
    to_world = vtk.vtkMatrix4x4()
    alignment.handles.GetMatrixTransformToWorld(to_world)
    for point, seen in zip(vertices, in_camera):
        clicked = to_world.MultiplyPoint((*(point * [-1, -1, 1]), 1.0))[:3]
        on_mesh.SetNthControlPointPositionWorld(on_mesh.AddControlPoint(0, 0, 0), *clicked)
        pick_in_frame(in_frame, seen, controller.live.plane_mm)
    assert controller.align_to_landmarks(in_frame, on_mesh) < 0.01
    controller.finish_alignment(keep=True)
    assert add_of(phantom, true, controller.truth) < 0.01
    assert {node.GetTransformNodeID() for node in models} == {patient.GetID()}
    for node in (in_frame, on_mesh, patient):
        scene.RemoveNode(node)
    controller.close()


def test_vessels_are_seen_over_a_refused_frame_while_they_are_aligned_to_it(application, phantom, model):
    """It is such frames that need it most; before and after, nothing lies over them."""
    scene, logic = application
    node_with(scene, covered_frame(1, SMALL))
    view = SliceView(scene, logic, "Microscope", (320, 240))
    through = ThreeDView(scene, logic, "MicroscopeCamera", (160, 120))
    controller = LiveController(scene, LiveViews(view.logic, lambda: (through.node, through.camera_node, (160, 120))))
    controller.start(choice_of(phantom, stale_s=60), single=True, model=model)
    assert wait_for(controller, lambda s: s.new).verdict.sight is Sight.REFUSED
    live = controller.live

    def is_seen() -> bool:
        apart_mm = np.linalg.norm(np.array(through.camera_node.GetPosition()) - live.camera_to_world[:3, 3])
        assert bool(live.backdrop.GetDisplayNode().GetVisibility()) == (apart_mm < 1e-3)
        return apart_mm < 1e-3

    first = live.camera_to_world
    controller.begin_alignment()
    assert not np.allclose(live.camera_to_world, first)
    controller.finish_alignment(keep=False)
    # Others listen to that transform: what the alignment began with is nobody's pose.
    np.testing.assert_allclose(live.camera_to_world, first, atol=1e-9)
    for _again in range(2):
        assert not is_seen()
        controller.begin_alignment()
        controller.tick()
        assert is_seen() and not live.overlay_visible
        # The frame fills the view, however far off the vessels are.
        shown_mm = np.array(view.node.GetFieldOfView()[:2])
        frame_mm = live.plane_mm * np.array([SMALL.width / SMALL.fx, SMALL.height / SMALL.fy])
        assert (shown_mm / frame_mm).max() == pytest.approx(1, abs=0.12)
        controller.finish_alignment(keep=True)
        controller.tick()
    assert not is_seen() and live.lines["truth"].GetDisplayNode().GetVisibility()
    controller.close()


def test_true_poses_are_collected_for_evaluation(application, phantom, model, frames, tmp_path):
    scene, _logic = application
    stream = node_with(scene, frames[1][2])
    controller = holding_a_frame(scene, phantom, model)
    with pytest.raises(InputError, match="align the vessels"):
        controller.save_truth(tmp_path)
    for i in (2, 3):
        controller.begin_alignment().set_pose(frames[0][i])
        controller.finish_alignment()
        path = controller.save_truth(tmp_path)
        controller.next_frame()
        send(stream, frames[1][3])
        wait_for(controller, lambda s: s.new)
        assert controller.truth is None
    _camera, saved = read_poses(path)
    assert len(saved) == 2
    for i, frame in zip((2, 3), saved):
        np.testing.assert_allclose(frame.camera_from_world, frames[0][i], atol=1e-9)
        np.testing.assert_array_equal(files.read_image_rgb(frame.image), frames[1][i])
    controller.close()
