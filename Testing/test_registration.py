import json
import subprocess
import sys

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.geometry.camera import Camera
from ExpectedAppearancesLib.geometry.pose import geodesic_angle_rad, inverse, pose_from_rotation, transform
from ExpectedAppearancesLib.registration.confidence import calibrate, calibration_error
from ExpectedAppearancesLib.registration.contrast import ContrastAligner
from ExpectedAppearancesLib.registration.decoding import PlausibleView, cell_pixels, read_dense
from ExpectedAppearancesLib.registration.encoding import PoseEncoding, fit_encoding, network_camera
from ExpectedAppearancesLib.registration.pnp import fit_pose
from ExpectedAppearancesLib.registration.predictor import FORMAT_VERSION, Predictor, fitted_camera
from ExpectedAppearancesLib.registration.refinement import VesselAligner

CAMERA = Camera(128, 128, 240.0, 236.0, 66.0, 61.0)
CENTRE = np.array([30.0, -60.0, 45.0])


def pose(seed: int, spread_deg: float = 40.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(np.radians(spread_deg) * rng.uniform(-1, 1, 3)) * Rotation.from_euler(
        "x", 180, degrees=True
    )
    centre_camera = np.array([rng.uniform(-5, 5), rng.uniform(-5, 5), rng.uniform(80, 140)])
    return pose_from_rotation(rotation.as_matrix(), centre_camera - rotation.as_matrix() @ CENTRE)


def observed(true: np.ndarray, count: int = 600, seed: int = 0):
    """Points of a curved surface around CENTRE and their pixels, by cv2."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-18, 18, (count, 2))
    points = CENTRE + np.column_stack([xy, -0.01 * (xy**2).sum(axis=1)])
    pixels = cv2.projectPoints(points, cv2.Rodrigues(true[:3, :3])[0], true[:3, 3], CAMERA.matrix, None)[0][:, 0]
    return points, pixels


@pytest.mark.parametrize("seed", range(5))
def test_pose_is_exact_from_exact_points(seed):
    true = pose(seed)
    fit = fit_pose(*observed(true), np.full(600, 0.1), CAMERA)
    np.testing.assert_allclose(fit.camera_from_world, true, atol=1e-5)
    assert fit.inlier_share == 1.0


def test_pose_survives_a_third_of_wrong_points_and_uses_the_good_ones_weights():
    errors = []
    for seed in range(8):
        true, rng = pose(seed), np.random.default_rng(seed + 50)
        points, pixels = observed(true)
        sigma = np.where(np.arange(600) % 2, 0.1, 1.0)
        noisy = points + sigma[:, None] * rng.normal(size=points.shape)
        noisy[:200] = CENTRE + rng.uniform(-20, 20, (200, 3))
        fit = fit_pose(noisy, pixels, sigma, CAMERA)
        moved = transform(fit.camera_from_world, points) - transform(true, points)
        errors.append(np.linalg.norm(moved, axis=1).mean())
        assert fit.inlier_share < 0.85
    assert np.mean(errors) < 0.35


def test_covariance_predicts_the_spread_of_the_pose():
    true = pose(3)
    points, pixels = observed(true)
    middle = points.mean(axis=0)
    found, predicted = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        fit = fit_pose(points + 0.3 * rng.normal(size=points.shape), pixels, np.full(600, 0.3), CAMERA, seed)
        found.append(transform(fit.camera_from_world, middle[None])[0] - transform(true, middle[None])[0])
        predicted.append(np.diag(fit.covariance)[3:])
    ratio = np.std(found, axis=0) / np.sqrt(np.mean(predicted, axis=0))
    assert (ratio > 0.6).all() and (ratio < 1.7).all()
    # Depth is the weak direction.
    assert np.std(found, axis=0)[2] > 3 * np.std(found, axis=0)[:2].max()


def test_no_pose_from_points_that_agree_on_none():
    rng = np.random.default_rng(0)
    fit = fit_pose(rng.uniform(-20, 20, (600, 3)) + CENTRE, rng.uniform(0, 128, (600, 2)), np.full(600, 0.5), CAMERA)
    assert fit is None or fit.inlier_share < 0.2
    assert fit_pose(np.zeros((5, 3)), np.zeros((5, 2)), np.ones(5), CAMERA) is None


def test_encoding_is_undone_and_keeps_rotations_small():
    poses = np.stack([pose(i) for i in range(200)])
    encoding = fit_encoding(poses, CENTRE, 25.0)
    codes = np.stack([encoding.encode(p) for p in poses])
    # Every one of these rotations is near pi; relative to the reference none is near the cut.
    raw = Rotation.from_matrix(poses[:, :3, :3]).magnitude()
    assert raw.max() > 3.0 and np.linalg.norm(codes[:, :3], axis=1).max() < 1.8
    assert np.abs(codes[:, 3:].mean(axis=0)).max() < 0.2
    for p, code in zip(poses, codes, strict=True):
        np.testing.assert_allclose(encoding.decode(code), p, atol=1e-9)
    again = PoseEncoding.from_dict(json.loads(json.dumps(encoding.to_dict())))
    np.testing.assert_allclose(again.decode(codes[0]), poses[0], atol=1e-9)


def test_network_camera_sees_the_whole_frame_with_square_pixels():
    frame = Camera(1920, 1080, 3000.0, 3000.0, 1000.0, 500.0, (0.1, 0, 0, 0, 0))
    seen = network_camera(frame, 128)
    scale = 128 / 1920
    assert (seen.width, seen.height) == (128, 128) and seen.fx == pytest.approx(3000 * scale) and not seen.is_distorted
    # The corner of the frame, pixel edges, lies on the input's left edge and 28 px below its top.
    ray = [(-0.5 - 1000) / 3000, (-0.5 - 500) / 3000, 1.0]
    np.testing.assert_allclose(seen.project([ray])[0], [-0.5, 27.5], atol=0.01)


@pytest.mark.parametrize(("width", "height"), [(1280, 1024), (720, 576), (4096, 2160), (480, 720), (256, 256)])
def test_what_the_network_reads_is_its_camera_halved(width, height):
    """Frames are resampled at twice its size, then halved; half a row more or less is a millimetre of depth."""
    frame = Camera(width, height, 3000.0, 2990.0, width * 0.52, height * 0.47)
    halved, own = network_camera(frame, 256).resized(128, 128), network_camera(frame, 128)
    np.testing.assert_allclose(halved.matrix, own.matrix, rtol=1e-12)
    corners = (np.array([(0, 0), (width, height)]) - 0.5 - [frame.cx, frame.cy]) / [frame.fx, frame.fy]
    seen = own.project(np.column_stack([corners, np.ones(2)]))
    assert np.ptp(seen, axis=0).max() == pytest.approx(128) and seen.mean(axis=0) == pytest.approx([63.5, 63.5])


def dense_output(true: np.ndarray, encoding: PoseEncoding, grid: int = 64) -> np.ndarray:
    """What a perfect network would say of the plane z = CENTRE z, seen by CAMERA."""
    eye = inverse(true)
    pixels = cell_pixels(grid)
    rays = np.column_stack([(pixels - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy], np.ones(len(pixels))])
    directions = rays @ eye[:3, :3].T
    points = eye[:3, 3] + directions * ((CENTRE[2] - eye[2, 3]) / directions[:, 2])[:, None]
    surface = np.linalg.norm(points - CENTRE, axis=1) < 22
    output = np.full((6, grid, grid), -4.0, np.float32)
    output[:3] = ((points - CENTRE) / encoding.scale_mm).T.reshape(3, grid, grid)
    output[4] = np.where(surface, 6.0, -6.0).reshape(grid, grid)
    return output


def test_dense_output_is_read_in_the_right_pixels():
    true = pose(1)
    encoding = PoseEncoding(np.eye(3), CENTRE, 25.0, np.zeros(3), 1.0)
    # No vessel is seen in this output, nor in the black frame, so nothing is refined.
    vessels = CENTRE + 5 * np.eye(3), np.array([[0, 1, 2]])
    sharp = CAMERA.resized(2 * CAMERA.width, 2 * CAMERA.height)
    given = np.zeros((sharp.height, sharp.width, 3), np.uint8), CAMERA, encoding
    aligners = VesselAligner(*vessels, CAMERA), ContrastAligner(*vessels, sharp)
    reading = read_dense(dense_output(true, encoding), *given, *aligners)
    np.testing.assert_allclose(reading.camera_from_world, true, atol=2e-3)
    assert np.isfinite(reading.evidence).all()
    nothing = dense_output(true, encoding)
    nothing[4] = -6
    assert read_dense(nothing, *given, *aligners).camera_from_world is None


def test_confidence_is_calibrated_and_its_threshold_keeps_bad_poses_out():
    rng = np.random.default_rng(0)
    quality = rng.normal(size=4000)
    good = rng.uniform(size=4000) < 1 / (1 + np.exp(-(3 * quality + 2)))
    evidence = np.column_stack([quality * 5 - 3, rng.normal(size=4000)])
    confidence = calibrate(evidence[:2000], good[:2000])
    probability = np.array([confidence.probability(e) for e in evidence[2000:]])
    assert calibration_error(probability, good[2000:]) < 0.04
    accepted = probability >= confidence.threshold
    assert good[2000:][accepted].mean() > 0.97 and accepted.mean() > 0.3
    assert confidence.probability(None) == 0.0


def test_the_sure_frames_do_not_let_an_unsure_one_through():
    """Where evidence tells nearly all, 99 % of the accepted are good even with some at a probability of one half."""
    rng = np.random.default_rng(1)
    quality = np.concatenate([rng.normal(6, 1, 1500), rng.normal(-6, 1, 500), rng.normal(0, 0.3, 30)])
    good = np.concatenate([np.ones(1500, bool), np.zeros(500, bool), rng.uniform(size=30) < 0.5])
    confidence = calibrate(quality[:, None], good)
    assert confidence.threshold >= 0.9
    assert confidence.probability(np.array([0.0])) < confidence.threshold


def test_implausible_views_are_told():
    plausible = PlausibleView(CENTRE, np.array([0, 0, 1.0]), 60.0, (80.0, 140.0))
    from_above = pose_from_rotation(
        np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 100.0]) - np.diag([1.0, -1.0, -1.0]) @ CENTRE
    )
    assert plausible.holds(from_above)
    from_below = pose_from_rotation(np.eye(3), np.array([0, 0, 100.0]) - CENTRE)
    assert not plausible.holds(from_below)
    far = from_above.copy()
    far[2, 3] += 200
    assert not plausible.holds(far)


def test_camera_is_scaled_to_the_frame_and_refused_when_it_cannot_be():
    assert fitted_camera(CAMERA, 512, 512).fx == pytest.approx(960)
    with pytest.raises(InputError, match="aspect"):
        fitted_camera(CAMERA, 640, 480)


def test_missing_and_damaged_models_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"model\.json: trained model missing; run `train` first"):
        Predictor(tmp_path)
    meta = {"format_version": FORMAT_VERSION, "model_sha256": "0"}
    (tmp_path / "model.json").write_text(json.dumps(meta))
    with pytest.raises(InputError, match=r"model\.onnx: trained model missing; run `train` first"):
        Predictor(tmp_path)
    (tmp_path / "model.onnx").write_bytes(b"cut")
    with pytest.raises(InputError, match=r"damaged \(SHA-256 differs"):
        Predictor(tmp_path)
    for version, words in ((FORMAT_VERSION + 1, "newer version"), (FORMAT_VERSION - 1, "older version")):
        (tmp_path / "model.json").write_text(json.dumps(meta | {"format_version": version}))
        with pytest.raises(InputError, match=words):
            Predictor(tmp_path)


def test_registration_does_not_import_torch():
    code = (
        "import sys, ExpectedAppearancesLib.registration.predictor, ExpectedAppearancesLib.cli.register\n"
        "import ExpectedAppearancesLib.case.case, ExpectedAppearancesLib.registration.poses_file\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


def test_geodesic_angle_is_used_not_a_difference_of_vectors():
    first, second = Rotation.from_rotvec([0, 0, 3.1]), Rotation.from_rotvec([0, 0, -3.1])
    assert geodesic_angle_rad(first.as_matrix(), second.as_matrix()) == pytest.approx(2 * np.pi - 6.2, abs=1e-9)
