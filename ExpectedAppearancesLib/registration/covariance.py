"""Covariance of a frame's pose, calibrated on synthetic validation views so that normalised errors are chi-square.

The error is (rotation vector, rad; translation of the case's centre, mm), (6,), in the axes of the camera:
R_true = exp(rotation vector) R, and R_true c + t_true = R c + t + translation, c the centre in world mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.pose import rotation_vector
from ..geometry.se3 import cross_matrix
from .pnp import PoseFit

LEAST_VIEWS = 60  # 22 numbers are fitted
LEFT_OUT = 0.02  # share of views, the worst: lost ones are for the confidence to refuse
ROUNDS = 200


@dataclass(frozen=True)
class CovarianceModel:
    """covariance = shared + scale x covariance of the fit as if all its residuals were one and the same error.

    shared (6, 6): what every view errs by, whatever its fit says; all there is where a pose is regressed without a fit.
    A network's residuals are all but one error, the same in many views: a fit's own covariance is tens of times too
    small in variance, and alone it tells little.
    """

    shared: np.ndarray
    scale: float

    def covariance(self, fit: PoseFit | None, centre_world_mm: np.ndarray) -> np.ndarray | None:
        """(6, 6); None where nothing is known, for a regressor whose training calibrated none."""
        if fit is None:
            return self.shared if self.shared.any() else None
        return self.shared + self.scale * correlated(fit, centre_world_mm)

    def to_dict(self) -> dict:
        return {"shared": self.shared.tolist(), "scale": self.scale}

    @staticmethod
    def from_dict(values: dict | None) -> CovarianceModel:
        """None: a model from before calibration, which gets a scale larger than any that was calibrated."""
        if values is None or "shared" not in values:
            return UNCALIBRATED
        return CovarianceModel(np.array(values["shared"], float), float(values["scale"]))


# A scale alone, calibrated on fits refined on the vessels of real-patient frames, came out at 24 to 35.
UNCALIBRATED = CovarianceModel(np.zeros((6, 6)), 40.0)


def correlated(fit: PoseFit, centre_world_mm: np.ndarray) -> np.ndarray:
    """(6, 6): covariance of the fit about the case's centre, as if its residuals were one and the same error."""
    lever_mm = fit.camera_from_world[:3, :3] @ (np.asarray(centre_world_mm) - fit.centre_world_mm)
    moved = np.eye(6)
    moved[3:, :3] = -cross_matrix(lever_mm)
    return fit.residuals * moved @ fit.covariance @ moved.T


def pose_error(true: np.ndarray, found: np.ndarray, centre_world_mm: np.ndarray) -> np.ndarray:
    """(6,): what turns and moves the found camera_from_world into the true one, as this module's text defines it."""
    turn = rotation_vector(true[:3, :3] @ found[:3, :3].T)
    return np.concatenate([turn, (true[:3, :3] - found[:3, :3]) @ centre_world_mm + true[:3, 3] - found[:3, 3]])


def calibrate_covariance(errors: np.ndarray, fits: np.ndarray) -> CovarianceModel:
    """Most likely model for errors (N, 6) of views whose fits have `correlated` covariance (N, 6, 6); 0 without a fit.

    Expectation maximisation over two independent Gaussian errors, one shared by all views and one of each fit; then
    both are scaled so that the mean normalised error is its expectation. Fewer than 60 views calibrate nothing.
    """
    if len(errors) < LEAST_VIEWS:
        return UNCALIBRATED
    model = _most_likely(errors, fits)
    # Once more without the worst: a lost view would stand for hundreds of good ones.
    kept = np.argsort(_normalised(model, errors, fits))[: round((1 - LEFT_OUT) * len(errors))]
    model = _most_likely(errors[kept], fits[kept])
    ratio = _normalised(model, errors[kept], fits[kept]).mean() / _mean_below(len(kept) / len(errors))
    return CovarianceModel(model.shared * ratio, model.scale * ratio)


def _most_likely(errors: np.ndarray, fits: np.ndarray) -> CovarianceModel:
    # Each in the unit of its own spread: rad and mm differ by hundreds.
    unit = np.sqrt((errors**2).mean(axis=0)) + 1e-12
    errors, fits = errors / unit, fits / np.outer(unit, unit)
    size = np.einsum("nii->n", fits).mean() / 6
    has_fit = size > 0
    shared, scale = np.eye(6) / 2, 0.5 / size if has_fit else 0.0
    for _ in range(ROUNDS):
        weights = np.linalg.inv(shared + scale * fits)
        explained = np.einsum("nij,nj->ni", weights, errors)
        ours = explained @ shared
        theirs = scale * np.einsum("ni,nij,nj->n", explained, fits, explained)
        left = np.einsum("nij,nji->n", weights, fits)
        shared = (ours.T @ ours) / len(ours) + shared - shared @ weights.mean(axis=0) @ shared
        shared = (shared + shared.T) / 2 + 1e-9 * np.eye(6)
        if has_fit:
            scale = scale * (1 + (theirs - scale * left).mean() / 6)
    return CovarianceModel(shared * np.outer(unit, unit), float(scale))


def _normalised(model: CovarianceModel, errors: np.ndarray, fits: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", errors, np.linalg.solve(model.shared + model.scale * fits, errors[..., None])[..., 0])


def _mean_below(share: float) -> float:
    """Mean of the smallest `share` of chi-square values of 6 degrees of freedom."""
    from scipy.stats import chi2

    return float(6 * chi2.cdf(chi2.ppf(share, 6), 8) / share)
