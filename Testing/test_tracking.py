from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from ExpectedAppearancesLib.geometry.pose import geodesic_angle_rad, is_rigid, pose_from_rotation
from ExpectedAppearancesLib.registration.predictor import Prediction
from ExpectedAppearancesLib.registration.tracking import Tracker, TrackerSettings, TrackState

CENTRE = np.array([30.0, -60.0, 45.0])
# Errors of one frame in camera axes: depth is weak, and tilt goes with a shift, as in frames seen from above.
SPREAD = np.diag(np.r_[np.radians([2.0, 2.0, 1.0]), [0.4, 0.4, 1.5]])
SPREAD[3, 1], SPREAD[4, 0] = 0.3, -0.3
COVARIANCE = SPREAD @ SPREAD.T
# Errors in these simulations are independent from frame to frame.
SETTINGS = TrackerSettings(CENTRE, lasting_share=0.0)
INTERVAL_S = 0.04


def view(turn_rad, centre_camera_mm) -> np.ndarray:
    """camera_from_world that sees CENTRE at centre_camera_mm, turned from straight above."""
    rotation = (Rotation.from_rotvec(turn_rad) * Rotation.from_euler("x", 180, degrees=True)).as_matrix()
    return pose_from_rotation(rotation, np.asarray(centre_camera_mm) - rotation @ CENTRE)


def smooth_path(seed: int, count: int = 200) -> list[np.ndarray]:
    """A microscope moved by hand: turns by up to 20 degrees and moves by up to 12 mm, slowly."""
    rng = np.random.default_rng(seed)
    seconds = INTERVAL_S * np.arange(count)[:, None]
    waves = [np.sin(2 * np.pi * rng.uniform(0.03, 0.25, 6) * seconds + rng.uniform(0, 2 * np.pi, 6)) for _ in range(3)]
    total = sum(waves)
    return [view(np.radians(7) * w[:3], [0, 0, 110] + 4 * w[3:]) for w in total]


def seen(true: np.ndarray, rng, spread=SPREAD, accepted: bool = True, covariance=None) -> Prediction:
    error = spread @ rng.normal(size=6)
    rotation = Rotation.from_rotvec(error[:3]).as_matrix().T @ true[:3, :3]
    centre_camera_mm = true[:3, :3] @ CENTRE + true[:3, 3] - error[3:]
    pose = pose_from_rotation(rotation, centre_camera_mm - rotation @ CENTRE)
    return Prediction(pose, accepted, 0.99, 20.0, COVARIANCE if covariance is None else covariance)


def error_of(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    turn = Rotation.from_matrix(true[:3, :3] @ found[:3, :3].T).as_rotvec()
    return np.r_[turn, (true[:3, :3] - found[:3, :3]) @ CENTRE + true[:3, 3] - found[:3, 3]]


def squares(errors) -> np.ndarray:
    """Mean square of (tilt and roll in rad, translation in mm), (2,)."""
    mean = (np.array(errors) ** 2).mean(axis=0)
    return np.array([mean[:3].sum(), mean[3:].sum()])


def normalised(tracked, true) -> float:
    error = error_of(tracked.camera_from_world, true)
    return float(error @ np.linalg.solve(tracked.covariance, error))


def begun(true: np.ndarray, settings=SETTINGS, count: int = 25, rng=None) -> tuple[Tracker, float]:
    """A tracker that has seen a still view; and the time stamp of its last frame."""
    tracker, rng = Tracker(settings), rng or np.random.default_rng(7)
    for i in range(count):
        last = tracker.update(i * INTERVAL_S, seen(true, rng))
    assert last.state is TrackState.TRACKING
    return tracker, (count - 1) * INTERVAL_S


def far_off(rng) -> Prediction:
    """An accepted pose that is wrong by far, each time elsewhere."""
    return seen(view(rng.uniform(-0.9, 0.9, 3), rng.uniform([-15, -15, 80], [15, 15, 140])), rng)


def test_filtered_poses_are_closer_than_raw_ones_and_say_how_close():
    raw, filtered, distances = [], [], []
    for seed in range(4):
        rng, tracker = np.random.default_rng(seed), Tracker(SETTINGS)
        for i, true in enumerate(smooth_path(seed)):
            prediction = seen(true, rng)
            tracked = tracker.update(i * INTERVAL_S, prediction)
            if i < 3:
                continue
            assert is_rigid(tracked.camera_from_world, 1e-9)
            raw.append(error_of(prediction.camera_from_world, true))
            filtered.append(error_of(tracked.camera_from_world, true))
            distances.append(normalised(tracked, true))
    assert (squares(filtered) < 0.55 * squares(raw)).all()
    # Chi-square, 6 degrees of freedom: neighbouring frames share errors, so the bounds are wide.
    assert 4.0 < np.mean(distances) < 7.5
    assert np.mean(np.array(distances) > chi2.ppf(0.99, 6)) < 0.04


def test_a_still_view_is_averaged_and_does_not_drift():
    true = view([0.3, -0.2, 0.5], [4.0, -3.0, 100.0])
    tracker, rng = Tracker(SETTINGS), np.random.default_rng(1)
    errors = []
    for i in range(650):
        tracked = tracker.update(i * INTERVAL_S, seen(true, rng))
        if i >= 50:
            errors.append(error_of(tracked.camera_from_world, true))
    errors = np.array(errors)
    assert (np.abs(errors.mean(axis=0)) < 0.15 * np.sqrt(np.diag(COVARIANCE))).all()
    # The end is no worse than the beginning: the error neither grows nor wanders.
    first, last = squares(errors[:200]), squares(errors[-200:])
    assert (last < 1.6 * first).all() and (squares(errors) < 0.5 * squares([SPREAD @ e for e in np.eye(6)]) * 6).all()


def test_the_motion_between_frames_is_carried_on_where_frames_are_refused():
    """Half a second without frames, in a steady orbit with a shift: holding still would be 10 mm off."""
    rng, tracker = np.random.default_rng(2), Tracker(SETTINGS)
    path = [view([0.0, 0.012 * i, 0.0], [-20 + 0.8 * i, 0.0, 110.0]) for i in range(60)]
    held = None
    for i, true in enumerate(path):
        refused = 45 <= i < 57
        prediction = seen(true, rng, 0.3 * SPREAD, accepted=not refused, covariance=0.09 * COVARIANCE)
        tracked = tracker.update(i * INTERVAL_S, None if i in (46, 47) else prediction)
        if i == 44:
            held, before = tracked.camera_from_world, tracked.covariance
        if refused:
            assert tracked.state is TrackState.COASTING and not tracked.used
            growth = np.linalg.eigvalsh(tracked.covariance) > np.linalg.eigvalsh(before)
            assert growth.all()
            before = tracked.covariance
            assert normalised(tracked, true) < chi2.ppf(0.999, 6)
            if i == 56:
                carried = np.linalg.norm(error_of(tracked.camera_from_world, true)[3:])
                assert carried < 0.4 * np.linalg.norm(error_of(held, true)[3:])
    assert tracked.state is TrackState.TRACKING and normalised(tracked, true) < chi2.ppf(0.999, 6)


def test_a_refused_pose_is_never_used_however_good_it_looks():
    true = view([0, 0, 0.1], [0, 0, 100.0])
    tracker = Tracker(SETTINGS)
    for i in range(20):
        assert tracker.update(i * INTERVAL_S, seen(true, np.random.default_rng(i), accepted=False)).state == "lost"
        assert tracker.update(i * INTERVAL_S + 0.01, None).camera_from_world is None


def test_single_outliers_and_bursts_are_rejected():
    rng = np.random.default_rng(3)
    path = smooth_path(3, 250)
    tracker = Tracker(SETTINGS)
    wrong = set(range(30, 240, 9)) | set(range(100, 112)) | set(range(180, 195))
    elsewhere = view([0.5, 0.4, -0.6], [8.0, -6.0, 125.0])
    errors = []
    for i, true in enumerate(path):
        if i in wrong:
            # In the second burst all agree with each other, as on a vessel that looks like another.
            prediction = seen(elsewhere, rng) if i >= 180 else far_off(rng)
        else:
            prediction = seen(true, rng)
        tracked = tracker.update(i * INTERVAL_S, prediction)
        if i >= 3:
            assert tracked.used == (i not in wrong), i
            assert tracked.state == ("coasting" if i in wrong else "tracking")
            errors.append(error_of(tracked.camera_from_world, true))
            assert normalised(tracked, true) < 40
    assert np.linalg.norm(np.array(errors)[:, 3:], axis=1).max() < 6


def test_outliers_are_told_by_their_own_covariance():
    """The same difference is an outlier from a sharp frame and nothing new from a vague one, which moves it little."""
    true, moved = view([0, 0, 0], [0, 0, 100.0]), view([0, 0, 0], [6.0, 0, 100.0])
    rng = np.random.default_rng(0)
    tracker, time_s = begun(true)
    assert not tracker.update(time_s + 0.04, seen(moved, rng, 0 * SPREAD)).used
    vague = tracker.update(time_s + 0.08, seen(moved, rng, 0 * SPREAD, covariance=400 * COVARIANCE))
    assert vague.used and abs(error_of(vague.camera_from_world, true)[3]) < 1.0


def test_the_view_is_lost_and_found_again_without_help():
    rng = np.random.default_rng(4)
    first, second = view([0, 0, 0.1], [0, 0, 100.0]), view([-0.6, 0.5, 1.2], [10.0, 5.0, 130.0])
    tracker, time_s = begun(first)
    states = []
    for _ in range(40):  # something covers the field, 1.6 s
        time_s += INTERVAL_S
        states.append(tracker.update(time_s, seen(first, rng, accepted=False)).state)
    assert states[0] is TrackState.COASTING and states[-1] is TrackState.LOST
    assert states == sorted(states, key=["coasting", "lost"].index)
    assert 0.2 < INTERVAL_S * states.index(TrackState.LOST) <= SETTINGS.lost_after_s
    # Wrong poses that do not agree find nothing; the right ones among them do, once three of them agree.
    for _ in range(12):
        time_s += INTERVAL_S
        assert tracker.update(time_s, far_off(rng)).state is TrackState.LOST
    found = []
    for i in range(7):
        time_s += INTERVAL_S
        tracked = tracker.update(time_s, far_off(rng) if i in (1, 3) else seen(second, rng))
        found.append(tracked.state.value)
    assert found == ["lost"] * 4 + ["tracking"] * 3
    assert normalised(tracked, second) < chi2.ppf(0.999, 6)


def test_a_sudden_move_is_followed_after_the_limit():
    """The microscope is swung while poses stay accepted: the old track must not be held for ever."""
    rng = np.random.default_rng(5)
    tracker, time_s = begun(view([0, 0, 0.1], [0, 0, 100.0]))
    swung = view([0.7, 0, 0.1], [12.0, 0, 120.0])
    states = []
    for i in range(35):
        time_s += INTERVAL_S
        # The frame at which the limit is passed is an outlier: those before it agree, but it is not one of them.
        tracked = tracker.update(time_s, far_off(rng) if i == 18 else seen(swung, rng))
        states.append(tracked.state.value)
    assert states == ["coasting"] * 18 + ["lost"] + ["tracking"] * 16
    assert normalised(tracked, swung) < chi2.ppf(0.999, 6)


def test_a_track_does_not_begin_from_fewer_agreeing_frames_than_asked():
    true, rng = view([0, 0.2, 0], [0, 0, 90.0]), np.random.default_rng(6)
    tracker = Tracker(replace(SETTINGS, agreeing_frames=5))
    used = [tracker.update(i * INTERVAL_S, seen(true, rng)).used for i in range(7)]
    assert used == [False] * 4 + [True] * 3
    # Frames too far apart in time are no evidence of one motion.
    slow = Tracker(SETTINGS)
    assert all(slow.update(2.0 * i, seen(true, rng)).state is TrackState.LOST for i in range(8))


def test_large_turns_are_followed():
    """160 degrees about a slanted axis, past where a rotation vector would be cut."""
    rng, tracker = np.random.default_rng(8), Tracker(SETTINGS)
    axis = np.array([0.2, 0.3, 0.93])
    path = [view(np.radians(i * 0.8) * axis, [0, 0, 110.0]) for i in range(200)]
    assert np.degrees(geodesic_angle_rad(path[0][:3, :3], path[-1][:3, :3])) > 150
    distances = []
    for i, true in enumerate(path):
        tracked = tracker.update(i * INTERVAL_S, seen(true, rng))
        assert i < 3 or tracked.used
        if i > 25:
            distances.append(normalised(tracked, true))
    assert np.mean(distances) < 8


def test_frames_out_of_order_are_left_out_and_a_clock_set_back_begins_again():
    true, rng = view([0, 0, 0.1], [0, 0, 100.0]), np.random.default_rng(9)
    tracker, time_s = begun(true)
    before = tracker.update(time_s + INTERVAL_S, seen(true, rng))
    for late_s in (time_s + INTERVAL_S, time_s, time_s - 0.3):
        again = tracker.update(late_s, seen(true, rng))
        assert not again.used and again.state is TrackState.COASTING
        np.testing.assert_array_equal(again.camera_from_world, before.camera_from_world)
        np.testing.assert_array_equal(again.covariance, before.covariance)
    assert tracker.update(time_s + 2 * INTERVAL_S, seen(true, rng)).used
    other = view([0.5, 0, 0.1], [9.0, 0, 120.0])
    states = [tracker.update(-50 + i * INTERVAL_S, seen(other, rng)).state.value for i in range(4)]
    assert states == ["lost", "lost", "tracking", "tracking"]
    for wrong_s in (np.nan, np.inf):
        with pytest.raises(ValueError, match="not finite"):
            tracker.update(wrong_s, None)


def test_uneven_time_stamps_are_taken_as_they_are():
    """At a steady speed of 30 mm/s; taking frames as evenly spaced would be 4 mm off and reject them."""
    rng, tracker = np.random.default_rng(10), Tracker(SETTINGS)
    stamps = np.cumsum(rng.choice([0.02, 0.25], 60, p=[0.7, 0.3]))
    distances = []
    for i, time_s in enumerate(stamps - stamps[0]):
        true = view([0, 0, 0], [-50 + 30 * time_s, 0, 110.0])
        tracked = tracker.update(time_s, seen(true, rng))
        if i >= 10:
            assert tracked.used
            distances.append(normalised(tracked, true))
    assert np.mean(distances) < 8


def test_a_frames_covariance_stays_in_the_axes_of_the_camera():
    true = view([0.8, -0.5, 1.0], [4.0, 2.0, 105.0])
    trackers = [Tracker(replace(SETTINGS, lasting_share=share)) for share in (0.0, 1.0)]
    for i in range(8):
        without, whole = (t.update(i * INTERVAL_S, seen(true, np.random.default_rng(0), 0 * SPREAD)) for t in trackers)
    np.testing.assert_allclose(whole.covariance - without.covariance, COVARIANCE, atol=1e-9)


def test_errors_that_last_are_not_averaged_away():
    """Half of every frame's error is the same in all frames of a still view."""
    true = view([0, 0, 0.1], [0, 0, 100.0])
    honest, blind = [], []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        lasting = seen(true, rng, np.sqrt(0.5) * SPREAD).camera_from_world
        trackers = Tracker(TrackerSettings(CENTRE)), Tracker(SETTINGS)
        for i in range(25):
            prediction = seen(lasting, rng, np.sqrt(0.5) * SPREAD)
            told, untold = (t.update(i * INTERVAL_S, prediction) for t in trackers)
        honest.append(normalised(told, true))
        blind.append(normalised(untold, true))
    assert 3.5 < np.mean(honest) < 7 and np.mean(blind) > 8


@pytest.mark.parametrize("damage", [np.nan, -1.0])
def test_a_covariance_that_is_none_is_not_used(damage):
    true, rng = view([0, 0, 0.1], [0, 0, 100.0]), np.random.default_rng(11)
    tracker, time_s = begun(true)
    assert not tracker.update(time_s + 0.04, seen(true, rng, covariance=damage * np.eye(6))).used
    assert not tracker.update(time_s + 0.08, replace(seen(true, rng), covariance=None)).used
    assert not tracker.update(time_s + 0.12, Prediction(None, False, 0.0, 20.0)).used
    assert tracker.update(time_s + 0.16, seen(true, rng)).used
