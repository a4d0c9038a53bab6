"""Expected appearances laid on the surface, as a camera anywhere sees them (method `surface`).

Cheap enough for a new image at every training step: VTK has drawn where each pixel lies, the rest is looking up.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from .. import files
from ..geometry.camera import Camera
from ..masks.labels import BACKGROUND, PARENCHYMA, VESSELS
from ..masks.renderer import MaskRenderer
from .store import Appearance

REGISTERED = 0.4  # share of views with the parenchyma where it was synthesised; in the others it lies anywhere
MIX_STYLES = 0.35  # share of views whose vessels come from another texture than the parenchyma
FAINT = 0.5  # share of those others whose vessels shine through the parenchyma more or less, as deep ones do
FAINTEST = 0.4  # weight of the vessels' own colour in them, at least
DEPTH_OF_FIELD = 0.25  # share of views that are out of focus away from one depth
GLOSS = 0.5  # share of views with a wet gleam


class SurfacePainter:
    """Colours for what a camera sees of the case's surface.

    appearances: of method `surface`: overviews, all of one camera and pose.
    """

    def __init__(self, vessels, parenchyma, appearances: list[Appearance]):
        self._overviews = appearances
        self._plates: dict[Path, np.ndarray] = {}
        self.camera: Camera = self._overviews[0].camera
        self.camera_from_world = self._overviews[0].camera_from_world.astype(np.float32)
        with MaskRenderer(vessels, parenchyma, self.camera) as renderer:
            labels, _, points = renderer.render_surface(self.camera_from_world)
        self._normals = _normals(points, labels, self.camera_from_world)

    def overview_px(self, points_mm: np.ndarray) -> np.ndarray:
        """Where in the overview the surface points (H, W, 3), world mm, lie: (H, W, 2) float32, px."""
        camera = self.camera
        seen = cv2.transform(points_mm, self.camera_from_world[:3])
        depth = seen[..., 2]
        return cv2.merge(
            [
                cv2.divide(seen[..., 0], depth, scale=camera.fx) + np.float32(camera.cx),
                cv2.divide(seen[..., 1], depth, scale=camera.fy) + np.float32(camera.cy),
            ]
        )

    def paint(
        self, labels: np.ndarray, depth_mm: np.ndarray, where_px: np.ndarray, camera_from_world: np.ndarray, rng
    ) -> np.ndarray:
        """uint8 RGB (H, W, 3) of what `camera_from_world` sees; textures, light and focus drawn from `rng`."""
        overview = self._overviews[rng.integers(len(self._overviews))]
        other = self._overviews[rng.integers(len(self._overviews))] if rng.uniform() < MIX_STYLES else overview
        vessels = _look_up(other.image, where_px)
        if rng.uniform() < REGISTERED:
            image = vessels if other is overview else _look_up(overview.image, where_px)
        else:
            # No two views share their parenchyma's pattern: where the vessels run is all that tells the pose.
            image = _look_up(self._plate(overview), _elsewhere(where_px, rng))
            if rng.uniform() < FAINT:
                own = rng.uniform(FAINTEST, 1.0)
                vessels = cv2.addWeighted(vessels, own, image, 1 - own, 0)
        if vessels is not image:
            cv2.copyTo(vessels, cv2.compare(labels, VESSELS, cv2.CMP_EQ), image)
        image = self._lit(image, labels, where_px, camera_from_world, rng)
        return _focused(image, labels, depth_mm, rng) if rng.uniform() < DEPTH_OF_FIELD else image

    def as_synthesised(self, where_px: np.ndarray, rng) -> np.ndarray:
        """uint8 RGB (H, W, 3) of one texture's overview at those places, (H, W, 2) px, and nothing else."""
        return _look_up(self._overviews[rng.integers(len(self._overviews))].image, where_px)

    def cortex(self, rng) -> np.ndarray:
        """Parenchyma of a random texture, uint8 RGB: cortex that is nowhere on the case's surface."""
        return self._plate(self._overviews[rng.integers(len(self._overviews))])

    def _plate(self, overview: Appearance) -> np.ndarray:
        if overview.image_path not in self._plates:
            plate = parenchyma_plate(overview.image, files.read_label_map(overview.labels_path))
            self._plates[overview.image_path] = plate
        return self._plates[overview.image_path]

    def _lit(self, image, labels, where_px, camera_from_world, rng) -> np.ndarray:
        """Lambert and Blinn's shading by one distant light near the optical axis, as a microscope's is, on tissue whose
        colour changes slowly from place to place."""
        rotation = camera_from_world[:3, :3]
        towards_camera = -rotation[2]
        light = towards_camera + rng.normal(0, rng.uniform(0, 0.45), 3)
        light /= np.linalg.norm(light)
        half = light + towards_camera
        half /= np.linalg.norm(half)
        # Light changes slowly: half the resolution holds it.
        height, width = labels.shape
        coarse = cv2.resize(where_px, (width // 2, height // 2), interpolation=cv2.INTER_NEAREST)
        cosines = cv2.transform(_look_up(self._normals, coarse), np.stack([light, half]).astype(np.float32))
        strength = np.float32(rng.uniform(0, 0.8))
        shade = np.maximum(cosines[..., 0], 0) * strength + (1 - strength)
        tint = rng.uniform(0, 0.2)
        blotches = rng.uniform(1 - tint, 1 + tint, (*rng.integers(2, 6, 2), 3)).astype(np.float32)
        blotches = cv2.resize(blotches, shade.shape[::-1], interpolation=cv2.INTER_LINEAR)
        colour = cv2.resize(cv2.multiply(blotches, cv2.merge([shade] * 3)), (width, height))
        image = cv2.multiply(image, colour, dtype=cv2.CV_8U)
        if rng.uniform() < GLOSS:
            sharpness, amount = np.exp(rng.uniform(np.log(8), np.log(80))), rng.uniform(0.1, 0.8)
            gleam = cv2.pow(np.clip(cosines[..., 1], 0, 1), sharpness) * np.float32(255 * amount)
            gleam = cv2.copyTo(cv2.resize(gleam, (width, height)), labels)
            image = cv2.add(image, cv2.merge([gleam] * 3), dtype=cv2.CV_8U)
        return image


def _look_up(image: np.ndarray, where_px: np.ndarray) -> np.ndarray:
    return cv2.remap(image, where_px, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)


def _elsewhere(where_px: np.ndarray, rng) -> np.ndarray:
    """The same places after a random similarity, a mirroring among them."""
    angle, scale = rng.uniform(0, 2 * np.pi), np.exp(rng.uniform(np.log(0.4), np.log(1.3)))
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turn[:, 0] *= rng.choice([-1, 1])
    return cv2.transform(where_px, np.hstack([turn, rng.uniform(0, 400, (2, 1))]).astype(np.float32))


def parenchyma_plate(image: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """The appearance `image` (H, W, 3) without its vessels and rim: parenchyma alone, cut to what is filled.

    Where vessels were, the mirrored image is laid in, and the little that is left is painted over.
    """
    hole = cv2.dilate((labels != PARENCHYMA).astype(np.uint8), np.ones((7, 7), np.uint8))
    for axis in (1, 0):
        usable = hole * (1 - cv2.dilate(cv2.flip(hole, axis), np.ones((5, 5), np.uint8)))
        weight = cv2.GaussianBlur(usable.astype(np.float32), (0, 0), 2.0)
        image = cv2.blendLinear(image, cv2.flip(image, axis), 1 - weight, weight)
        hole *= 1 - usable
    # The largest centred rectangle that the surface fills.
    rows, columns = (np.flatnonzero((labels != BACKGROUND).mean(axis=a) > 0.75) for a in (1, 0))
    if len(rows) < 8 or len(columns) < 8:
        return image
    part = np.s_[rows[0] + 2 : rows[-1] - 1, columns[0] + 2 : columns[-1] - 1]
    return cv2.inpaint(np.ascontiguousarray(image[part]), np.ascontiguousarray(hole[part]), 5, cv2.INPAINT_TELEA)


def _focused(image: np.ndarray, labels: np.ndarray, depth_mm: np.ndarray, rng) -> np.ndarray:
    """Sharp at one depth of the surface, blurred away from it."""
    depths = depth_mm[labels != BACKGROUND][::64]
    if not len(depths):
        return image
    nearest, farthest = float(depths.min()), float(depths.max())
    blurred = cv2.GaussianBlur(image, (0, 0), max(0.3, rng.uniform(0.003, 0.014) * len(image)))
    reach = max(1.0, (farthest - nearest) * rng.uniform(0.5, 1.0))
    away = np.minimum(np.abs(depth_mm - np.float32(rng.uniform(nearest, farthest))) / np.float32(reach), 1)
    return cv2.blendLinear(image, blurred, 1 - away, away)


def _normals(points_mm: np.ndarray, labels: np.ndarray, camera_from_world: np.ndarray) -> np.ndarray:
    """Outward unit normals, world frame, (H, W, 3) float32, of an overview's surface points, slightly smoothed."""
    height, width = labels.shape
    along, down = np.zeros_like(points_mm), np.zeros_like(points_mm)
    along[:, 1 : width - 1] = points_mm[:, 2:] - points_mm[:, :-2]
    down[1 : height - 1] = points_mm[2:] - points_mm[:-2]
    normals = np.cross(down, along)
    # Differences across the rim reach from the surface to nothing.
    inside = cv2.erode((labels != BACKGROUND).astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    normals[~inside] = 0
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-9)
    smooth = cv2.GaussianBlur(normals, (0, 0), 1.0)
    smooth[~inside] = -camera_from_world[2, :3]
    return np.ascontiguousarray(smooth / np.maximum(np.linalg.norm(smooth, axis=-1, keepdims=True), 1e-9), np.float32)
