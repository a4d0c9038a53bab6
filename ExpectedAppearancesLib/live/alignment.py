"""Poses made by hand, as ground truth or correction: from pairs of landmarks, and by moving the vessels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..geometry.camera import Camera
from ..geometry.displacement import add_mm
from ..geometry.pose import (
    geodesic_angle_rad,
    inverse,
    pose_from_rotation,
    rotation_matrix,
    rotation_vector,
    transform,
)

LEAST_PAIRS = 4
LEAST_SPREAD = 0.03  # second widest extent of the landmarks as a share of the widest: below, they lie on a line


@dataclass(frozen=True)
class LandmarkPose:
    """camera_from_world (4, 4), and how far each mesh landmark then lies from its landmark in the frame, px (N,)."""

    camera_from_world: np.ndarray
    errors_px: np.ndarray

    @property
    def rms_px(self) -> float:
        return float(np.sqrt((self.errors_px**2).mean()))


@dataclass(frozen=True)
class PoseDifference:
    """Of a predicted pose from the true one: ADD; mean distance of the projected vertices; angle; of the centroid."""

    add_mm: float
    reprojection_px: float
    rotation_deg: float
    translation_mm: float


def pose_from_landmarks(points_px: np.ndarray, points_world_mm: np.ndarray, camera: Camera) -> LandmarkPose:
    """The pose that puts the mesh points (N, 3) onto the points of the frame (N, 2), least squares in px.

    Raises InputError for fewer than 4 pairs, pairs on one line, or pairs that no view in front of the camera explains.
    """
    import cv2

    points_px = np.ascontiguousarray(points_px, float).reshape(-1, 2)  # OpenCV takes no other
    points_mm = np.ascontiguousarray(points_world_mm, float).reshape(-1, 3)
    count = len(points_px)
    if count != len(points_mm):
        raise InputError(
            f"landmarks: {count} in the frame, {len(points_mm)} on the mesh; give both of each pair, in the same order."
        )
    if count < LEAST_PAIRS:
        raise InputError(f"landmarks: {count} pairs; at least {LEAST_PAIRS} are needed, better 6 or more.")
    for points, where in ((points_px, "in the frame"), (points_mm, "on the mesh")):
        extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if extent[1] <= LEAST_SPREAD * extent[0]:
            raise InputError(f"landmarks: those {where} lie on one line; spread them over the vessels.")
    distortion = np.array(camera.distortion) if camera.is_distorted else None
    found, rotation, shift = cv2.solvePnP(points_mm, points_px, camera.matrix, distortion, flags=cv2.SOLVEPNP_SQPNP)
    if found:
        rotation, shift = cv2.solvePnPRefineLM(points_mm, points_px, camera.matrix, distortion, rotation, shift)
    pose = pose_from_rotation(rotation_matrix(rotation), shift.ravel()) if found else np.full((4, 4), np.nan)
    in_camera = transform(pose, points_mm)
    if not np.isfinite(pose).all() or in_camera[:, 2].min() <= 0:
        raise InputError("landmarks: no view explains these pairs; check that each pair is the same spot.")
    return LandmarkPose(pose, np.linalg.norm(camera.project(in_camera) - points_px, axis=1))


def nudged(
    camera_from_world: np.ndarray, pivot_world_mm: np.ndarray, shift_mm: np.ndarray, turn_deg: np.ndarray
) -> np.ndarray:
    """The pose after moving the vessels in the camera's axes: shifted (3,) mm, and turned (3,) about the pivot.

    Axes are the camera's (x right, y down, z away), so that each number does in the frame what its name says.
    """
    pose = np.asarray(camera_from_world, float)
    pivot = transform(pose, np.asarray(pivot_world_mm, float)[None])[0]
    turn = rotation_matrix(np.radians(np.asarray(turn_deg, float)))
    return pose_from_rotation(turn, pivot - turn @ pivot + np.asarray(shift_mm, float)) @ pose


def nudge_between(start: np.ndarray, moved: np.ndarray, pivot_world_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """shift_mm and turn_deg that `nudged` needs to get from one pose to the other; each (3,)."""
    step = np.asarray(moved, float) @ inverse(np.asarray(start, float))
    pivot = transform(np.asarray(start, float), np.asarray(pivot_world_mm, float)[None])[0]
    return transform(step, pivot[None])[0] - pivot, np.degrees(rotation_vector(step[:3, :3]))


def compare(vertices_mm: np.ndarray, true: np.ndarray, predicted: np.ndarray, camera: Camera) -> PoseDifference:
    """How far the predicted pose is from the true one; the reprojection counts vertices in front of both cameras."""
    true, predicted = np.asarray(true, float), np.asarray(predicted, float)
    first, second = transform(true, vertices_mm), transform(predicted, vertices_mm)
    seen = (first[:, 2] > 0) & (second[:, 2] > 0)
    apart_px = camera.project(first[seen]) - camera.project(second[seen]) if seen.any() else np.full((1, 2), np.nan)
    centroid = vertices_mm.mean(axis=0)[None]
    return PoseDifference(
        float(add_mm(vertices_mm, true[None], predicted[None])[0]),
        float(np.linalg.norm(apart_px, axis=1).mean()),
        float(np.degrees(geodesic_angle_rad(true[:3, :3], predicted[:3, :3]))),
        float(np.linalg.norm(transform(true, centroid) - transform(predicted, centroid))),
    )
