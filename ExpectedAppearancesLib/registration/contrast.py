"""Last refinement of a pose: the outline of the vessels is brought onto the edges of the frame itself.

What the network takes for a vessel leans on where it believes the vessels to be. The frame does not: across a vessel's
outline its colour changes, and which change that is the frame tells. A classical tracker's search along the outline's
normals (Harris and Stennett, RAPID, 1990), on the colour axis that best tells inside from outside (Fisher's).
Numpy and OpenCV only.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..geometry.camera import Camera
from ..geometry.silhouette import Silhouette
from .descent import Descent
from .pnp import PoseFit, projection_jacobian

SHARPER = 2  # frames are looked at in so many times the size that the network reads
POINTS = 400  # of the outline, at most
REACH_PX, STEP_PX = 4.0, 0.5  # samples along a normal, to both sides
OFFSETS_PX = np.arange(-REACH_PX, REACH_PX + STEP_PX / 2, STEP_PX)
INSIDE, BEYOND = slice(2, 7), slice(10, 15)  # of these, from 1 to 3 px off the outline
WINDOW_PX = 2.0  # inside and outside are means over so much
SIGMA_PX = 0.6  # error of an edge that was found
INDEPENDENT = 60.0  # the whole outline counts as this many independent points: neighbours err together
PRIOR = 100.0  # covariance of the fit is taken this many times: its own edges lean on its pose
ITERATIONS = 4
LEAST_POINTS = 50
DARK = 12  # grey level: no tissue is darker, the border of the field is


@dataclass(frozen=True)
class Contrast:
    """fit: the refined pose with its covariance. matched: mean weight of the outline's points that lie on tissue.
    residual_px: mean distance of the edges found. separation: of the colour differences across the outline, their mean
    over their spread: how much alike the outline's points are. moved_mm: displacement of points at the mesh's rim."""

    fit: PoseFit
    matched: float
    residual_px: float
    separation: float
    moved_mm: float


class ContrastAligner:
    """For frames as one camera takes them. vertices_mm (N, 3), triangles (F, 3) of the exposed vessels, world frame."""

    def __init__(self, vertices_mm: np.ndarray, triangles: np.ndarray, camera: Camera):
        self._vertices_mm = np.asarray(vertices_mm, float)
        self._silhouette = Silhouette(self._vertices_mm, triangles)
        self._radius_mm = float(np.linalg.norm(self._vertices_mm - self._vertices_mm.mean(axis=0), axis=1).max())
        self.camera = camera

    def align(self, fit: PoseFit, image_rgb: np.ndarray) -> Contrast:
        """Gauss-Newton from `fit`, which stays a weak prior; at half the size of the uint8 (H, W, 3), then at it."""
        small = self.camera.resized(self.camera.width // 2, self.camera.height // 2)
        half = cv2.resize(image_rgb, (small.width, small.height), interpolation=cv2.INTER_AREA)
        near = self._descend(fit, fit.camera_from_world, half, small)
        if near is None:
            return Contrast(fit, 0.0, REACH_PX, 0.0, 0.0)
        found = self._descend(fit, near.fit.camera_from_world, image_rgb, self.camera)
        return near if found is None else found

    def _descend(self, fit: PoseFit, start: np.ndarray, image_rgb: np.ndarray, camera: Camera) -> Contrast | None:
        image = cv2.GaussianBlur(image_rgb, (0, 0), 0.7).astype(np.float32)
        red, green, blue = cv2.split(image_rgb)
        lightest = cv2.max(cv2.max(red, green), blue)
        dark = cv2.erode((lightest < DARK).astype(np.uint8), np.ones((3, 3), np.uint8))
        dark = cv2.dilate(dark, np.ones((5, 5), np.uint8))
        edges, inner = self._silhouette.edges_with_inside(start)
        every = len(edges) // POINTS + 1
        centre = fit.centre_world_mm
        # The outline's edges from a to b, a vertex within, and the edges' middles; rows of coordinates.
        corners = np.concatenate([edges[::every, 0], edges[::every, 1], inner[::every]])
        corners = np.ascontiguousarray((self._vertices_mm[corners] - centre).T)
        count = len(edges[::every])
        relative = (corners[:, :count] + corners[:, count : 2 * count]) / 2
        descent = Descent(fit, start, PRIOR)
        focal, principal = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        for _ in range(ITERATIONS):
            seen = descent.rotation @ corners + descent.position[:, None]
            pixels = seen[:2] / np.maximum(seen[2], 1.0) * focal[:, None] + principal[:, None]
            a, b, within = (pixels[:, i * count : (i + 1) * count] for i in range(3))
            normals = _outward(a, b, within)
            profile = _Profile((a + b) / 2, normals, image, dark)
            if profile.on_tissue.sum() < LEAST_POINTS:
                return None
            offsets_px, weight = profile.edges()
            turned = descent.rotation @ relative
            jacobian = projection_jacobian(turned, turned + descent.position[:, None], focal)
            gradient = normals[0] * jacobian[:, 0] + normals[1] * jacobian[:, 1]
            count_as = INDEPENDENT / (SIGMA_PX**2 * profile.on_tissue.sum())
            if descent.step(gradient, weight * count_as, offsets_px):
                break
        refined = descent.result()
        if refined is None:
            return None
        used = weight > 0
        return Contrast(
            refined,
            float(weight.sum() / profile.on_tissue.sum()),
            float(np.abs(offsets_px[used]).mean()) if used.any() else REACH_PX,
            profile.separation,
            descent.moved_mm(self._radius_mm),
        )


def _outward(a_px: np.ndarray, b_px: np.ndarray, within_px: np.ndarray) -> np.ndarray:
    """Unit normals (2, E) of the image's segments a-b (2, E) that point away from `within` (2, E)."""
    x, y = b_px - a_px
    across, down = within_px - a_px
    # Of (y, -x), which is a normal, the direction that points away.
    scale = np.where(y * across - x * down > 0, -1.0, 1.0) / np.maximum(np.sqrt(x * x + y * y), 1e-9)
    return np.stack([y * scale, -x * scale])


class _Profile:
    """The image along the normals (2, E) of points (2, E), from REACH_PX inside to as much outside."""

    def __init__(self, points_px: np.ndarray, normals: np.ndarray, image: np.ndarray, dark: np.ndarray):
        where = points_px[:, :, None] + normals[:, :, None] * OFFSETS_PX
        where = cv2.merge([where[0].astype(np.float32), where[1].astype(np.float32)])
        colours = cv2.remap(image, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        outside = cv2.remap(dark, where, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=1)
        self.on_tissue = ~(outside > 0).any(axis=1)
        # Differences across the outline, so that light which changes from place to place does not count.
        across = (colours[:, INSIDE].mean(axis=1) - colours[:, BEYOND].mean(axis=1))[self.on_tissue].astype(float)
        mean = across.mean(axis=0) if len(across) else np.zeros(3)
        apart = across - mean
        spread = apart.T @ apart / (len(across) - 1) + 4 * np.eye(3) if len(across) > 3 else np.eye(3)
        axis = np.linalg.solve(spread, mean)
        self._values = colours @ axis
        self._expected = max(float(mean @ axis), 1e-9)
        self.separation = float(np.sqrt(self._expected))

    def edges(self) -> tuple[np.ndarray, np.ndarray]:
        """Offset of the step along each normal that is most like the expected one, px (E,), and its weight (E,)."""
        window = round(WINDOW_PX / STEP_PX)
        # Column i: the sum of the `window` samples from the i-th on.
        sums = self._values[:, : 1 - window].copy()
        for i in range(1, window):
            sums += self._values[:, i : i + sums.shape[1]]
        at = np.arange(window, len(OFFSETS_PX) - window)
        response = (sums[:, : len(at)] - sums[:, window + 1 :]) / (window * self._expected)
        best, rows = np.clip(response.argmax(axis=1), 1, len(at) - 2), np.arange(len(response))
        before, peak, after = (response[rows, best + i] for i in (-1, 0, 1))
        bend = before - 2 * peak + after
        between = np.where(bend < -1e-9, 0.5 * (before - after) / np.minimum(bend, -1e-9), 0.0)
        offsets_px = OFFSETS_PX[at[best]] + STEP_PX * np.clip(between, -1, 1)
        farthest = REACH_PX - WINDOW_PX + STEP_PX
        near = np.clip(1 - (offsets_px / farthest) ** 2, 0, 1) ** 2
        is_peak = (peak >= before) & (peak >= after)
        return offsets_px, np.clip(peak, 0, 1.5) * near * is_peak * self.on_tissue
