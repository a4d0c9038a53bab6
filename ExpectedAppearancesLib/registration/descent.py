"""Gauss-Newton on a pose whose first fit stays a prior: what both refinements of a pose do with their residuals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..geometry.pose import pose_from_rotation, rotation_matrix, rotation_vector
from .pnp import STILL_MM, STILL_RAD, PoseFit


class Descent:
    """rotation (3, 3) and position (3,), mm, of the fit's centre in the camera frame, from the pose of `start` on.

    prior_scale: the fit's covariance is taken this many times.
    """

    def __init__(self, fit: PoseFit, start: PoseFit, prior_scale: float):
        self._fit = fit
        self._first, self._origin = turn_and_place(fit)
        self.rotation, self.position = turn_and_place(start)
        self._prior = self._information = np.linalg.inv(fit.covariance * prior_scale)

    def step(self, gradient: np.ndarray, weight: np.ndarray, residual: np.ndarray) -> bool:
        """One step by residuals (N,) of gradient (6, N), in `projection_jacobian`'s parameters; True when small."""
        weighted = gradient * weight
        self._information = weighted @ gradient.T + self._prior
        gone = np.concatenate([rotation_vector(self.rotation @ self._first.T), self.position - self._origin])
        step = np.linalg.solve(self._information, weighted @ residual - self._prior @ gone)
        self.rotation = rotation_matrix(step[:3]) @ self.rotation
        self.position = self.position + step[3:]
        return bool(np.abs(step[:3]).max() < STILL_RAD and np.abs(step[3:]).max() < STILL_MM)

    def result(self) -> PoseFit | None:
        """The fit at the pose that was reached, with its covariance; None where that is no pose."""
        if not np.isfinite(self.position).all():
            return None
        pose = pose_from_rotation(self.rotation, self.position - self.rotation @ self._fit.centre_world_mm)
        # Neighbours that err together are in the weights and the prior already.
        return replace(self._fit, camera_from_world=pose, covariance=np.linalg.inv(self._information), residuals=1)

    def moved_mm(self, radius_mm: float) -> float:
        """Root mean square displacement, since the fit, of points on a sphere of that radius about the centre."""
        turned_rad = np.linalg.norm(rotation_vector(self.rotation @ self._first.T))
        return float(np.hypot(np.linalg.norm(self.position - self._origin), turned_rad * radius_mm * np.sqrt(2 / 3)))


def turn_and_place(fit: PoseFit) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and position (3,), mm, of the fit's centre in the camera frame."""
    rotation = fit.camera_from_world[:3, :3]
    return rotation, rotation @ fit.centre_world_mm + fit.camera_from_world[:3, 3]
