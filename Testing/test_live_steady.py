"""Poses steadied over time: what is drawn, what is said, and what is recorded."""

from __future__ import annotations

import gc
import time
from dataclasses import replace

import numpy as np
import pytest
from cases import write_inputs

from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.geometry.camera import Camera
from ExpectedAppearancesLib.geometry.pose import pose_from_rotation, rotation_matrix
from ExpectedAppearancesLib.live.frames import LiveFrame
from ExpectedAppearancesLib.live.recording import RecordedFrame, export_recording, from_note, to_note
from ExpectedAppearancesLib.live.session import LiveSession
from ExpectedAppearancesLib.live.steady import FOUND_S, Steadying, View, check_can_steady
from ExpectedAppearancesLib.live.trust import Sight
from ExpectedAppearancesLib.registration.poses_file import read_poses
from ExpectedAppearancesLib.registration.predictor import Prediction

INTERVAL_S = 0.1
SIGMA_MM, SIGMA_RAD = 0.6, 0.01
COVARIANCE = np.diag([SIGMA_RAD**2] * 3 + [SIGMA_MM**2] * 3)
CAMERA = Camera(320, 240, 700.0, 700.0, 160.0, 120.0)
REFUSED = Prediction(None, False, 0.1, 5.0)


def true_pose(time_s: float) -> np.ndarray:
    """The camera drifts at 4 mm/s over the case's origin, 120 mm away."""
    return pose_from_rotation(np.diag([1.0, -1.0, -1.0]), np.array([4.0 * time_s, 0.0, 120.0]))


def seen(time_s: float, rng, shift_mm=(0, 0, 0)) -> Prediction:
    """An accepted pose with an error as its covariance says."""
    true = true_pose(time_s)
    turn = rotation_matrix(rng.normal(0, SIGMA_RAD, 3))
    noisy = pose_from_rotation(turn @ true[:3, :3], true[:3, 3] + rng.normal(0, SIGMA_MM, 3) + shift_mm)
    return Prediction(noisy, True, 0.98, 5.0, COVARIANCE)


def test_what_is_drawn_trembles_less_than_the_frames_own_poses_and_lies_as_near():
    rng, steadying = np.random.default_rng(0), Steadying(np.zeros(3))
    own, drawn = [], []
    for number in range(150):
        time_s = number * INTERVAL_S
        prediction = seen(time_s, rng)
        steadied = steadying.update(time_s, prediction)
        if number >= 20 and steadied.camera_from_world is not None:
            own.append(prediction.camera_from_world[:3, 3] - true_pose(time_s)[:3, 3])
            drawn.append(steadied.camera_from_world[:3, 3] - true_pose(time_s)[:3, 3])
    assert len(drawn) > 125
    trembling = [np.abs(np.diff(errors, axis=0)).mean() for errors in (own, drawn)]
    assert trembling[1] < 0.75 * trembling[0]
    assert np.linalg.norm(drawn, axis=1).mean() < 0.95 * np.linalg.norm(own, axis=1).mean()


def test_a_pose_that_does_not_fit_is_not_drawn_and_no_guess_stands_in_for_it():
    rng, steadying = np.random.default_rng(1), Steadying(np.zeros(3))
    for number in range(20):
        steadied = steadying.update(number * INTERVAL_S, seen(number * INTERVAL_S, rng))
    assert steadied.view is View.FOLLOWING
    for prediction in (seen(2.0, rng, (0, 0, 15)), None, REFUSED):
        steadied = steadying.update(2.0 + INTERVAL_S * rng.uniform(0.1, 1), prediction)
        assert (steadied.view, steadied.camera_from_world) == (View.DOUBTED, None)
    assert steadying.update(2.2, seen(2.2, rng)).view is View.FOLLOWING


def test_the_view_is_lost_found_again_by_itself_and_said_for_a_while():
    rng, steadying = np.random.default_rng(2), Steadying(np.zeros(3))
    views = []
    for number in range(100):
        time_s = number * INTERVAL_S
        covered = 3.0 <= time_s < 5.0
        steadied = steadying.update(time_s, REFUSED if covered else seen(time_s, rng))
        views.append(steadied.view)
        assert (steadied.camera_from_world is not None) == (steadied.view in (View.FOLLOWING, View.FOUND))
    assert views[0] is View.LOST and views[3:30] == [View.FOLLOWING] * 27  # a beginning is no return
    assert views[30] is View.DOUBTED and views[49] is View.LOST
    found = [i * INTERVAL_S for i, view in enumerate(views) if view is View.FOUND]
    assert 5.0 < found[0] < 5.5  # three frames have to agree first
    assert found[-1] - found[0] == pytest.approx(FOUND_S, abs=2 * INTERVAL_S)
    assert views[-1] is View.FOLLOWING


class Scripted:
    """An estimator that gives the next of the predictions it was given."""

    gives_covariance = True

    class encoding:
        centre_world_mm = np.zeros(3)

    def __init__(self, predictions):
        self._left = list(predictions)

    def predict(self, _image, _camera=None) -> Prediction:
        return self._left.pop(0)


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    folder = tmp_path_factory.mktemp("steady")
    inputs = write_inputs(folder)
    return Case.create(folder / "case", inputs["vessels.vtp"], inputs["cortex.vtp"], CAMERA)


def run(case, predictions, times_s, steady=True, single=False):
    """Results and verdicts of a session that gets a frame at each time, one by one."""
    now = [0.0]
    image = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    session = LiveSession(case, Scripted(predictions), CAMERA, clock=lambda: now[0])
    session.steady = steady
    session.start(single=single)
    updates = []
    for number, time_s in enumerate(times_s):
        now[0] = time_s
        if single and number:
            session.next_frame()
        session.push(LiveFrame(image, time_s, number))
        update = session.tick(30.0)
        assert update.new is not None and update.new.frame.number == number
        updates.append(update)
    assert session.stop()
    return updates


def test_a_session_draws_the_filtered_pose_of_each_frame_and_keeps_both(case):
    rng = np.random.default_rng(3)
    times_s = [i * INTERVAL_S for i in range(60)]
    predictions = [REFUSED if 2.0 <= t < 3.5 else seen(t, rng) for t in times_s]
    updates = run(case, predictions, times_s)
    for time_s, prediction, update in zip(times_s, predictions, updates):
        result, drawn = update.new, update.new.camera_from_world
        assert result.prediction is prediction
        assert update.verdict.shows_overlay == (drawn is not None) == (result.overlay is not None)
        if drawn is not None:
            assert np.linalg.norm(drawn[:3, 3] - true_pose(time_s)[:3, 3]) < 4 * SIGMA_MM
            assert not np.allclose(drawn, prediction.camera_from_world)
    sights = [update.verdict.sight for update in updates]
    assert sights[1] is Sight.VIEW_LOST and sights[10] is Sight.FOLLOWING
    assert sights[20] is Sight.REFUSED and sights[34] is Sight.VIEW_LOST and sights[40] is Sight.FOUND


def test_unsteadied_and_single_frames_stand_for_themselves(case):
    rng = np.random.default_rng(4)
    predictions = [seen(0.0, rng), seen(10.0, rng, (0, 0, 10)), seen(20.0, rng)]
    for values in ({"steady": False}, {"single": True}):
        for prediction, update in zip(predictions, run(case, predictions, [0.0, 10.0, 20.0], **values)):
            assert update.new.steadied is None and update.verdict.shows_overlay
            np.testing.assert_array_equal(update.new.camera_from_world, prediction.camera_from_world)


def test_a_model_that_tells_no_covariance_is_refused():
    class Plain:
        gives_covariance = False

    with pytest.raises(InputError, match="does not tell how sure"):
        check_can_steady(Plain(), "model")
    check_can_steady(Scripted([]), "model")


def test_recorded_frames_keep_both_poses_and_replay_the_one_that_was_drawn(case, tmp_path):
    rng = np.random.default_rng(5)
    times_s = [i * INTERVAL_S for i in range(8)]
    results = [u.new for u in run(case, [seen(t, rng) for t in times_s[:-1]] + [REFUSED], times_s)]
    image = np.zeros((240, 320, 3), np.uint8)
    frames = []
    for result in results:
        shown = replace(result.prediction, accepted=result.accepted)
        frame = RecordedFrame(result.frame.taken_s, "", CAMERA, shown, image, result.steadied)
        frames.append(frame)
        read, _key = from_note(to_note(frame, "key"))
        np.testing.assert_array_equal(read.prediction.camera_from_world, result.prediction.camera_from_world)
        np.testing.assert_array_equal(read.camera_from_world, result.camera_from_world)
        assert read.steadied.view is result.steadied.view
    _camera, entries = read_poses(export_recording(tmp_path / "out", frames))
    for entry, result in zip(entries, results):
        np.testing.assert_array_equal(entry.camera_from_world, result.prediction.camera_from_world)
        assert entry.extra["tracking"]["used"] == (result.overlay is not None)
        if result.overlay is not None:
            np.testing.assert_array_equal(entry.extra["tracked_camera_from_world"], result.camera_from_world)


def test_python_does_not_look_through_all_its_objects_while_a_session_runs(case):
    """In 3D Slicer that takes 50 ms, at any time, on the GUI's thread as well."""
    session = LiveSession(case, Scripted([]), CAMERA)
    known = gc.get_freeze_count()
    session.start()
    assert gc.get_freeze_count() > known + 1000
    assert session.stop()
    assert gc.get_freeze_count() == 0


@pytest.mark.parametrize("go_on", [LiveSession.resume, LiveSession.next_frame])
def test_a_frame_that_came_as_another_was_held_is_not_shown_after_the_pause(case, go_on):
    image = np.zeros((240, 320, 3), np.uint8)
    session = LiveSession(case, Scripted([REFUSED] * 3), CAMERA, clock=lambda: 0.0)
    session.start()
    session.push(LiveFrame(image, 0.0, 0))
    assert session.tick(30.0).new.frame.number == 0
    session.freeze()
    session._worker.submit(LiveFrame(image, 0.0, 1))  # its push had looked just before
    while session._worker.counts.done < 2:
        time.sleep(0.002)
    go_on(session)
    session.push(LiveFrame(image, 0.0, 2))
    assert session.tick(30.0).new.frame.number == 2
    assert session.stop()
