"""Camera against cv2, against resampled images, and as files."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.geometry.camera import Camera, read_camera, undistorted, write_camera

DISTORTED = Camera(640, 480, 700.0, 720.0, 300.0, 260.0, (0.12, -0.2, 0.004, -0.003, 0.05))


def points_in_view(rng, count=50):
    return np.stack([rng.uniform(-60, 60, count), rng.uniform(-40, 40, count), rng.uniform(200, 300, count)], 1)


@pytest.mark.parametrize("length", [0, 4, 5, 8, 12, 14])
def test_projection_follows_opencv_distortion_formula(length):
    """Written out from OpenCV's documentation of the model (without tilt), not by cv2.projectPoints itself."""
    rng = np.random.default_rng(length)
    distortion = np.zeros(14)
    distortion[:length] = rng.uniform(-0.1, 0.1, length)
    distortion[12:] = 0  # tilted sensor: left to cv2
    camera = Camera(640, 480, 700.0, 720.0, 300.0, 260.0, tuple(distortion[:length]))
    points = points_in_view(rng)
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = x * x + y * y
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = distortion[:12]
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2**2
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2
    expected = np.stack([700.0 * xd + 300.0, 720.0 * yd + 260.0], 1)
    assert np.abs(camera.project(points) - expected).max() < 1e-6


def blob_centre(image):
    weights = image.astype(float)
    rows, columns = np.indices(image.shape)
    return np.array([(columns * weights).sum(), (rows * weights).sum()]) / weights.sum()


@pytest.mark.parametrize("size", [(320, 240), (1280, 960), (200, 333)])
def test_resized_camera_matches_the_resampled_image(size):
    """A smooth blob drawn where the camera projects a point lies, after cv2.resize, where the resized camera says."""
    camera = Camera(640, 480, 700.0, 720.0, 300.0, 260.0)
    point = np.array([[21.0, -33.0, 250.0]])
    u, v = camera.project(point)[0]
    rows, columns = np.indices((480, 640))
    image = np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 6.0**2)).astype(np.float32)
    resampled = cv2.resize(image, size, interpolation=cv2.INTER_AREA if size[0] < 640 else cv2.INTER_LINEAR)
    expected = blob_centre(resampled)
    assert np.abs(camera.resized(*size).project(point)[0] - expected).max() < 0.05


def test_resizing_there_and_back_changes_nothing():
    back = DISTORTED.resized(123, 777).resized(640, 480)
    assert np.allclose(list(back.to_dict().values())[:6], list(DISTORTED.to_dict().values())[:6])
    assert back.distortion == DISTORTED.distortion


def test_cropped_camera_matches_the_cropped_image():
    points = points_in_view(np.random.default_rng(1))
    cropped = DISTORTED.cropped(100, 40, 300, 200)
    assert (cropped.width, cropped.height) == (300, 200)
    assert np.allclose(cropped.project(points), DISTORTED.project(points) - [100, 40])


def test_field_of_view_is_seen_from_edge_to_edge():
    camera = Camera.from_field_of_view(800, 600, field_of_view_mm=40.0, working_distance_mm=250.0)
    edges = camera.project(np.array([[-20.0, 0, 250.0], [20.0, 0, 250.0], [0, -15.0, 250.0], [0, 15.0, 250.0]]))
    assert np.allclose(edges, [[-0.5, 299.5], [799.5, 299.5], [399.5, -0.5], [399.5, 599.5]])
    assert camera.field_of_view_mm(250.0) == pytest.approx(30.0)  # the shorter side


def test_camera_json_round_trip_in_a_folder_with_umlauts(tmp_path):
    path = tmp_path / "Kalibrierung Übung" / "camera.json"
    write_camera(path, DISTORTED)
    assert read_camera(path) == DISTORTED


@pytest.mark.parametrize("name", ["calibration.yml", "Köln Ø.yml", "calibration.xml"])
def test_reads_what_opencv_calibration_writes(tmp_path, name):
    storage = cv2.FileStorage(str(tmp_path / f"plain{name[-4:]}"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", DISTORTED.matrix)
    storage.write("distortion_coefficients", np.array(DISTORTED.distortion).reshape(-1, 1))
    storage.release()
    path = (tmp_path / f"plain{name[-4:]}").rename(tmp_path / name)
    assert read_camera(path) == DISTORTED


def test_damaged_opencv_calibration_is_bad_input(tmp_path):
    path = tmp_path / "calibration.yml"
    for text in (
        "",
        "%YAML:1.0\n---\nimage_width: 640\n",
        "%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n   rows: 3\n",
    ):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=r"calibration\.yml"):
            read_camera(path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fisheye_model": 1, "distortion_coefficients": np.array([0.1, 0.01, 0.001, 0.0001])}, "fisheye"),
        ({"camera_matrix": np.array([[700.0, 25.0, 320.0], [0, 700, 240], [0, 0, 1]])}, "skew"),
        ({"camera_matrix": np.diag([700.0, 700.0, 2.0])}, "scaled"),
        ({"distortion_coefficients": None}, "'distortion_coefficients' is missing"),
    ],
)
def test_a_calibration_of_another_kind_of_camera_is_not_taken_for_opencvs_pinhole(tmp_path, change, words):
    usual = {
        "fisheye_model": 0,
        "image_width": 640,
        "image_height": 480,
        "camera_matrix": np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]]),
        "distortion_coefficients": np.array([0.1, 0.01, 0.001, 0.0001, 0.0]),
    }
    for name, values in (("usual.yml", usual), ("changed.yml", usual | change)):
        storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
        for key, value in values.items():
            if value is not None:
                storage.write(key, value)
        storage.release()
    assert read_camera(tmp_path / "usual.yml").distortion[0] == 0.1
    with pytest.raises(InputError, match=words):
        read_camera(tmp_path / "changed.yml")


@pytest.mark.parametrize("name", ["camera.json", "calibration.yml"])
def test_a_calibration_that_may_not_be_read_is_bad_input(tmp_path, monkeypatch, name):
    (tmp_path / name).touch()

    def refused(*_arguments, **_named):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(type(tmp_path), "read_text", refused)
    with pytest.raises(InputError, match=rf"{name}.*Permission denied"):
        read_camera(tmp_path / name)


def test_all_problems_of_a_camera_are_reported_at_once(tmp_path):
    with pytest.raises(InputError) as caught:
        Camera.from_dict(
            {"width": "wide", "height": 480, "fx": -1, "cx": 3, "cy": 4, "distortion": [1, 2, 3]}, "a.json"
        )
    text = str(caught.value)
    assert len(caught.value.problems) == 4
    assert all(name in text for name in ("'width'", "'fx'", "'fy'", "'distortion'"))
    assert all(problem.startswith("a.json") for problem in caught.value.problems)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"cx": 900.0}, "principal point"),
        ({"cy": -3.0}, "principal point"),
        ({"fx": 35.0}, "in px, not mm"),
        ({"fy": float("nan")}, "not a number"),
        ({"distortion": [0.1, float("nan"), 0.0, 0.0]}, "'distortion' must be a list of numbers"),
    ],
)
def test_intrinsics_that_do_not_fit_the_image(change, words):
    with pytest.raises(InputError, match=words):
        Camera.from_dict(DISTORTED.to_dict() | change)


def test_a_file_that_was_edited_on_windows_is_read(tmp_path):
    camera = Camera(640, 480, 900.0, 910.0, 320.0, 240.0)
    write_camera(tmp_path / "camera.json", camera)
    text = (tmp_path / "camera.json").read_text(encoding="utf-8")
    (tmp_path / "camera.json").write_bytes(text.replace("\n", "\r\n").encode("utf-8-sig"))
    assert read_camera(tmp_path / "camera.json").matrix.tolist() == camera.matrix.tolist()


def test_undistorted_frame_shows_a_point_where_the_ideal_camera_sees_it():
    camera = Camera(96, 96, 180.0, 180.0, 47.5, 47.5, (-0.9, 0.0, 0.0, 0.0, 0.0))
    point = np.array([[16.0, -14.0, 80.0]])
    image = np.zeros((96, 96, 3), np.uint8)
    cv2.circle(image, tuple(np.rint(camera.project(point)[0]).astype(int).tolist()), 2, (255, 255, 255), -1)
    rows, columns = np.nonzero(undistorted(image, camera)[..., 0] > 100)
    ideal = camera.without_distortion().project(point)[0]
    assert np.linalg.norm(ideal - camera.project(point)[0]) > 2
    np.testing.assert_allclose((columns.mean(), rows.mean()), ideal, atol=1)
