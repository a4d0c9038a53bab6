from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from ExpectedAppearancesLib.geometry.camera import Camera
from ExpectedAppearancesLib.geometry.pose import pose_from_rotation, transform
from ExpectedAppearancesLib.registration.covariance import (
    UNCALIBRATED,
    CovarianceModel,
    calibrate_covariance,
    correlated,
    pose_error,
)
from ExpectedAppearancesLib.registration.pnp import PoseFit, fit_pose

CAMERA = Camera(128, 128, 240.0, 236.0, 66.0, 61.0)
CENTRE = np.array([30.0, -60.0, 45.0])


def view(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    turned = Rotation.from_rotvec(np.radians(30) * rng.uniform(-1, 1, 3)) * Rotation.from_euler("x", 180, degrees=True)
    rotation = turned.as_matrix()
    return pose_from_rotation(rotation, rng.uniform([-5, -5, 85], [5, 5, 130]) - rotation @ CENTRE)


def fit_of(true: np.ndarray, rng, sigma_mm: float, count: int = 400) -> PoseFit:
    """A fit whose points err in patches: what a network gets wrong it gets wrong for all its neighbours."""
    across = rng.uniform([-12, -19], [20, 13], (count, 2))
    points = CENTRE + np.column_stack([across, -0.01 * (across**2).sum(axis=1)])
    seen = transform(true, points)
    pixels = seen[:, :2] / seen[:, 2:] * [CAMERA.fx, CAMERA.fy] + [CAMERA.cx, CAMERA.cy]
    patches = rng.normal(size=(3, 3, 3))[tuple(((across + 16) // 12).astype(int).clip(0, 2).T)]
    return fit_pose(points + sigma_mm * patches, pixels, np.full(count, sigma_mm), CAMERA)


def simulated(count: int, seed: int):
    """Errors and `correlated` covariances of fits that are three times as good in some views as in others."""
    rng = np.random.default_rng(seed)
    errors, fits, independent = [], [], []
    for i in range(count):
        true = view(1000 * seed + i)
        fit = fit_of(true, rng, rng.uniform(0.2, 0.6))
        errors.append(pose_error(true, fit.camera_from_world, CENTRE))
        fits.append(correlated(fit, CENTRE))
        independent.append(fits[-1] / fit.residuals)
    return np.array(errors), np.array(fits), np.array(independent)


def normalised(errors, covariances) -> np.ndarray:
    return np.array([e @ np.linalg.solve(c, e) for e, c in zip(errors, covariances, strict=True)])


def test_calibrated_covariance_is_consistent_where_residuals_are_correlated():
    model = calibrate_covariance(*simulated(120, 1)[:2])
    errors, fits, independent = simulated(120, 2)
    # As if independent, a pose seems ten times better than it is.
    assert normalised(errors, independent).mean() > 60
    distances = normalised(errors, model.shared + model.scale * fits)
    assert distances.mean() == pytest.approx(6, rel=0.2)
    assert (distances > chi2.ppf(0.95, 6)).mean() < 0.11 and (distances < chi2.ppf(0.5, 6)).mean() < 0.62
    # A model from before calibration must not claim more than a calibrated one.
    assert normalised(errors, UNCALIBRATED.scale * fits).mean() < 3 and CovarianceModel.from_dict(None) is UNCALIBRATED


def test_covariance_is_about_the_cases_centre_in_camera_axes():
    """Against poses drawn from the fit's own covariance, about its points' centre, far from the case's centre."""
    rng = np.random.default_rng(3)
    spread = np.diag([0.01, 0.02, 0.03, 0.2, 0.3, 1.0])
    fit = PoseFit(view(4), CENTRE + np.array([25.0, -10.0, 3.0]), spread @ spread, 1.0, 1.0, 50)
    errors = []
    for _ in range(4000):
        drawn = spread @ rng.normal(size=6)
        rotation = Rotation.from_rotvec(drawn[:3]).as_matrix() @ fit.camera_from_world[:3, :3]
        middle = transform(fit.camera_from_world, fit.centre_world_mm[None])[0] + drawn[3:]
        true = pose_from_rotation(rotation, middle - rotation @ fit.centre_world_mm)
        errors.append(pose_error(true, fit.camera_from_world, CENTRE))
    sampled = np.cov(np.array(errors).T, bias=True)
    expected = correlated(fit, CENTRE) / 50
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(sampled / np.outer(size, size), expected / np.outer(size, size), atol=0.08)


def test_what_all_views_err_by_is_told_from_what_fits_tell():
    """Every view errs in depth and tilt, and by twice what its own fit says."""
    rng = np.random.default_rng(8)
    spread = np.diag([0.02, 0.02, 0.01, 0.1, 0.1, 1.5])
    spread[5, 0] = 0.8
    sizes = rng.uniform(0.2, 3.0, 500)
    own = np.diag([0.01, 0.01, 0.02, 0.5, 0.5, 0.3])
    errors = np.array([spread @ rng.normal(size=6) + 2 * s * own @ rng.normal(size=6) for s in sizes])
    model = calibrate_covariance(errors, np.array([s**2 * own @ own for s in sizes]))
    shared = spread @ spread.T
    size = np.sqrt(np.diag(shared) + np.diag(own) ** 2)
    np.testing.assert_allclose(model.shared / np.outer(size, size), shared / np.outer(size, size), atol=0.35)
    assert model.scale == pytest.approx(4.0, rel=0.15)
    lost = errors.copy()
    lost[:5] = [0.5, 0.5, 0.5, 20, 20, 60]
    blown = calibrate_covariance(lost, np.array([s**2 * own @ own for s in sizes]))
    assert (np.diag(blown.shared) < np.diag(model.shared) + 0.5 * size**2).all() and blown.scale < 5


def test_poses_without_fits_have_the_spread_of_their_errors():
    rng = np.random.default_rng(6)
    spread = np.diag([0.02, 0.03, 0.01, 0.5, 0.4, 2.0])
    spread[3, 1] = 0.4
    errors = rng.normal(size=(600, 6)) @ spread.T
    errors[:4] *= 15
    model = calibrate_covariance(errors, np.zeros((600, 6, 6)))
    size = np.sqrt(np.diag(spread @ spread.T))
    np.testing.assert_allclose(model.shared / np.outer(size, size), spread @ spread.T / np.outer(size, size), atol=0.15)
    again = CovarianceModel.from_dict(json.loads(json.dumps(model.to_dict())))
    np.testing.assert_allclose(again.covariance(None, CENTRE), model.shared)
    assert UNCALIBRATED.covariance(None, CENTRE) is None


def test_few_views_calibrate_nothing():
    errors, fits, _ = simulated(8, 7)
    assert calibrate_covariance(errors, fits) is UNCALIBRATED
    assert calibrate_covariance(np.zeros((0, 6)), np.zeros((0, 6, 6))) is UNCALIBRATED
