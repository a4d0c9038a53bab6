"""The live session on real MRML with the phantom's frames: poses right, nothing mixed, nothing left behind."""

from __future__ import annotations

import contextlib
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.demo.phantom import covered_frame, make_phantom
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.geometry.camera import write_camera
from ExpectedAppearancesLib.live.choice import SourceKind
from ExpectedAppearancesLib.live.estimator import open_model
from ExpectedAppearancesLib.live.feed import FeedState
from ExpectedAppearancesLib.live.frames import FrameSettings
from ExpectedAppearancesLib.live.trust import Sight
from ExpectedAppearancesLib.registration.poses_file import write_poses

slicer = pytest.importorskip("slicer")

from live_cases import SMALL, add_of, camera_to_ras_of, choice_of, node_with, send, shown_pixels, wait_for  # noqa: E402
from mrml_views import SliceView, ThreeDView, new_application  # noqa: E402

from ExpectedAppearancesLib.mrml import live_views  # noqa: E402
from ExpectedAppearancesLib.mrml.live_controller import LiveController  # noqa: E402
from ExpectedAppearancesLib.mrml.live_stream import NodeFrames  # noqa: E402
from ExpectedAppearancesLib.mrml.live_views import LiveViews  # noqa: E402


@pytest.fixture
def application():
    return new_application()


def test_three_hundred_frames_each_with_its_own_pose_and_nothing_left_over(application, phantom, model, frames):
    import gc

    scene, logic = application
    poses, images = frames
    view = SliceView(scene, logic, "Microscope", (320, 240))
    through = ThreeDView(scene, logic, "MicroscopeCamera", (160, 120))
    views = LiveViews(view.logic, lambda: (through.node, through.camera_node, (160, 120)))
    before = scene.GetNumberOfNodes()
    stream = node_with(scene, images[0])
    controller = LiveController(scene, views)
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: s.new)  # what the stream held at the start
    counts, resident = [], []
    for number in range(300):
        if number % 25 == 24:
            image, pose = covered_frame(number, SMALL), None
        else:
            image, pose = images[number % 12], poses[number % 12]
        send(stream, image)
        status = wait_for(controller, lambda s: s.new)
        # The frame that is shown is the one that was sent, and so are its pose, transform and overlay.
        np.testing.assert_array_equal(shown_pixels(controller.live), image)
        assert status.verdict.shows_overlay == (pose is not None)
        assert view.node.GetSliceVisible() == status.verdict.shows_overlay
        if pose is not None:
            assert add_of(phantom, pose, status.result.prediction.camera_from_world) < 0.3
            ras_from_camera = np.diag([-1.0, -1.0, 1.0, 1.0]) @ np.linalg.inv(pose)
            np.testing.assert_allclose(
                camera_to_ras_of(controller.live.transform)[:3, 3], ras_from_camera[:3, 3], atol=1
            )
        if number % 10 == 0:
            view.draw_layers()
            view.window.Render()
        if number in (60, 299):
            gc.collect()
            counts.append((scene.GetNumberOfNodes(), stream.HasObserver(stream.ImageDataModifiedEvent)))
            resident.append(_resident_mb())
    assert counts[0] == counts[1]
    assert resident[1] < 1.05 * resident[0]
    controller.close()
    scene.RemoveNode(stream)
    assert scene.GetNumberOfNodes() == before
    assert no_thread_is_left()


def _resident_mb() -> float:
    with open("/proc/self/statm", encoding="ascii") as stream:
        return int(stream.read().split()[1]) * 4096 / 2**20


def no_thread_is_left(timeout_s: float = 30.0) -> bool:
    """Closing does not wait for a frame that is being registered: its thread ends soon after."""
    import threading

    end = time.monotonic() + timeout_s
    while any("ExpectedAppearances" in thread.name for thread in threading.enumerate()):
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True


def test_overlay_goes_when_frames_stop_and_returns_with_them(application, phantom, model, frames):
    scene, _logic = application
    poses, images = frames
    stream = node_with(scene, images[0])
    now = [100.0]
    controller = LiveController(scene, clock=lambda: now[0])
    controller.start(choice_of(phantom, stale_s=0.5), model=model)
    # What the stream held at the start may be of a stream that stopped yesterday.
    assert wait_for(controller, lambda s: s.new).verdict.sight is Sight.STALE
    assert not controller.live.overlay_visible and controller.status.latency_ms is None
    send(stream, images[1])
    assert wait_for(controller, lambda s: s.new).verdict.sight is Sight.FOLLOWING
    now[0] += 0.6
    assert controller.tick().verdict.sight is Sight.STALE
    assert not controller.live.overlay_visible
    send(stream, images[3])
    assert wait_for(controller, lambda s: s.new).verdict.sight is Sight.FOLLOWING
    assert controller.live.overlay_visible
    scene.RemoveNode(stream)
    now[0] += 0.6
    status = controller.tick()
    assert status.verdict.sight is Sight.LOST and "Stream" in status.verdict.detail
    node_with(scene, images[5])
    status = wait_for(controller, lambda s: s.new)
    assert status.verdict.sight is Sight.FOLLOWING
    assert add_of(phantom, poses[5], status.result.prediction.camera_from_world) < 0.3
    controller.close()


def test_a_picture_that_did_not_change_is_no_new_frame(application, frames):
    """A stream says so twice for each frame; what only seems to come anew would never get too old."""
    scene, _logic = application
    stream = node_with(scene, frames[1][0])
    came = []
    source = NodeFrames(scene, stream, came.append)
    for _again in range(3):
        stream.InvokeCustomModifiedEvent(stream.ImageDataModifiedEvent)
    assert len(came) == 1
    for image in frames[1][1:4]:
        send(stream, image)
        stream.InvokeCustomModifiedEvent(stream.ImageDataModifiedEvent)
    assert [frame.number for frame in came] == [0, 1, 2, 3]
    source.close()


def test_the_picture_that_is_shown_is_no_source(application, phantom, model, frames):
    """It changes with each frame that is shown: an old picture would be new for ever."""
    scene, _logic = application
    node_with(scene, frames[1][0])
    controller = LiveController(scene)
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: s.new)
    own = controller.live.frame.GetID()
    controller.stop()
    with pytest.raises(InputError, match="Microscope frame: is the picture that this panel shows"):
        controller.start(choice_of(phantom, node_name=own), model=model)
    assert not controller.running
    controller.close()


def test_a_stream_that_returns_is_told_from_a_view_of_its_name_and_from_the_panels_own_picture(application, frames):
    """The layout's slice is called Microscope, as many a stream is."""
    scene, _logic = application
    for class_name, own in (("vtkMRMLSliceNode", False), ("vtkMRMLVectorVolumeNode", True)):
        same_name = scene.AddNewNodeByClass(class_name, "Stream")
        if own:
            same_name.SetAttribute("ExpectedAppearances.Live", "frame")
            send(same_name, frames[1][7])
    stream = node_with(scene, frames[1][0])
    came = []
    source = NodeFrames(scene, stream, came.append)
    scene.RemoveNode(stream)
    assert source.look().state is FeedState.LOST
    node_with(scene, frames[1][1])
    assert source.look().state is FeedState.RUNNING
    assert [np.array_equal(came[-1].image_rgb, frames[1][i]) for i in (1, 7)] == [True, False]
    source.close()


def test_a_single_step_takes_what_a_volume_holds_that_does_not_change_any_more(application, phantom, model, frames):
    scene, _logic = application
    stream = node_with(scene, frames[1][0])
    now = [100.0]
    controller = LiveController(scene, clock=lambda: now[0])
    controller.start(choice_of(phantom), model=model)
    wait_for(controller, lambda s: s.new)
    send(stream, frames[1][1])
    wait_for(controller, lambda s: s.new)
    now[0] += 7.0
    controller.next_frame()
    now[0] += 0.3  # the next one may still come
    assert not any(controller.tick(0.01).new for _ in range(20))
    now[0] += 0.3
    status = wait_for(controller, lambda s: s.new)
    assert status.verdict.sight is Sight.FROZEN and status.verdict.age_s == pytest.approx(7.6)
    np.testing.assert_array_equal(shown_pixels(controller.live), frames[1][1])
    now[0] += 60
    assert not any(controller.tick(0.01).new for _ in range(5))
    controller.close()


def test_pictures_that_cannot_be_decoded_are_no_new_frames(application, frames):
    """The node's image is then still the one before, and counts as changed: it would never get too old."""
    scene, _logic = application
    encoder = scene.AddNewNodeByClass("vtkMRMLStreamingVolumeNode", "Encoder")
    encoder.SetCodecFourCC("RV24")

    def compressed(image):
        send(encoder, image)
        assert encoder.EncodeImageData(True)
        return encoder.GetFrame()

    stream = scene.AddNewNodeByClass("vtkMRMLStreamingVolumeNode", "Stream")
    came = []
    source = NodeFrames(scene, stream, came.append)
    stream.SetAndObserveFrame(compressed(frames[1][0]))
    assert len(came) == 1 and not source.look().problem
    unknown = compressed(frames[1][1])
    unknown.SetCodecFourCC("????")
    stream.SetAndObserveFrame(unknown)
    assert len(came) == 1 and "cannot be decoded" in source.look().problem
    stream.SetAndObserveFrame(compressed(frames[1][2]))
    assert len(came) == 2 and not source.look().problem
    np.testing.assert_array_equal(came[1].image_rgb, frames[1][2])
    source.close()


@pytest.mark.parametrize("removed", ["frame", "Vessels", "outline"])
def test_nodes_that_the_user_removed_are_there_again_after_a_start(application, phantom, model, frames, removed):
    scene, _logic = application
    stream = node_with(scene, frames[1][0])
    controller = LiveController(scene)
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: s.new)
    live = controller.live
    scene.RemoveNode(live.frame if removed == "frame" else (live.models | live.lines)[removed])
    send(stream, frames[1][2])
    status = wait_for(controller, lambda s: s.new)
    assert status.verdict.sight is Sight.FAILED and "removed" in status.verdict.detail
    assert not controller.live.overlay_visible
    controller.stop()
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: s.new)
    send(stream, frames[1][1])
    assert wait_for(controller, lambda s: s.new).verdict.sight is Sight.FOLLOWING
    live = controller.live
    assert all(scene.IsNodePresent(n) for n in (live.frame, *live.models.values(), *live.lines.values()))
    assert len([n for n in scene.GetNodesByName("Vessels")]) == 1
    controller.close()


@pytest.mark.parametrize(
    "garbage",
    [
        np.zeros((240, 320, 3), np.uint8),
        np.full((240, 320, 3), 77, np.uint8),
        np.random.default_rng(0).integers(0, 255, (200, 320, 3), dtype=np.uint8),
        np.random.default_rng(0).integers(0, 255, (8, 8, 3), dtype=np.uint8),
        np.random.default_rng(0).integers(0, 255, (240, 320, 2), dtype=np.uint8),
    ],
    ids=["black", "one colour", "other aspect", "tiny", "two values"],
)
def test_garbage_is_said_and_recovered_from(application, phantom, model, frames, garbage):
    scene, _logic = application
    stream = node_with(scene, frames[1][0])
    controller = LiveController(scene)
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: s.new)
    send(stream, garbage)
    status = wait_for(controller, lambda s: s.new)
    assert status.verdict.sight is Sight.UNUSABLE and status.verdict.detail
    assert not controller.live.overlay_visible
    send(stream, frames[1][4])
    status = wait_for(controller, lambda s: s.new)
    assert status.verdict.sight is Sight.FOLLOWING
    np.testing.assert_array_equal(shown_pixels(controller.live), frames[1][4])
    controller.close()


@pytest.mark.skipif(sys.platform != "linux", reason="sleeps in libc with Python's lock held")
def test_frames_are_registered_although_the_gui_holds_pythons_lock_between_ticks(application, phantom, model, frames):
    import ctypes

    from ExpectedAppearancesLib.live.frames import LiveFrame

    scene, _logic = application
    node_with(scene, frames[1][0])
    controller = LiveController(scene)
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: not controller.loading)
    holding = ctypes.PyDLL(None)  # unlike CDLL, it keeps the lock, as Slicer's event loop does
    shown = 0
    for number in range(400):
        controller._session.push(LiveFrame(frames[1][number % 12], time.monotonic(), number))
        shown += controller.tick(0.008).new
        holding.usleep(4000)
        if shown == 5:
            break
    assert shown == 5
    controller.close()


def test_frames_may_change_their_size_in_mid_stream(application, phantom, model, frames):
    import cv2

    scene, _logic = application
    stream = node_with(scene, frames[1][0])
    controller = LiveController(scene)
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: s.new)
    send(stream, cv2.resize(frames[1][4], (640, 480), interpolation=cv2.INTER_LINEAR))
    status = wait_for(controller, lambda s: s.new)
    assert controller.camera.width == 640
    assert add_of(phantom, frames[0][4], status.result.prediction.camera_from_world) < 0.5
    controller.close()


def test_freezing_holds_the_frame_and_a_single_step_takes_the_next(application, phantom, model, frames):
    scene, _logic = application
    stream = node_with(scene, frames[1][0])
    controller = LiveController(scene)
    controller.start(choice_of(phantom, stale_s=60), single=True, model=model)
    assert wait_for(controller, lambda s: s.new).verdict.sight is Sight.FROZEN
    for i in (1, 2):
        send(stream, frames[1][i])
    time.sleep(0.1)
    controller.tick(0.05)
    np.testing.assert_array_equal(shown_pixels(controller.live), frames[1][0])
    controller.next_frame()
    send(stream, frames[1][3])
    assert wait_for(controller, lambda s: s.new).verdict.sight is Sight.FROZEN
    np.testing.assert_array_equal(shown_pixels(controller.live), frames[1][3])
    controller.resume()
    send(stream, frames[1][4])
    assert wait_for(controller, lambda s: s.new).verdict.sight is Sight.FOLLOWING
    controller.close()


def test_steps_through_registered_frames_one_by_one(application, phantom, frames, tmp_path):
    scene, _logic = application
    entries = []
    for i in range(4):
        files.write_png(tmp_path / f"{i}.png", frames[1][i])
        accepted = i != 2
        entries.append({"image": tmp_path / f"{i}.png", "camera_from_world": frames[0][i], "accepted": accepted})
    write_poses(tmp_path / "poses.json", SMALL, entries)
    controller = LiveController(scene)
    choice = choice_of(phantom, kind=SourceKind.PATH, path=str(tmp_path / "poses.json"), rate_hz=500)
    controller.start(choice, single=True)
    for i in range(4):
        if i:
            controller.next_frame()
        status = wait_for(controller, lambda s: s.new)
        assert status.result.frame.name == f"{i}.png"
        assert status.verdict.sight is (Sight.REFUSED if i == 2 else Sight.FROZEN)
        np.testing.assert_allclose(status.result.prediction.camera_from_world, frames[0][i], atol=1e-9)
    controller.close()


def test_registered_frames_are_shown_as_they_were_registered(application, phantom, frames, tmp_path):
    """What was set for a microscope before, its camera and that it sends the lowest row first, is not theirs."""
    scene, _logic = application
    files.write_png(tmp_path / "0.png", frames[1][0])
    poses = [{"image": tmp_path / "0.png", "camera_from_world": frames[0][0]}]
    write_poses(tmp_path / "poses.json", SMALL, poses)
    write_camera(tmp_path / "camera.json", replace(SMALL, fx=1.1 * SMALL.fx, fy=1.1 * SMALL.fy))
    of_another = {"camera_path": str(tmp_path / "camera.json"), "frames": FrameSettings(flip_rows=True)}
    controller = LiveController(scene)
    choice = choice_of(phantom, kind=SourceKind.PATH, path=str(tmp_path / "poses.json"), **of_another)
    controller.start(choice)
    assert wait_for(controller, lambda s: s.new).verdict.sight is Sight.FROZEN
    np.testing.assert_array_equal(shown_pixels(controller.live), frames[1][0])
    assert controller.camera.matrix == pytest.approx(SMALL.matrix)
    controller.close()


def test_scene_close_in_mid_stream_leaves_nothing_and_the_next_session_works(application, phantom, model, frames):
    scene, _logic = application
    stream = node_with(scene, frames[1][0])
    controller = LiveController(scene)
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: s.new)
    controller.start_recording()
    send(stream, frames[1][1])
    scene.Clear(False)
    controller.forget_scene()
    assert controller.tick().verdict.sight is Sight.IDLE
    assert no_thread_is_left()
    after_close = scene.GetNumberOfNodes()
    stream = node_with(scene, frames[1][2])
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: s.new)
    send(stream, frames[1][3])
    assert wait_for(controller, lambda s: s.new).verdict.sight is Sight.FOLLOWING
    controller.close()
    scene.RemoveNode(stream)
    assert scene.GetNumberOfNodes() == after_close


def test_a_model_of_another_case_is_refused(phantom, tmp_path):
    import shutil

    other = make_phantom(tmp_path / "other", seed=1)
    shutil.rmtree(other.case.model_folder)
    shutil.copytree(phantom.case.model_folder, other.case.model_folder)
    with pytest.raises(InputError, match="vessels of another case"):
        open_model(other.case)


def test_vessels_of_the_patient_who_is_planned_are_not_seen_over_another_ones_picture(
    application, phantom, model, frames, tmp_path
):
    """Both heads lie about the middle of Slicer's world: the view through the camera drew both, in one colour."""
    scene, _logic = application
    node_with(scene, frames[1][0])
    planning = slicer.vtkMRMLScriptedModuleNode()
    planning.SetSingletonTag("ExpectedAppearances")
    planning = scene.AddNode(planning)
    planned = {role: scene.AddNewNodeByClass("vtkMRMLModelNode") for role in ("vesselsNode", "cortexModel")}
    for role, node in planned.items():
        node.CreateDefaultDisplayNodes()
        planning.SetNodeReferenceID(role, node.GetID())
    controller = LiveController(scene)
    for folder, seen in ((phantom.case.folder, True), (tmp_path, False)):  # the second time the case is open already
        planning.SetParameter("casePath", str(folder))
        controller.start(choice_of(phantom, stale_s=60), model=model)
        wait_for(controller, lambda s: s.new)
        assert [bool(node.GetDisplayVisibility()) for node in planned.values()] == [seen] * 2
        assert controller.live.models["Vessels"].GetDisplayVisibility()
        controller.stop()
    controller.leave()
    assert all(node.GetDisplayVisibility() for node in planned.values())
    controller.close()


def test_frame_pose_and_overlay_change_while_nothing_is_drawn(application, phantom, model, frames):
    """A busy Slicer draws at the first change already: the new frame with the outline of the one before."""
    scene, _logic = application
    stream = node_with(scene, frames[1][0])
    controller = LiveController(scene)
    held, outside, inside = [0], [], []

    @contextlib.contextmanager
    def drawing_held():
        held[0] += 1
        yield
        held[0] -= 1

    controller.drawing_held = drawing_held
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: s.new)
    watched = (controller.live.frame, controller.live.transform, *controller.live.lines.values())
    watched += (controller.live.fill, controller.live.frustum)
    events = ("ModifiedEvent", slicer.vtkMRMLTransformableNode.TransformModifiedEvent)
    tags = [
        (n, n.AddObserver(e, lambda caller, _e: (inside if held[0] else outside).append(caller.GetName())))
        for n in watched
        for e in events
    ]
    send(stream, frames[1][1])
    wait_for(controller, lambda s: s.new)
    controller.freeze()
    controller.tick()
    start = controller.begin_alignment().camera_from_world
    controller.nudge(np.array([2.0, 0, 0]), np.zeros(3), start)
    controller.finish_alignment()
    controller.stop()
    for node, tag in tags:
        node.RemoveObserver(tag)
    assert len(inside) > 5
    assert outside == []
    controller.close()


def test_outline_stays_on_the_frame_when_the_frame_is_put_at_the_vessels(application, phantom, model, frames):
    """Aligning puts the frame exactly at the vessels' depth; what is drawn over it must go with it."""
    scene, _logic = application
    node_with(scene, frames[1][0])
    controller = LiveController(scene)
    controller.start(choice_of(phantom, stale_s=60), single=True, model=model)
    wait_for(controller, lambda s: s.new)
    live, before_mm = controller.live, controller.live.plane_mm
    live.put_plane_at(1.07 * before_mm)
    assert live.plane_mm != before_mm
    assert plane_of(live.frame) == pytest.approx(live.plane_mm)
    assert plane_of(live.fill) == pytest.approx(live.plane_mm)
    assert live.lines["outline"].GetPolyData().GetPoint(0)[2] == pytest.approx(live.plane_mm)
    controller.close()


def plane_of(volume) -> float:
    import vtk

    matrix = vtk.vtkMatrix4x4()
    volume.GetIJKToRASMatrix(matrix)
    return matrix.GetElement(2, 3)


def test_layout_is_added_once_under_a_free_id():
    node = slicer.vtkMRMLLayoutNode()
    node.AddLayoutDescription(live_views.FIRST_LAYOUT_ID, "<layout/>")
    first = live_views.add_layout(node)
    assert first == live_views.FIRST_LAYOUT_ID + 1 > 100
    assert live_views.add_layout(node) == first
    without = live_views.add_layout(node, with_mri=False)
    assert without not in (first, live_views.FIRST_LAYOUT_ID)
    assert live_views.MRI not in node.GetLayoutDescription(without)
    for layout_id in (first, without):
        assert node.GetLayoutDescription(layout_id).count("splitSize") == node.GetLayoutDescription(layout_id).count(
            "<item"
        )
