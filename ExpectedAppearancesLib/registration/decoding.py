"""From the network's output to a pose and the evidence for it. Numpy only; used in training and in the OR."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry.camera import Camera
from ..geometry.pose import inverse, transform
from .confidence import logistic
from .contrast import ContrastAligner
from .encoding import PoseEncoding
from .pnp import PoseFit, fit_pose
from .refinement import VesselAligner

EVIDENCE = {"dense": 15, "regression": 0}  # numbers of evidence that an estimator gives
LEAST_CELLS = 40  # fewer cells of surface than this cannot carry a pose


@dataclass(frozen=True)
class PlausibleView:
    """The planned views: a pose far outside them was never trained, whatever the image seems to say."""

    centre_world_mm: np.ndarray
    outward_axis: np.ndarray
    tilt_max_deg: float
    distance_mm: tuple[float, float]

    def holds(self, camera_from_world: np.ndarray) -> bool:
        eye = inverse(camera_from_world)[:3, 3] - self.centre_world_mm
        distance = float(np.linalg.norm(eye))
        tilt = np.degrees(np.arccos(np.clip(eye @ self.outward_axis / max(distance, 1e-9), -1, 1)))
        in_front = transform(camera_from_world, self.centre_world_mm[None])[0, 2] > 0
        near, far = self.distance_mm
        return bool(in_front and tilt < self.tilt_max_deg + 12 and 0.8 * near < distance < 1.25 * far)

    def to_dict(self) -> dict:
        return {key: np.asarray(value).tolist() for key, value in vars(self).items()}

    @staticmethod
    def from_dict(values: dict) -> PlausibleView:
        return PlausibleView(
            np.array(values["centre_world_mm"]),
            np.array(values["outward_axis"]),
            values["tilt_max_deg"],
            tuple(values["distance_mm"]),
        )


@dataclass(frozen=True)
class Reading:
    """What one output says: a pose or None, and the evidence (F,) that confidence is computed from."""

    camera_from_world: np.ndarray | None
    evidence: np.ndarray | None
    fit: PoseFit | None = None


def cell_pixels(grid: int) -> np.ndarray:
    """Network pixel (u, v) at the centre of each cell of the grid, (grid * grid, 2); a cell is 2 x 2 px."""
    rows, columns = np.mgrid[0:grid, 0:grid]
    return np.stack([columns, rows], axis=-1).reshape(-1, 2) * 2.0 + 0.5


def read_dense(
    output: np.ndarray,
    image_rgb: np.ndarray,
    camera: Camera,
    encoding: PoseEncoding,
    aligner: VesselAligner,
    contrast: ContrastAligner,
    seed: int = 0,
) -> Reading:
    """output (6, G, G) of DenseSurfaceNet; image_rgb: the frame as the camera of `contrast` sees it, uint8; camera:
    network camera of that frame; aligner, contrast: of the case's vessels."""
    grid = output.shape[-1]
    flat = output.reshape(6, -1).astype(np.float64)
    surface = logistic(flat[4])
    used = surface > 0.5
    if used.sum() < LEAST_CELLS:
        return Reading(None, None)
    points = flat[:3, used].T * encoding.scale_mm + encoding.centre_world_mm
    sigma_mm = np.exp(np.clip(flat[3, used], -8, 4)) * encoding.scale_mm
    fit = fit_pose(points, cell_pixels(grid)[used], sigma_mm, camera, seed)
    if fit is None:
        return Reading(None, None)
    aligned = aligner.align(fit, output[5], output[4])
    sharpened = contrast.align(aligned.fit, image_rgb)
    vessel = logistic(flat[5, used])
    evidence = np.array(
        [
            np.log(fit.expected_add_mm(encoding.scale_mm) + 1e-4),
            np.log(np.median(sigma_mm) + 1e-3),
            np.log(1.001 - fit.inlier_share),
            np.log(fit.residual + 1e-3),
            np.log(used.mean()),
            surface[used].mean(),
            np.abs(2 * vessel - 1).mean(),
            np.log((vessel > 0.5).mean() + 1e-3),
            aligned.matched,
            aligned.residual_px,
            np.log(aligned.moved_mm + 0.1),
            sharpened.matched,
            sharpened.residual_px,
            np.log(sharpened.separation + 0.05),
            np.log(sharpened.moved_mm + 0.1),
        ]
    )
    return Reading(sharpened.fit.camera_from_world, evidence, sharpened.fit)


def read_regression(output: np.ndarray, encoding: PoseEncoding) -> Reading:
    """output (6,) of PaperRegressor: a pose, and nothing that tells whether to believe it."""
    return Reading(encoding.decode(output), np.zeros(0))
