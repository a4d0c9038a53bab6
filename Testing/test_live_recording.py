"""Recordings of the live panel in a scene: replayed, exported, and of another case."""

from __future__ import annotations

import numpy as np
import pytest

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.demo.phantom import PhantomPainter, covered_frame, make_phantom
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.live.frames import LiveFrame
from ExpectedAppearancesLib.live.overlay import OverlayMaker
from ExpectedAppearancesLib.live.session import LiveResult
from ExpectedAppearancesLib.live.trust import Sight
from ExpectedAppearancesLib.registration.poses_file import read_poses
from ExpectedAppearancesLib.registration.predictor import Prediction

slicer = pytest.importorskip("slicer")

from live_cases import SMALL, camera_to_ras_of, choice_of, node_with, record, send, shown_pixels, wait_for  # noqa: E402
from mrml_views import SliceView, new_application  # noqa: E402
from vtkmodules.vtkCommonMath import vtkMatrix4x4  # noqa: E402

from ExpectedAppearancesLib.mrml import live_record  # noqa: E402
from ExpectedAppearancesLib.mrml.live_controller import LiveController  # noqa: E402
from ExpectedAppearancesLib.mrml.live_views import LiveViews  # noqa: E402
from ExpectedAppearancesLib.mrml.scene import camera_from_pixel  # noqa: E402


@pytest.fixture
def application():
    return new_application()


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


def test_another_recording_that_plays_gets_no_overlay_of_the_one_that_is_looked_at(application, phantom, model, frames):
    """Slicer's sequence toolbar may have another recording than the panel; both play into the same nodes."""
    scene, logic = application
    controller = LiveController(scene)
    first, _predicted = record(controller, scene, phantom, model, frames[1][:2])
    scene.RemoveNode(scene.GetFirstNodeByName("Stream"))
    second, _predicted = record(controller, scene, phantom, model, frames[1][6:8])
    first.SetSelectedItemNumber(0)
    assert controller.replay(first).verdict.shows_overlay
    for _again in range(2):
        second.SetPlaybackActive(True)
        second.SetSelectedItemNumber(1 - second.GetSelectedItemNumber())
        logic.sequences.UpdateProxyNodesFromSequences(second)
        assert not np.array_equal(shown_pixels(controller.live), frames[1][0])
        assert controller.replay(first).verdict.shows_overlay
        np.testing.assert_array_equal(shown_pixels(controller.live), frames[1][0])
        assert not second.GetPlaybackActive()
    first.SetPlaybackActive(True)  # its own may go on
    logic.sequences.UpdateProxyNodesFromSequences(first)
    controller.replay(first)
    assert first.GetPlaybackActive()
    controller.close()


def test_a_recording_that_is_moved_in_mid_stream_leaves_nothing_of_its_own(application, phantom, model, frames):
    """Slicer's toolbar plays into the live nodes: pixels were put back, but neither where the picture lies, for this
    frame and all that followed, nor the pose of one that was refused."""
    scene, logic = application
    controller = LiveController(scene)
    browser, _predicted = record(controller, scene, phantom, model, frames[1][:2])
    stream = scene.GetFirstNodeByName("Stream")
    large = np.kron(frames[1][4], np.ones((2, 2, 1), np.uint8))
    send(stream, large)
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: s.new)
    for image, following in ((large.copy(), True), (covered_frame(1, SMALL.resized(640, 480)), False)):
        send(stream, image)
        assert wait_for(controller, lambda s: s.new).verdict.shows_overlay == following
        pose = camera_to_ras_of(controller.live.transform)
        browser.SetSelectedItemNumber(1 - browser.GetSelectedItemNumber())
        logic.sequences.UpdateProxyNodesFromSequences(browser)
        controller.tick()
        np.testing.assert_array_equal(shown_pixels(controller.live), image)
        np.testing.assert_allclose(camera_to_ras_of(controller.live.transform), pose, atol=1e-9)
        placed = vtkMatrix4x4()
        controller.live.frame.GetIJKToRASMatrix(placed)
        placed = np.array([[placed.GetElement(i, j) for j in range(4)] for i in range(4)])
        expected = camera_from_pixel(controller.live.camera, controller.live.plane_mm)
        np.testing.assert_allclose(placed, expected, atol=1e-9)
    controller.close()


def test_a_session_starts_in_a_scene_whose_recording_cannot_be_shown_yet(application, phantom, model, frames):
    """As one from another computer, whose case is elsewhere there: views were laid out for a frame without a camera."""
    scene, logic = application
    controller = LiveController(scene)
    record(controller, scene, phantom, model, frames[1][:1])
    controller.forget_scene()
    view = SliceView(scene, logic, "Microscope", (160, 120))
    again = LiveController(scene, LiveViews(view.logic, lambda: None))
    for _stopped_before_the_first_frame in range(2):
        again.start(choice_of(phantom, stale_s=60), model=model)
        wait_for(again, lambda _s: not again.loading)
        again.fit_views()
        again.stop()
    again.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(again, lambda s: s.new)
    again.close()


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


def test_a_case_chosen_before_the_panel_is_entered_again_takes_the_last_frame_along(
    application, phantom, model, frames, tmp_path
):
    scene, _logic = application
    node_with(scene, frames[1][3])
    controller = LiveController(scene)
    controller.start(choice_of(phantom, stale_s=60), single=True, model=model)
    wait_for(controller, lambda s: s.new)
    controller.stop()
    other = make_phantom(tmp_path / "other", seed=1)
    assert not controller.restore(other.case.folder, controller.camera)
    assert controller.live.frame is None and controller.tick().verdict.sight is Sight.IDLE
    controller.close()


def test_a_recording_has_its_overlay_again_when_the_panel_is_entered_again(application, phantom, model, frames):
    scene, _logic = application
    controller = LiveController(scene)
    browser, _predicted = record(controller, scene, phantom, model, frames[1][:2])
    assert controller.replay(browser).verdict.shows_overlay
    controller.stop()  # as on leaving
    assert not controller.replay(browser).verdict.shows_overlay
    assert controller.restore(phantom.case.folder, controller.camera)
    assert controller.replay(browser).verdict.shows_overlay and controller.live.overlay_visible
    controller.close()


def test_a_recording_of_another_case_shows_no_overlay(application, phantom, model, frames, tmp_path):
    scene, _logic = application
    controller = LiveController(scene)
    browser, _predicted = record(controller, scene, phantom, model, frames[1][:2])
    other = make_phantom(tmp_path / "other", seed=1)
    controller.open_case(other.case.folder)
    assert controller.replay(browser).verdict.sight is Sight.OTHER_CASE
    assert not controller.live.overlay_visible
    with pytest.raises(InputError, match="another case"):  # whose world may have other axes
        live_record.export(browser, tmp_path / "out", other.case)
    assert not (tmp_path / "out").exists()
    controller.close()


@pytest.mark.parametrize("damaged", ["note", "case", "no case"])
def test_no_overlay_stays_where_a_recording_cannot_be_looked_at_any_more(application, phantom, model, frames, damaged):
    """Slicer plays its frames all the same, and they would have the overlay of the last one that could be."""
    scene, logic = application
    controller = LiveController(scene)
    browser, _predicted = record(controller, scene, phantom, model, frames[1][:2])
    browser.SetSelectedItemNumber(0)
    case = str(phantom.case.folder)
    assert controller.look_at(browser, case).verdict.shows_overlay
    browser.SetSelectedItemNumber(1)
    logic.sequences.UpdateProxyNodesFromSequences(browser)
    if damaged == "no case":
        assert controller.look_at(browser, "").verdict.sight is Sight.IDLE
    else:
        note = live_record._sequence(browser, "note").GetNthDataNode(1)
        whole = note.GetText()
        note.SetText("{}" if damaged == "note" else whole)
        with pytest.raises(InputError):
            controller.look_at(browser, str(phantom.case.folder.parent) if damaged == "case" else case)
        note.SetText(whole)
    assert not controller.live.overlay_visible and controller.tick().verdict.sight is Sight.IDLE
    assert controller.look_at(browser, case).verdict.shows_overlay and controller.live.overlay_visible
    controller.close()


@pytest.mark.parametrize("removed", ["frame", "transform"])
def test_a_recording_is_seen_again_although_the_user_removed_what_it_plays_into(
    application, phantom, model, frames, removed
):
    """Slicer makes such a node anew, under no transform."""
    scene, _logic = application
    controller = LiveController(scene)
    browser, _predicted = record(controller, scene, phantom, model, frames[1][:2])
    case = str(phantom.case.folder)
    controller.look_at(browser, case)
    scene.RemoveNode(getattr(controller.live, removed))
    assert controller.look_at(browser, case).verdict.shows_overlay
    np.testing.assert_array_equal(shown_pixels(controller.live), frames[1][1])
    assert controller.live.frame.GetParentTransformNode() is controller.live.transform
    controller.close()


def test_export_gives_poses_images_and_transforms(application, phantom, model, frames, tmp_path):
    scene, _logic = application
    controller = LiveController(scene)
    images = [frames[1][0], covered_frame(1, SMALL), frames[1][9]]
    browser, predicted = record(controller, scene, phantom, model, images)
    path = live_record.export(browser, tmp_path / "out", phantom.case)
    camera, exported = read_poses(path)
    assert camera == SMALL or (camera.width, camera.height) == (320, 240)
    for i, frame in enumerate(exported):
        np.testing.assert_array_equal(files.read_image_rgb(frame.image), images[i])
        assert frame.accepted == predicted[i].accepted
        transform = tmp_path / "out" / "transforms" / f"{i:05d}.tfm"
        assert transform.is_file() == frame.accepted
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


def test_a_recording_in_which_the_frames_changed_their_size_is_exported(application, phantom, model, frames, tmp_path):
    """One poses.json has one camera, and nobody can record again."""
    scene, _logic = application
    controller = LiveController(scene)
    large = np.repeat(np.repeat(frames[1][5], 2, axis=0), 2, axis=1)
    images = [frames[1][0], large, frames[1][9]]
    browser, predicted = record(controller, scene, phantom, model, images)
    folder = live_record.export(browser, tmp_path / "out", phantom.case)
    for name, items in (("camera_1", (0, 2)), ("camera_2", (1,))):
        camera, exported = read_poses(folder / name / "poses.json")
        assert len(exported) == len(items)
        for number, (item, frame) in enumerate(zip(items, exported)):
            np.testing.assert_array_equal(files.read_image_rgb(frame.image), images[item])
            assert images[item].shape == (camera.height, camera.width, 3)
            np.testing.assert_allclose(frame.camera_from_world, predicted[item].camera_from_world, atol=1e-12)
            assert (folder / name / "transforms" / f"{number:05d}.tfm").is_file()
    controller.close()


def test_a_refused_pose_is_exported_with_its_refusal_only(application, phantom, frames, tmp_path):
    """A transform's file has no place for it: loaded, it would look like any other."""
    scene, _logic = application
    controller = LiveController(scene)
    controller.open_case(phantom.case.folder)
    recorder = None
    for i, accepted in enumerate((True, False)):
        pose, image = frames[0][i], frames[1][i]
        overlay = OverlayMaker(phantom.case.vessels).make(SMALL, pose) if accepted else None
        frame, prediction = LiveFrame(image, float(i), i, f"{i}"), Prediction(pose, accepted, 0.5, 1.0)
        result = LiveResult(frame, phantom.case.vessels_sha256, image, SMALL, prediction, overlay)
        controller.live.show(result)
        recorder = recorder or live_record.Recorder(controller.live)
        assert recorder.add(result)
    _camera, exported = read_poses(live_record.export(recorder.finish(), tmp_path, phantom.case))
    assert [frame.accepted for frame in exported] == [True, False]
    assert all(frame.camera_from_world is not None for frame in exported)
    assert [path.name for path in (tmp_path / "transforms").iterdir()] == ["00000.tfm"]
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


def test_a_steadied_session_draws_and_records_the_filtered_pose(application, phantom, model, tmp_path):
    scene, _logic = application
    poses = [phantom.pose(0.1 + 0.001 * i) for i in range(8)]
    with PhantomPainter(phantom, SMALL) as painter:
        images = [painter.paint(pose) for pose in poses]
    images.insert(6, covered_frame(1, SMALL))
    now = [0.0]
    stream = node_with(scene, images[0])
    controller = LiveController(scene, clock=lambda: now[0])
    controller.start(choice_of(phantom, stale_s=60, steady=True), model=model)
    wait_for(controller, lambda s: s.new)
    send(stream, images[0])
    assert wait_for(controller, lambda s: s.new).verdict.sight is Sight.VIEW_LOST  # one frame is no motion yet
    controller.start_recording()
    drawn = []
    for image in images:
        now[0] += 0.1
        send(stream, image)
        status = wait_for(controller, lambda s: s.new)
        result, live = status.result, controller.live
        assert live.overlay_visible == status.verdict.shows_overlay == result.steadied.tracked.used
        if live.overlay_visible:
            expected = np.diag([-1.0, -1.0, 1.0, 1.0]) @ np.linalg.inv(result.camera_from_world)
            np.testing.assert_allclose(camera_to_ras_of(live.transform), expected, atol=1e-6)
            assert not np.allclose(result.camera_from_world, result.prediction.camera_from_world, atol=1e-6)
        drawn.append((live.overlay_visible, result.camera_from_world, result.prediction.camera_from_world))
    assert [visible for visible, _filtered, _own in drawn] == [False, True, True, True, True, True, False, True, True]
    controller.stop()
    (browser,) = live_record.recordings(scene)
    for item, (visible, filtered, _own) in enumerate(drawn):
        browser.SetSelectedItemNumber(item)
        status = controller.replay(browser)
        assert status.verdict.shows_overlay == visible == controller.live.overlay_visible
        if visible:
            expected = np.diag([-1.0, -1.0, 1.0, 1.0]) @ np.linalg.inv(filtered)
            np.testing.assert_allclose(camera_to_ras_of(controller.live.transform), expected, atol=1e-6)
    _camera, exported = read_poses(live_record.export(browser, tmp_path / "out", phantom.case))
    for entry, (visible, _filtered, own) in zip(exported, drawn):
        assert entry.extra["tracking"]["used"] == visible
        if visible:
            np.testing.assert_allclose(entry.camera_from_world, own, atol=1e-12)
    controller.close()
