"""Poses by hand and their differences, and the notes of recorded frames; without MRML."""

from __future__ import annotations

import cases
import numpy as np
import pytest

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.geometry.camera import Camera
from ExpectedAppearancesLib.geometry.pose import look_at, transform
from ExpectedAppearancesLib.live import alignment, recording
from ExpectedAppearancesLib.registration.poses_file import read_poses
from ExpectedAppearancesLib.registration.predictor import Prediction

CAMERA = Camera(320, 240, 700.0, 690.0, 170.0, 108.0)
POSE = look_at(np.array([25.0, -18.0, 90.0]), np.array([1.0, 0.5, -2.0]), np.array([0.2, 1.0, 0.0]))


def noise(width=320, height=240, seed=0) -> np.ndarray:
    return np.random.default_rng(seed).integers(40, 255, (height, width, 3), dtype=np.uint8)


def test_landmarks_give_the_pose_and_say_how_well():
    points = cases.vessels().vertices_mm[::40][:8]
    pixels = CAMERA.project(transform(POSE, points))
    found = alignment.pose_from_landmarks(pixels, points, CAMERA)
    np.testing.assert_allclose(found.camera_from_world, POSE, atol=1e-5)
    assert found.rms_px < 1e-4
    shaken = pixels + np.random.default_rng(0).normal(0, 0.5, pixels.shape)
    found = alignment.pose_from_landmarks(shaken, points, CAMERA)
    again = CAMERA.project(transform(found.camera_from_world, points))
    np.testing.assert_allclose(found.errors_px, np.linalg.norm(again - shaken, axis=1))
    assert found.rms_px < 0.8


@pytest.mark.parametrize(
    "points, pixels, words",
    [
        (np.eye(3), np.eye(3)[:, :2], "at least 4"),
        (np.eye(5, 3), np.eye(4, 2), "5 on the mesh"),
        (np.outer(np.arange(5), [1, 2, 3]), np.random.default_rng(0).uniform(0, 200, (5, 2)), "one line"),
    ],
)
def test_landmarks_that_cannot_give_a_pose_are_refused(points, pixels, words):
    with pytest.raises(InputError, match=words):
        alignment.pose_from_landmarks(pixels, points, CAMERA)


def test_sliders_move_the_vessels_as_their_names_say():
    pivot = cases.vessels().centroid_mm
    moved = alignment.nudged(POSE, pivot, np.array([2.0, -1.0, 5.0]), np.zeros(3))
    np.testing.assert_allclose((moved - POSE)[:3, 3], [2, -1, 5])
    rolled = alignment.nudged(POSE, pivot, np.zeros(3), np.array([0, 0, 90.0]))
    np.testing.assert_allclose(transform(rolled, pivot[None]), transform(POSE, pivot[None]), atol=1e-9)
    right = transform(POSE, pivot[None]) + np.array([1.0, 0, 0])
    world = transform(np.linalg.inv(POSE), right)
    down = transform(rolled, world) - transform(rolled, pivot[None])
    np.testing.assert_allclose(down, [[0, 1, 0]], atol=1e-9)  # a quarter turn clockwise in the frame
    both = alignment.nudged(POSE, pivot, np.array([3.0, 1, -2]), np.array([10.0, -5, 20]))
    shift, turn = alignment.nudge_between(POSE, both, pivot)
    np.testing.assert_allclose(shift, [3, 1, -2], atol=1e-9)
    np.testing.assert_allclose(turn, [10, -5, 20], atol=1e-9)


def test_difference_of_poses():
    vertices = cases.vessels().vertices_mm
    moved = POSE.copy()
    moved[0, 3] += 2.0
    found = alignment.compare(vertices, POSE, moved, CAMERA)
    assert found.add_mm == pytest.approx(2.0) and found.translation_mm == pytest.approx(2.0)
    assert found.rotation_deg == pytest.approx(0, abs=1e-6)
    assert found.reprojection_px == pytest.approx(np.mean(2 * CAMERA.fx / transform(POSE, vertices)[:, 2]), rel=1e-6)


def test_notes_come_back_exactly_and_foreign_ones_are_refused():
    frame = recording.RecordedFrame(1.25, "ä 7", CAMERA, Prediction(POSE / 1.0, True, 0.123456789, 12.5))
    again, key = recording.from_note(recording.to_note(frame, "abc"))
    assert key == "abc" and again.name == "ä 7" and again.time_s == 1.25
    np.testing.assert_array_equal(again.prediction.camera_from_world, POSE)
    assert again.prediction.confidence == 0.123456789 and again.prediction.accepted
    unknown = recording.RecordedFrame(0.0, "b", CAMERA, Prediction(POSE, True, float("nan"), 0.0))
    assert np.isnan(recording.from_note(recording.to_note(unknown, "abc"))[0].prediction.confidence)
    for text in ("", "{}", '{"format": "x"}', recording.to_note(frame, "abc").replace("true", '"yes"')):
        if "yes" in text:
            assert not recording.from_note(text)[0].prediction.accepted
        else:
            with pytest.raises(InputError, match="record again"):
                recording.from_note(text)


def test_export_refuses_a_change_of_camera_and_an_empty_recording(tmp_path):
    frame = recording.RecordedFrame(0.0, "a", CAMERA, Prediction(POSE, True, 1.0, 1.0), noise())
    other = recording.RecordedFrame(
        0.0, "b", CAMERA.resized(160, 120), Prediction(POSE, True, 1.0, 1.0), noise(160, 120)
    )
    with pytest.raises(InputError, match="another size or camera"):
        recording.export_recording(tmp_path / "a", [frame, other])
    assert not (tmp_path / "a" / "poses.json").exists()
    with pytest.raises(InputError, match="no frame"):
        recording.export_recording(tmp_path / "b", [])


def test_a_true_pose_that_is_corrected_takes_the_place_of_the_one_before(tmp_path):
    """Both would count in `evaluate`, and the wrong one could not be taken out."""
    prediction = Prediction(POSE, True, 0.9, 1.0)
    frames = [recording.RecordedFrame(0.0, "f", CAMERA, prediction, noise(seed=i)) for i in (0, 1)]
    corrected = alignment.nudged(POSE, cases.vessels().centroid_mm, np.array([1.0, 2.0, 3.0]), np.zeros(3))
    recording.add_truth(tmp_path, frames[0], POSE)
    recording.add_truth(tmp_path, frames[1], POSE)
    _camera, saved = read_poses(recording.add_truth(tmp_path, frames[1], corrected))
    assert len(saved) == 2
    for frame, expected, pose in zip(saved, frames, (POSE, corrected)):
        np.testing.assert_array_equal(files.read_image_rgb(frame.image), expected.image_rgb)
        np.testing.assert_allclose(frame.camera_from_world, pose)


def test_true_poses_of_a_camera_whose_distortion_was_taken_out_are_collected_in_one_file(tmp_path):
    """As prepared frames are; a file writes no distortion as zeros."""
    camera = Camera(320, 240, 700.0, 690.0, 170.0, 108.0, (-0.2, 0.1, 0, 0, 0)).without_distortion()
    for number in range(2):
        frame = recording.RecordedFrame(0.0, "f", camera, Prediction(POSE, True, 0.9, 1.0), noise(seed=number))
        path = recording.add_truth(tmp_path, frame, POSE)
    assert len(read_poses(path)[1]) == 2
    other = recording.RecordedFrame(0.0, "f", camera.resized(160, 120), frame.prediction, noise(160, 120))
    with pytest.raises(InputError, match="another camera"):
        recording.add_truth(tmp_path, other, POSE)


def test_true_poses_are_not_mixed_with_registered_ones_or_with_those_of_another_case(tmp_path):
    frame = recording.RecordedFrame(0.0, "f", CAMERA, Prediction(POSE, True, 0.9, 1.0), noise())
    another = recording.RecordedFrame(0.1, "g", CAMERA, frame.prediction, noise(seed=1))
    recording.export_recording(tmp_path / "recording", [frame])
    recording.add_truth(tmp_path / "true", frame, POSE, "a" * 64)
    for folder, case, words in (("recording", "a", "registered, not true"), ("true", "b", "of another case")):
        before = (tmp_path / folder / "poses.json").read_bytes()
        with pytest.raises(InputError, match=words):
            recording.add_truth(tmp_path / folder, another, POSE, case * 64)
        assert (tmp_path / folder / "poses.json").read_bytes() == before
    assert len(read_poses(recording.add_truth(tmp_path / "true", another, POSE, "a" * 64))[1]) == 2
