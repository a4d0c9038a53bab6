"""Plausible microscope poses: uniform on a spherical cap over the craniotomy (the paper's upper hemisphere)."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from ..errors import InputError
from ..geometry.camera import Camera
from ..geometry.pose import pose_from_rotation, transform
from ..geometry.se3 import cross_matrix
from .craniotomy import Craniotomy

MAX_TRIES = 200


@dataclass(frozen=True)
class PoseRanges:
    """What the surgeon may do with the microscope. Working distance: None is derived from the field of view.

    tilt_max_deg: largest angle between the optical and the outward axis.
    roll_max_deg: largest rotation about the optical axis, either way, from the upright image.
    working_distance_mm: (nearest, farthest) of the point looked at.
    lateral_offset_mm: largest distance of that point from the craniotomy's centre.
    in_view_min: least share of the vessels' vertices that must fall inside the image.
    """

    tilt_max_deg: float = 70.0
    roll_max_deg: float = 45.0
    working_distance_mm: tuple[float, float] | None = None
    lateral_offset_mm: float | None = None
    in_view_min: float = 0.6

    def resolved(self, camera: Camera, vessels_radius_mm: float) -> PoseRanges:
        """Fill what is None: from vessels overfilling the field (x 0.75) to lying well inside it (x 1.4)."""
        per_mm = camera.field_of_view_mm(1.0)
        diameter_mm = 2 * vessels_radius_mm
        distance = self.working_distance_mm or (0.75 * diameter_mm / per_mm, 1.4 * diameter_mm / per_mm)
        lateral = 0.25 * vessels_radius_mm if self.lateral_offset_mm is None else self.lateral_offset_mm
        return replace(self, working_distance_mm=tuple(map(float, distance)), lateral_offset_mm=float(lateral))

    def problems(self) -> list[str]:
        found = []
        if not 0 <= self.tilt_max_deg <= 90:
            found.append(f"tilt: {self.tilt_max_deg} degrees; it must lie between 0 and 90 (upper hemisphere).")
        if not 0 <= self.roll_max_deg <= 180:
            found.append(f"roll: {self.roll_max_deg} degrees; it must lie between 0 and 180.")
        if self.working_distance_mm is not None:
            nearest, farthest = self.working_distance_mm
            if not 0 < nearest <= farthest < np.inf:
                found.append(f"working distance: {nearest} to {farthest} mm; give nearest, then farthest, above 0 mm.")
        if self.lateral_offset_mm is not None and not 0 <= self.lateral_offset_mm < np.inf:
            found.append(f"lateral offset: {self.lateral_offset_mm} mm; give 0 or more.")
        if not 0 <= self.in_view_min <= 1:
            found.append(f"vessels in view: {self.in_view_min}; give a share between 0 and 1.")
        return found

    def to_dict(self) -> dict:
        return asdict(self)

    @staticmethod
    def from_dict(values: dict) -> PoseRanges:
        values = dict(values)
        if values.get("working_distance_mm") is not None:
            values["working_distance_mm"] = tuple(values["working_distance_mm"])
        return PoseRanges(**values)


class PoseSampler:
    """Repeatable poses: sample(i) depends only on the seed and i. Raises InputError for impossible ranges."""

    def __init__(
        self, craniotomy: Craniotomy, ranges: PoseRanges, camera: Camera, vessel_vertices_mm: np.ndarray, seed: int = 0
    ):
        problems = ranges.problems() + ([f"seed: {seed}; give 0 or more."] if seed < 0 else [])
        if problems:
            raise InputError(problems)
        radius_mm = np.linalg.norm(vessel_vertices_mm - vessel_vertices_mm.mean(axis=0), axis=1).max()
        self.craniotomy = craniotomy
        self.ranges = ranges.resolved(camera, radius_mm)
        self.camera = camera.without_distortion()
        self.seed = seed
        # A few hundred vertices tell the share in view as well as all of them.
        self._vertices_mm = vessel_vertices_mm[:: max(1, len(vessel_vertices_mm) // 400)]

    def sample(self, index: int) -> np.ndarray:
        """camera_from_world (4, 4) of pose `index`."""
        rng = np.random.default_rng([self.seed, index])
        for _ in range(MAX_TRIES):
            pose = self._draw(rng)
            if self.share_in_view(pose) >= self.ranges.in_view_min:
                return pose
        raise InputError(
            f"poses: in {MAX_TRIES} tries no view held {self.ranges.in_view_min:.0%} of the vessels; check that "
            "vessels, camera and centre of the craniotomy belong together, or choose a larger working distance or a "
            "smaller lateral offset."
        )

    def share_in_view(self, camera_from_world: np.ndarray) -> float:
        """Share of the vessels' vertices that lie in front of the camera and inside the image."""
        points = transform(camera_from_world, self._vertices_mm)
        front = points[:, 2] > 1e-3
        if not front.any():
            return 0.0
        pixels = points[front, :2] / points[front, 2:] * [self.camera.fx, self.camera.fy] + [
            self.camera.cx,
            self.camera.cy,
        ]
        inside = ((pixels >= -0.5) & (pixels <= [self.camera.width - 0.5, self.camera.height - 0.5])).all(axis=1)
        return inside.sum() / len(points)

    def _draw(self, rng: np.random.Generator) -> np.ndarray:
        ranges, axis = self.ranges, self.craniotomy.outward_axis
        up = self.craniotomy.up
        side = np.cross(up, axis)
        # Equal areas of the cap have equal probability where the cosine is uniform (Archimedes).
        cosine = rng.uniform(np.cos(np.radians(ranges.tilt_max_deg)), 1.0)
        azimuth = rng.uniform(-np.pi, np.pi)
        tilt = np.arccos(cosine)
        hinge = np.cos(azimuth) * side + np.sin(azimuth) * up
        # Tilting about an axis across the outward axis carries the upright image along without adding roll.
        tilted = _turn(hinge, tilt)
        towards_camera, image_up = tilted @ axis, tilted @ up
        roll = np.radians(rng.uniform(-ranges.roll_max_deg, ranges.roll_max_deg))
        image_up = _turn(towards_camera, roll) @ image_up
        rotation = np.stack([np.cross(image_up, towards_camera), -image_up, -towards_camera])
        offset = np.sqrt(rng.uniform()) * ranges.lateral_offset_mm
        angle = rng.uniform(-np.pi, np.pi)
        target = self.craniotomy.centre_world_mm + offset * (np.cos(angle) * side + np.sin(angle) * up)
        distance = rng.uniform(*ranges.working_distance_mm)
        middle = np.array([(self.camera.width - 1) / 2, (self.camera.height - 1) / 2, 1.0])
        target_camera_mm = np.linalg.solve(self.camera.matrix, middle) * distance
        return pose_from_rotation(rotation, target_camera_mm - rotation @ target)


def _turn(unit_axis: np.ndarray, angle_rad: float) -> np.ndarray:
    """Rotation about an axis (Rodrigues' formula); poses are drawn in 3D Slicer without loading OpenCV for it."""
    skew = cross_matrix(unit_axis)
    return np.eye(3) + np.sin(angle_rad) * skew + (1 - np.cos(angle_rad)) * (skew @ skew)
