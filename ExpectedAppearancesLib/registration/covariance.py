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

LEAST_VIEWS = 30
LEFT_OUT = 0.02  # share of views, the worst: lost ones are for the confidence to refuse


@dataclass(frozen=True)
class CovarianceModel:
    """covariance = shared + scale x covariance of the fit as if all its residuals were one and the same error.

    shared (6, 6): what every view errs by; all there is for a pose that is regressed without a fit. A network's
    residuals are all but one error: their covariance as if independent is tens of times too small.
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
        """None: a model from before calibration; its residuals are then taken for one common error, the worst case."""
        if values is None:
            return UNCALIBRATED
        return CovarianceModel(np.array(values["shared"], float), float(values["scale"]))


UNCALIBRATED = CovarianceModel(np.zeros((6, 6)), 1.0)


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


def calibrate_covariance(errors: np.ndarray, fits: np.ndarray | None) -> CovarianceModel:
    """Model for errors (N, 6) of views whose fits have `correlated` covariance (N, 6, 6); None: poses without fits.

    Normalised errors then have the mean of a chi-square with 6 degrees of freedom, all but the worst of them. Fewer
    than 30 views calibrate nothing.
    """
    if len(errors) < LEAST_VIEWS:
        return UNCALIBRATED
    if fits is not None:
        return CovarianceModel(np.zeros((6, 6)), _excess(_normalised(errors, fits)))
    shared = errors.T @ errors / len(errors)
    kept = errors[np.argsort(_normalised(errors, shared))[: _kept(len(errors))]]
    # Once more without the worst, which would stand for hundreds of good ones.
    shared = kept.T @ kept / len(kept)
    return CovarianceModel(shared * _excess(_normalised(errors, shared)), 1.0)


def _normalised(errors: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", errors, np.linalg.solve(covariance, errors[..., None])[..., 0])


def _kept(count: int) -> int:
    return round((1 - LEFT_OUT) * count)


def _excess(normalised: np.ndarray) -> float:
    """By how much the covariances are too small, from all but the largest normalised errors."""
    from scipy.stats import chi2

    smallest = np.sort(normalised)[: _kept(len(normalised))]
    share = len(smallest) / len(normalised)
    # Mean of a chi-square below its quantile, times the share: 6 times the distribution of 8 degrees of freedom.
    return float(smallest.mean() * share / (6 * chi2.cdf(chi2.ppf(share, 6), 8)))
