"""Pose from predicted surface coordinates: SQPnP inside RANSAC, then weighted Gauss-Newton. Numpy and OpenCV only."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..geometry.camera import Camera
from ..geometry.pose import pose_from_rotation, rotation_matrix

RANSAC_POINTS = 400
COARSE_POINTS, MOST_POINTS = 400, 4096
RANSAC_THRESHOLD_PX = 2.5  # of a network input of 128 px; scaled with its size
HUBER = 1.5  # residuals beyond this many standard deviations lose weight
ITERATIONS = 12
STILL_RAD, STILL_MM = 1e-4, 1e-2  # a step below which nothing more is gained


@dataclass(frozen=True)
class PoseFit:
    """camera_from_world (4, 4); centre_world_mm (3,): mean of the points; covariance (6, 6) of (rotation vector in the
    camera frame about that centre, rad; translation, mm), as if all residuals were independent; inlier_share;
    residual: mean of |residual| / sigma; residuals: how many points have weight."""

    camera_from_world: np.ndarray
    centre_world_mm: np.ndarray
    covariance: np.ndarray
    inlier_share: float
    residual: float
    residuals: int

    def expected_add_mm(self, radius_mm: float) -> float:
        """Root mean square displacement of points at `radius_mm` around the centre that the covariance stands for."""
        rotation, translation = np.trace(self.covariance[:3, :3]), np.trace(self.covariance[3:, 3:])
        return float(np.sqrt(max(0.0, translation + rotation * radius_mm**2 * 2 / 3)))


def fit_pose(
    points_world_mm: np.ndarray, pixels: np.ndarray, sigma_mm: np.ndarray, camera: Camera, seed: int = 0
) -> PoseFit | None:
    """Pose that projects points (N, 3) onto pixels (N, 2), each with an error of sigma_mm (N,); None if none fits.

    camera: undistorted. The seed makes RANSAC repeatable.
    """
    if len(points_world_mm) < 12:
        return None
    threshold_px = RANSAC_THRESHOLD_PX * camera.width / 128
    order = np.argsort(sigma_mm, kind="stable")[: max(len(sigma_mm) // 2, 12)]
    chosen = order[np.unique(np.linspace(0, len(order) - 1, min(RANSAC_POINTS, len(order))).astype(int))]
    cv2.setRNGSeed(seed)
    try:
        found, rotation_vector, translation, _ = cv2.solvePnPRansac(
            points_world_mm[chosen].astype(np.float64),
            pixels[chosen].astype(np.float64),
            camera.matrix,
            None,
            iterationsCount=100,
            reprojectionError=threshold_px,
            confidence=0.999,
            flags=cv2.SOLVEPNP_SQPNP,
        )
    except cv2.error:
        return None
    if not found or not np.isfinite(translation).all():
        return None
    rotation, translation = rotation_matrix(rotation_vector), translation.ravel()
    # A few points bring it near, all of them then need a step or two.
    every = len(points_world_mm) // COARSE_POINTS
    if every > 1:
        some = slice(None, None, every)
        near = _refine(rotation, translation, points_world_mm[some], pixels[some], sigma_mm[some], camera, threshold_px)
        if near is not None:
            rotation, translation = near.camera_from_world[:3, :3], near.camera_from_world[:3, 3]
    return _refine(rotation, translation, points_world_mm, pixels, sigma_mm, camera, threshold_px)


def _refine(rotation, translation, points, pixels, sigma_mm, camera, threshold_px) -> PoseFit | None:
    centre = points.mean(axis=0)
    # More points than this tell the same again; those left out count through their neighbours.
    every = -(-len(points) // MOST_POINTS)
    # One row of numbers per coordinate: a third of the time of one row per point.
    relative = np.ascontiguousarray((points[::every] - centre).T)
    target = np.ascontiguousarray(pixels[::every].T)
    sigma_mm = sigma_mm[::every]
    position = rotation @ centre + translation  # the points' centre in the camera frame
    focal = np.array([camera.fx, camera.fy])
    principal = np.array([camera.cx, camera.cy])
    for _ in range(ITERATIONS):
        turned = rotation @ relative
        seen = turned + position[:, None]
        if (seen[2] < 1.0).mean() > 0.05:
            return None
        depth = np.maximum(seen[2], 1.0)
        residual = target - (seen[:2] / depth * focal[:, None] + principal[:, None])
        sigma_px = np.maximum(focal.mean() * sigma_mm / depth, 0.2)
        distance = np.sqrt(residual[0] ** 2 + residual[1] ** 2)
        scaled = distance / sigma_px
        # Huber weights, and none for what lies far off: an instrument, another patient's vessel.
        weight = every * np.minimum(1.0, HUBER / np.maximum(scaled, 1e-9)) / sigma_px**2
        weight *= distance < 4 * threshold_px
        jacobian = projection_jacobian(turned, seen, focal)
        weighted = (jacobian * weight).reshape(6, -1)
        information = weighted @ jacobian.reshape(6, -1).T + 1e-9 * np.eye(6)
        step = np.linalg.solve(information, weighted @ residual.ravel())
        rotation = rotation_matrix(step[:3]) @ rotation
        position = position + step[3:]
        if np.abs(step[:3]).max() < STILL_RAD and np.abs(step[3:]).max() < STILL_MM:
            break
    if not np.isfinite(position).all():
        return None
    inlier_share = float((distance < threshold_px).mean())
    pose = pose_from_rotation(rotation, position - rotation @ centre)
    mean_residual = float(np.minimum(scaled, 10).mean())
    residuals = every * int((weight > 0).sum())
    return PoseFit(pose, centre, np.linalg.inv(information), inlier_share, mean_residual, residuals)


def projection_jacobian(turned: np.ndarray, seen: np.ndarray, focal: np.ndarray) -> np.ndarray:
    """(6, 2, N): pixels (u, v) by a small rotation of the camera-frame points about their centre, and by a translation.

    turned (3, N): the points less their centre, in camera axes; seen (3, N): in the camera frame, mm.
    """
    x, y, z = turned
    by_depth = 1 / np.maximum(seen[2], 1.0)
    along, down = focal[0] * by_depth, focal[1] * by_depth
    along_by_depth, down_by_depth = -along * (seen[0] * by_depth), -down * (seen[1] * by_depth)
    jacobian = np.empty((6, 2, turned.shape[1]))
    jacobian[0, 0], jacobian[0, 1] = along_by_depth * y, down_by_depth * y - down * z
    jacobian[1, 0], jacobian[1, 1] = along * z - along_by_depth * x, -down_by_depth * x
    jacobian[2, 0], jacobian[2, 1] = -along * y, down * x
    jacobian[3, 0], jacobian[3, 1] = along, 0
    jacobian[4, 0], jacobian[4, 1] = 0, down
    jacobian[5, 0], jacobian[5, 1] = along_by_depth, down_by_depth
    return jacobian
