from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.geometry.camera import Camera, write_camera
from ExpectedAppearancesLib.registration.poses_file import read_poses, write_poses

CAMERA = Camera(640, 480, 900.0, 905.0, 300.0, 250.0, (0.1, -0.02, 0.0, 0.0, 0.0))
POSE = [[0.0, -1.0, 0.0, 4.0], [1.0, 0.0, 0.0, -2.5], [0.0, 0.0, 1.0, 310.0], [0.0, 0.0, 0.0, 1.0]]


def written(folder, value):
    path = folder / "poses.json"
    path.write_text(json.dumps(value), encoding="utf-8")
    return path


def test_round_trip_keeps_camera_poses_styles_and_other_keys(tmp_path):
    path = tmp_path / "out" / "poses.json"
    image = tmp_path / "frames" / "Bild ä.png"
    frames = [
        {"image": image, "camera_from_world": np.array(POSE), "style": "065", "accepted": True, "confidence": 0.9},
        {"image": str(tmp_path / "b.png"), "camera_from_world": None, "accepted": False},
    ]
    write_poses(path, CAMERA, frames)
    camera, (first, second) = read_poses(path)
    assert camera == CAMERA
    np.testing.assert_array_equal(first.camera_from_world, POSE)
    assert (first.image, first.style, first.accepted) == (image, "065", True)
    assert first.extra == {"accepted": True, "confidence": 0.9}
    assert second.camera_from_world is None and second.style is None and not second.accepted
    write_poses(path, camera, [first.to_dict(), second.to_dict()])
    assert read_poses(path)[1][0].extra == first.extra


def test_images_are_relative_to_the_file_so_the_folder_can_move(tmp_path):
    (tmp_path / "a").mkdir()
    write_poses(tmp_path / "a" / "poses.json", None, [{"image": tmp_path / "a/f/1.png", "camera_from_world": POSE}])
    stored = json.loads((tmp_path / "a" / "poses.json").read_text())["frames"][0]["image"]
    assert stored == "f/1.png"
    shutil.move(str(tmp_path / "a"), str(tmp_path / "b"))
    camera, (frame,) = read_poses(tmp_path / "b" / "poses.json")
    assert camera is None and frame.image == tmp_path / "b" / "f" / "1.png"


def test_relative_image_is_taken_from_the_working_folder_when_written(tmp_path, monkeypatch):
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    write_poses(tmp_path / "poses.json", None, [{"image": "x.png", "camera_from_world": POSE}])
    assert json.loads((tmp_path / "poses.json").read_text())["frames"][0]["image"] == "work/x.png"


def test_camera_may_be_a_path_relative_to_the_file(tmp_path):
    write_camera(tmp_path / "calibration" / "camera.json", CAMERA)
    value = {"camera": "calibration/camera.json", "frames": [{"image": "a.png", "camera_from_world": POSE}]}
    assert read_poses(written(tmp_path, value))[0] == CAMERA


def test_every_problem_is_reported_at_once(tmp_path):
    scaled, mirrored = np.array(POSE), np.array(POSE)
    scaled[:3, :3] *= 1.1
    mirrored[0] *= -1
    frames = [
        {"image": "scaled.png", "camera_from_world": scaled.tolist()},
        {"image": "mirrored.png", "camera_from_world": mirrored.tolist()},
        {"image": "small.png", "camera_from_world": [[1, 0], [0, 1]]},
        {"image": "words.png", "camera_from_world": "identity"},
        {"camera_from_world": POSE},
        {"image": "good.png", "camera_from_world": POSE},
        {"image": "./good.png", "camera_from_world": POSE},
    ]
    with pytest.raises(InputError) as caught:
        read_poses(written(tmp_path, {"camera": "missing.json", "frames": frames}))
    problems = caught.value.problems
    expected = ("missing.json", "scaled.png", "mirrored.png", "small.png", "words.png", "frame 4", "more than one")
    assert len(problems) == len(expected)
    assert all(
        (word in problem and "poses.json" in problem) or word == "missing.json"
        for word, problem in zip(expected, problems)
    )


@pytest.mark.parametrize("value", ["false", "", [], 2])
def test_what_is_neither_true_nor_false_is_not_taken_for_an_accepted_frame(tmp_path, value):
    frame = {"image": "a.png", "camera_from_world": POSE}
    for known in (True, False, None):
        assert read_poses(written(tmp_path, {"frames": [frame | {"accepted": known}]}))[1][0].accepted is bool(known)
    with pytest.raises(InputError, match=r"a\.png.*'accepted'.*without quotes"):
        read_poses(written(tmp_path, {"frames": [frame | {"accepted": value}]}))


@pytest.mark.parametrize("value", [[], {}, {"frames": {}}, {"frames": []}, {"frames": [3]}])
def test_files_without_frames_are_refused(tmp_path, value):
    with pytest.raises(InputError, match=r"poses\.json"):
        read_poses(written(tmp_path, value))


def test_missing_and_truncated_files_are_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.json.*not found"):
        read_poses(tmp_path / "none.json")
    path = written(tmp_path, {"frames": [{"image": "a.png", "camera_from_world": POSE}]})
    path.write_bytes(path.read_bytes()[:30])
    with pytest.raises(InputError, match=r"poses\.json"):
        read_poses(path)
