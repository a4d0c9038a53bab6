"""What the network's numbers mean: the case's reference rotation, centre and scale. Numpy only: used in the OR too."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..geometry.camera import Camera
from ..geometry.pose import mean_rotation, pose_from_rotation, rotation_matrix, rotation_vector


@dataclass(frozen=True)
class PoseEncoding:
    """reference_rotation (3, 3): the case's mean view, so that relative rotation vectors stay far from the cut at pi.

    centre_world_mm (3,): mesh centroid. scale_mm: unit of surface coordinates. translation_mean_mm,
    translation_scale_mm: of the centroid in the camera frame, over the sampled poses.
    """

    reference_rotation: np.ndarray
    centre_world_mm: np.ndarray
    scale_mm: float
    translation_mean_mm: np.ndarray
    translation_scale_mm: float

    def encode(self, camera_from_world: np.ndarray) -> np.ndarray:
        """4x4 -> (6,): rotation vector of R R_ref^T (rad), then the scaled centroid in the camera frame."""
        rotation = camera_from_world[:3, :3]
        centroid = rotation @ self.centre_world_mm + camera_from_world[:3, 3]
        scaled = (centroid - self.translation_mean_mm) / self.translation_scale_mm
        return np.concatenate([rotation_vector(rotation @ self.reference_rotation.T), scaled])

    def decode(self, code: np.ndarray) -> np.ndarray:
        """(6,) -> 4x4 camera_from_world."""
        code = np.asarray(code, float)
        rotation = rotation_matrix(code[:3]) @ self.reference_rotation
        centroid = code[3:] * self.translation_scale_mm + self.translation_mean_mm
        return pose_from_rotation(rotation, centroid - rotation @ self.centre_world_mm)

    def to_dict(self) -> dict:
        return {key: np.asarray(value).tolist() for key, value in vars(self).items()}

    @staticmethod
    def from_dict(values: dict) -> PoseEncoding:
        return PoseEncoding(**{key: float(v) if np.isscalar(v) else np.array(v, float) for key, v in values.items()})


def fit_encoding(poses: np.ndarray, centre_world_mm: np.ndarray, scale_mm: float) -> PoseEncoding:
    """From sampled camera_from_world (N, 4, 4)."""
    centroids = poses[:, :3, :3] @ centre_world_mm + poses[:, :3, 3]
    return PoseEncoding(
        mean_rotation(poses[:, :3, :3]),
        np.asarray(centre_world_mm),
        float(scale_mm),
        centroids.mean(axis=0),
        float(centroids.std(axis=0).max()),
    )


def network_camera(camera: Camera, size_px: int) -> Camera:
    """The square, undistorted camera whose images the network reads: the whole frame, its longer side filling it.

    Pixels of the frame keep their shape; a frame that is not square leaves black bars. Of twice the size it is
    `resized` to twice the size: poses are refined on images twice as fine as those that the network reads.
    """
    # Not rounded to whole rows: 102 and 205 of them are not the same view.
    scale = size_px / max(camera.width, camera.height)
    left, top = ((size_px - side * scale) / 2 for side in (camera.width, camera.height))
    return replace(
        camera.without_distortion(),
        width=size_px,
        height=size_px,
        fx=camera.fx * scale,
        fy=camera.fy * scale,
        cx=(camera.cx + 0.5) * scale - 0.5 + left,
        cy=(camera.cy + 0.5) * scale - 0.5 + top,
    )
