"""The live session on real MRML with the phantom's frames: poses right, nothing mixed, nothing left behind."""

from __future__ import annotations

import contextlib
import sys
import time

import numpy as np
import pytest

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.demo.phantom import CAMERA, PhantomPainter, covered_frame, make_phantom
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.evaluation.metrics import add_mm
from ExpectedAppearancesLib.live.choice import Choice, SourceKind
from ExpectedAppearancesLib.live.estimator import open_model
from ExpectedAppearancesLib.live.trust import Sight
from ExpectedAppearancesLib.registration.poses_file import read_poses, write_poses

slicer = pytest.importorskip("slicer")

from mrml_views import SliceView, ThreeDView, new_application  # noqa: E402

from ExpectedAppearancesLib.mrml import live_record, live_views  # noqa: E402
from ExpectedAppearancesLib.mrml.live_controller import LiveController  # noqa: E402
from ExpectedAppearancesLib.mrml.live_views import LiveViews  # noqa: E402

SMALL = CAMERA.resized(320, 240)


@pytest.fixture(scope="module")
def phantom(tmp_path_factory):
    return make_phantom(tmp_path_factory.mktemp("phantom") / "case")


@pytest.fixture(scope="module")
def model(phantom):
    return open_model(phantom.case)


@pytest.fixture(scope="module")
def frames(phantom):
    """Twelve poses and their frames; from one to the next the camera moves by centimetres."""
    poses = [phantom.pose(i / 12) for i in range(12)]
    with PhantomPainter(phantom, SMALL) as painter:
        return poses, [painter.paint(pose) for pose in poses]


@pytest.fixture
def application():
    return new_application()


def node_with(scene, image):
    """A vector volume as an OpenIGTLink connector makes it: no geometry, pixels only."""
    node = scene.AddNewNodeByClass("vtkMRMLVectorVolumeNode", "Stream")
    send(node, image)
    return node


def send(node, image):
    from ExpectedAppearancesLib.mrml.live_scene import _set_image

    _set_image(node, image)


def choice_of(phantom, **values) -> Choice:
    return Choice(**({"case_path": str(phantom.case.folder), "kind": SourceKind.NODE, "node_name": "Stream"} | values))


def wait_for(controller, condition, timeout_s=60.0):
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        status = controller.tick(0.005)
        if condition(status):
            return status
    raise AssertionError(f"did not happen: {controller.status}")


def add_of(phantom, true, predicted) -> float:
    return float(add_mm(phantom.case.vessels.vertices_mm, true[None], predicted[None])[0])


def camera_to_ras_of(node) -> np.ndarray:
    from vtk import vtkMatrix4x4

    matrix = vtkMatrix4x4()
    node.GetMatrixTransformToParent(matrix)
    return np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])


def shown_pixels(live) -> np.ndarray:
    from ExpectedAppearancesLib.mrml.live_stream import pixels_of

    return pixels_of(live.frame.GetImageData())


def test_three_hundred_frames_each_with_its_own_pose_and_nothing_left_over(application, phantom, model, frames):
    import gc

    scene, logic = application
    poses, images = frames
    view = SliceView(scene, logic, "Microscope", (320, 240))
    through = ThreeDView(scene, logic, "MicroscopeCamera", (160, 120))
    views = LiveViews(view.node, view.composite, lambda: (through.node, through.camera_node, (160, 120)))
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
    wait_for(controller, lambda s: s.new)
    assert controller.status.verdict.sight is Sight.FOLLOWING
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
    node_with(scene, frames[1][2])
    controller.start(choice_of(phantom, stale_s=60), model=model)
    assert wait_for(controller, lambda s: s.new).verdict.sight is Sight.FOLLOWING
    controller.close()
    scene.RemoveNode(scene.GetFirstNodeByName("Stream"))
    assert scene.GetNumberOfNodes() == after_close


def record(controller, scene, phantom, model, images):
    stream = node_with(scene, images[0])
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: s.new)
    controller.start_recording()
    poses = []
    for image in images:
        send(stream, image)
        prediction = wait_for(controller, lambda s: s.new).result.prediction
        poses.append(prediction)
    controller.stop()
    browser = live_record.recordings(scene)[-1]
    return browser, poses


def test_replay_of_a_saved_scene_gives_the_same_frames_and_poses(application, phantom, model, frames, tmp_path):
    scene, _logic = application
    images = [frames[1][0], frames[1][5], covered_frame(1, SMALL), frames[1][9]]
    controller = LiveController(scene)
    _browser, predicted = record(controller, scene, phantom, model, images)
    from ExpectedAppearancesLib.mrml.scene import write_bundle

    write_bundle(scene, tmp_path / "recorded.mrb")
    controller.close()

    import zipfile

    with zipfile.ZipFile(tmp_path / "recorded.mrb") as bundle:
        bundle.extractall(tmp_path / "unpacked")
    loaded, logic_of_loaded = new_application()
    loaded.SetURL(str(next((tmp_path / "unpacked").rglob("*.mrml"))))
    assert loaded.Connect()
    again = LiveController(loaded)
    (browser,) = live_record.recordings(loaded)
    assert browser.GetNumberOfItems() == 4
    # Files keep no attributes of what is recorded, and Slicer copies that onto the nodes as soon as it has loaded.
    played_into = [browser.GetProxyNode(live_record._sequence(browser, role)) for role in ("frame", "transform")]
    for node in played_into:
        node.RemoveAttribute("ExpectedAppearances.Live")
    again.open_case(phantom.case.folder)
    assert [again.live.frame, again.live.transform] == played_into
    for i in (0, 1, 2, 3, 1):
        browser.SetSelectedItemNumber(i)
        logic_of_loaded.sequences.UpdateProxyNodesFromSequences(browser)
        status = again.replay(browser)
        np.testing.assert_array_equal(shown_pixels(again.live), images[i])
        accepted = predicted[i].accepted
        assert status.verdict.shows_overlay == accepted == again.live.overlay_visible
        assert status.confidence == pytest.approx(predicted[i].confidence)
        if accepted:
            pose = predicted[i].camera_from_world
            np.testing.assert_allclose(status.result.prediction.camera_from_world, pose, atol=1e-12)
            expected = np.diag([-1.0, -1.0, 1.0, 1.0]) @ np.linalg.inv(pose)
            np.testing.assert_allclose(camera_to_ras_of(again.live.transform), expected, atol=1e-6)
    again.close()
    assert live_record.recordings(loaded)


def test_replay_shows_its_own_frame_after_the_session_went_on(application, phantom, model, frames):
    """Recording ends, the session does not: the frame it leaves must not be shown with the recorded pose."""
    scene, _logic = application
    stream = node_with(scene, frames[1][0])
    controller = LiveController(scene)
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: s.new)
    controller.start_recording()
    send(stream, frames[1][3])
    pose = wait_for(controller, lambda s: s.new).result.prediction.camera_from_world
    browser = controller.stop_recording()
    send(stream, frames[1][8])
    wait_for(controller, lambda s: s.new)
    controller.stop()
    for _again in range(2):
        assert controller.replay(browser).verdict.shows_overlay
        np.testing.assert_array_equal(shown_pixels(controller.live), frames[1][3])
        expected = np.diag([-1.0, -1.0, 1.0, 1.0]) @ np.linalg.inv(pose)
        np.testing.assert_allclose(camera_to_ras_of(controller.live.transform), expected, atol=1e-6)
        controller.start(choice_of(phantom, stale_s=60), model=model)  # its frames must not get into the recording
        send(stream, frames[1][6])
        wait_for(controller, lambda s: s.new)
        controller.stop()
    controller.close()


def test_a_loaded_scene_shows_its_last_frame_without_overlay(application, phantom, model, frames):
    scene, _logic = application
    node_with(scene, frames[1][3])
    controller = LiveController(scene)
    controller.start(choice_of(phantom, stale_s=60), single=True, model=model)
    wait_for(controller, lambda s: s.new)
    kept = controller.live
    pixels, matrix, camera = shown_pixels(kept), camera_to_ras_of(kept.transform), kept.camera
    controller.forget_scene()  # as after loading: the nodes are there, the session is not
    again = LiveController(scene)
    assert again.restore(phantom.case.folder, camera)
    np.testing.assert_array_equal(shown_pixels(again.live), pixels)
    np.testing.assert_allclose(again.live.camera_to_ras, matrix)
    assert not again.live.overlay_visible and again.live.plane_mm == pytest.approx(kept.plane_mm)
    again.close()
    assert not LiveController(scene).restore(phantom.case.folder, camera)


def test_a_recording_of_another_case_shows_no_overlay(application, phantom, model, frames, tmp_path):
    scene, _logic = application
    controller = LiveController(scene)
    browser, _predicted = record(controller, scene, phantom, model, frames[1][:2])
    other = make_phantom(tmp_path / "other", seed=1)
    controller.open_case(other.case.folder)
    assert controller.replay(browser).verdict.sight is Sight.OTHER_CASE
    assert not controller.live.overlay_visible
    controller.close()


def test_a_model_of_another_case_is_refused(phantom, tmp_path):
    import shutil

    other = make_phantom(tmp_path / "other", seed=1)
    shutil.rmtree(other.case.model_folder)
    shutil.copytree(phantom.case.model_folder, other.case.model_folder)
    with pytest.raises(InputError, match="vessels of another case"):
        open_model(other.case)


def test_export_gives_poses_images_and_transforms(application, phantom, model, frames, tmp_path):
    scene, _logic = application
    controller = LiveController(scene)
    images = [frames[1][0], covered_frame(1, SMALL), frames[1][9]]
    browser, predicted = record(controller, scene, phantom, model, images)
    path = live_record.export(browser, tmp_path / "out", phantom.case.space)
    camera, exported = read_poses(path)
    assert camera == SMALL or (camera.width, camera.height) == (320, 240)
    for i, frame in enumerate(exported):
        np.testing.assert_array_equal(files.read_image_rgb(frame.image), images[i])
        assert frame.accepted == predicted[i].accepted
        transform = tmp_path / "out" / "transforms" / f"{i:05d}.tfm"
        assert transform.is_file() == (predicted[i].camera_from_world is not None)
        if not frame.accepted:
            continue
        np.testing.assert_allclose(frame.camera_from_world, predicted[i].camera_from_world, atol=1e-12)
        storage, node = slicer.vtkMRMLTransformStorageNode(), slicer.vtkMRMLLinearTransformNode()
        storage.SetFileName(str(transform))
        assert storage.ReadData(node)
        expected = np.diag([-1.0, -1.0, 1.0, 1.0]) @ np.linalg.inv(frame.camera_from_world)
        np.testing.assert_allclose(camera_to_ras_of(node), expected, atol=1e-6)
    times = [frame.extra["time_s"] for frame in exported]
    assert times == sorted(times) and times[0] == 0
    controller.close()


def test_recording_ends_at_its_limit(application, phantom, model, frames):
    scene, _logic = application
    stream = node_with(scene, frames[1][0])
    controller = LiveController(scene)
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: s.new)
    controller.start_recording(limit_mb=2.5 * 320 * 240 * 3 / 2**20)
    for i in range(6):
        send(stream, frames[1][i])
        wait_for(controller, lambda s: s.new)
    assert controller.recorder.full and controller.recorder.frames == 3
    assert controller.stop_recording().GetNumberOfItems() == 3
    controller.close()


def test_alignment_by_handles_sliders_and_landmarks_gives_the_true_pose(application, phantom, model, frames):
    scene, _logic = application
    true = frames[0][2]
    node_with(scene, frames[1][2])
    controller = LiveController(scene)
    controller.start(choice_of(phantom, stale_s=60), single=True, model=model)
    wait_for(controller, lambda s: s.new)
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
        index = in_frame.AddControlPoint(0, 0, 0)
        in_frame.SetNthControlPointPosition(index, *(seen * controller.live.plane_mm / seen[2]))
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


def test_true_poses_are_collected_for_evaluation(application, phantom, model, frames, tmp_path):
    scene, _logic = application
    stream = node_with(scene, frames[1][2])
    controller = LiveController(scene)
    controller.start(choice_of(phantom, stale_s=60), single=True, model=model)
    wait_for(controller, lambda s: s.new)
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
