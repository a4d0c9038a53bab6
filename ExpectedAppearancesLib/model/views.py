"""Training views: what the network sees and what it should say, drawn afresh for every index.

Runs where VTK is loaded and torch is not (see feeder.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from .. import files
from ..appearances.store import Appearance, read_appearances
from ..augmentation import elastic, microscope
from ..case.case import Case
from ..geometry.pose import pose_from_rotation, rotation_matrix, transform
from ..masks.labels import BACKGROUND, VESSELS
from ..masks.renderer import MaskRenderer
from ..masks.stage import craniotomy_of, parenchyma_of, sampler_of
from ..poses.sampling import PoseSampler
from .encoding import network_camera

OVERSAMPLING = 2  # views are composed at twice the network's size, then averaged: frames are anti-aliased too
MIX_CLASSES = 0.35  # share of views whose vessels and parenchyma come from different textures


@dataclass(frozen=True)
class View:
    """image uint8 (S, S, 3); camera_from_world (4, 4); on the grid of half the size: points_mm float32 (G, G, 3), the
    surface point seen, world mm; surface, vessels uint8 (G, G). A negative view has no surface."""

    image: np.ndarray
    camera_from_world: np.ndarray
    points_mm: np.ndarray
    surface: np.ndarray
    vessels: np.ndarray


@dataclass(frozen=True)
class ViewSettings:
    """How views are drawn. styles: textures used. negatives: share of views of something else."""

    method: str
    size_px: int
    styles: tuple[str, ...]
    fresh_poses: bool
    negatives: float
    elastic_px: float
    seed: int


class ViewSource:
    """view(i) depends only on the case, the settings and i."""

    def __init__(self, case_folder: Path, settings: ViewSettings):
        self.case = Case.open(case_folder)
        self.settings = settings
        craniotomy = craniotomy_of(self.case)
        self.camera = network_camera(self.case.camera, settings.size_px)
        self._large = self.camera.resized(*(2 * [settings.size_px * OVERSAMPLING]))
        self._renderer = MaskRenderer(self.case.vessels, parenchyma_of(self.case, craniotomy), self._large)
        self._sampler: PoseSampler = sampler_of(self.case, settings.seed)
        _, appearances = read_appearances(self.case, settings.method)
        self._appearances = [a for a in appearances if a.style in settings.styles]
        self._images: dict[Path, np.ndarray] = {}
        rows, columns = np.mgrid[0 : self._large.height, 0 : self._large.width]
        self._grid = np.stack([columns, rows], axis=-1).astype(np.float32)
        frame = self.case.camera
        scale = self._large.width / max(frame.width, frame.height)
        self._bars = (
            round((self._large.height - frame.height * scale) / 2),
            round((self._large.width - frame.width * scale) / 2),
        )

    def view(self, index: int) -> View:
        rng = np.random.default_rng([self.settings.seed, 7, index])
        appearance = self._appearances[rng.integers(len(self._appearances))]
        on_surface = self.settings.method == "surface"
        turn = np.eye(3)
        if on_surface:
            pose = self._sampler.sample(index)
        else:
            if self.settings.fresh_poses:
                turn = self._camera_turn(appearance.camera_from_world, rng)
            pose = pose_from_rotation(turn, np.zeros(3)) @ appearance.camera_from_world
        labels, _, points = self._renderer.render_surface(pose)
        self._clear_bars(labels, 1)
        image = self._project(appearance, labels, points, rng) if on_surface else self._turned(appearance, turn)
        image = self._fill_background(image, labels, rng)
        return self._finish(image, pose, labels, points, rng)

    def close(self) -> None:
        self._renderer.close()

    def _image(self, appearance: Appearance) -> np.ndarray:
        if appearance.image_path not in self._images:
            self._images[appearance.image_path] = files.read_image_rgb(appearance.image_path)
        return self._images[appearance.image_path]

    def _project(self, appearance: Appearance, labels: np.ndarray, points: np.ndarray, rng) -> np.ndarray:
        """The overview's appearance seen on the surface from elsewhere, lit from a random side."""
        # Single precision is good for a micrometre here, and twice as fast.
        seen = transform(appearance.camera_from_world.astype(np.float32), points.reshape(-1, 3))
        camera = appearance.camera
        where = seen[:, :2] * (np.float32([camera.fx, camera.fy]) / seen[:, 2:]) + np.float32([camera.cx, camera.cy])
        where = where.reshape(*labels.shape, 2)
        image = cv2.remap(self._image(appearance), where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if rng.uniform() < MIX_CLASSES:
            other = self._appearances[rng.integers(len(self._appearances))]
            vessels = cv2.remap(self._image(other), where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            image = np.where((labels == VESSELS)[..., None], vessels, image)
        return _lit(image, points, labels, rng)

    def _camera_turn(self, camera_from_world: np.ndarray, rng) -> np.ndarray:
        """A rotation of the camera about its own centre: it changes the image by a homography, exactly."""
        ranges = self._sampler.ranges
        pan = np.radians(4.0)
        for shrink in np.linspace(1.0, 0.0, 12):
            tilt = rng.uniform(-pan, pan, 2) * shrink
            roll = np.radians(rng.uniform(-1, 1) * min(ranges.roll_max_deg, 30.0)) * shrink
            turn = rotation_matrix(np.array([tilt[0], tilt[1], roll]))
            turned = pose_from_rotation(turn, np.zeros(3)) @ camera_from_world
            if self._sampler.share_in_view(turned) >= ranges.in_view_min:
                return turn
        return np.eye(3)

    def _turned(self, appearance: Appearance, turn: np.ndarray) -> np.ndarray:
        homography = self._large.matrix @ turn @ np.linalg.inv(appearance.camera.matrix)
        size = (self._large.width, self._large.height)
        return cv2.warpPerspective(self._image(appearance), homography, size, flags=cv2.INTER_LINEAR)

    def _fill_background(self, image: np.ndarray, labels: np.ndarray, rng) -> np.ndarray:
        """Outside the craniotomy: mostly black, else drapes and skin stood in for by smooth random colour."""
        outside = (labels == BACKGROUND)[..., None]
        if rng.uniform() < 0.55:
            return np.where(outside, np.uint8(0), image)
        coarse = rng.integers(0, 256, (*rng.integers(1, 7, 2), 3)).astype(np.uint8)
        drape = cv2.resize(coarse, labels.shape[::-1], interpolation=cv2.INTER_CUBIC)
        grain = rng.normal(0, rng.uniform(0, 20), (32, 32)).astype(np.float32)
        drape = drape + cv2.resize(grain, labels.shape[::-1], interpolation=cv2.INTER_LINEAR)[..., None]
        return np.where(outside, np.clip(drape, 0, 255).astype(np.uint8), image)

    def _finish(self, image, pose, labels, points, rng) -> View:
        size = self.settings.size_px
        small = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA)
        if self.settings.elastic_px > 0:
            amplitude = self.settings.elastic_px * size / 128 * rng.uniform()
            field = elastic.displacement_field((size, size), amplitude, size * rng.uniform(0.12, 0.3), rng)
            small = elastic.warp(small, field)
            # The brain moves and takes its points along: what a pixel shows stays true, the pose's mean does too.
            large = cv2.resize(field, labels.shape[::-1], interpolation=cv2.INTER_LINEAR) * OVERSAMPLING
            moved = self._grid + large
            labels = cv2.remap(labels, moved, None, cv2.INTER_NEAREST)
            points = cv2.remap(points, moved, None, cv2.INTER_NEAREST)
        small = microscope.apply(small, rng)
        points, surface, vessels = _to_grid(points, labels, 2 * OVERSAMPLING)
        if rng.uniform() < self.settings.negatives:
            small = _something_else(small, rng)
            surface, vessels = np.zeros_like(surface), np.zeros_like(vessels)
        self._clear_bars(small, OVERSAMPLING)
        return View(small, pose, points, surface, vessels)

    def _clear_bars(self, array: np.ndarray, reduction: int) -> None:
        """Zero, in place, the bars that a frame that is not square leaves in the network's input.

        array: (H, W, ...), `reduction` times smaller than the composed view.
        """
        rows, columns = (bar // reduction for bar in self._bars)
        array[:rows], array[len(array) - rows :] = 0, 0
        array[:, :columns], array[:, array.shape[1] - columns :] = 0, 0


def _lit(image: np.ndarray, points_mm: np.ndarray, labels: np.ndarray, rng) -> np.ndarray:
    """Lambert shading by one distant light at a random place above the surface; its strength at random too."""
    strength = rng.uniform(0.0, 0.6)
    light = rng.normal(size=3).astype(np.float32)
    coarse = points_mm[::2, ::2]
    along, down = np.zeros_like(coarse), np.zeros_like(coarse)
    along[:, :-1] = coarse[:, 1:] - coarse[:, :-1]
    down[:-1] = coarse[1:] - coarse[:-1]
    normals = np.cross(along, down)
    length = np.sqrt(np.einsum("ijk,ijk->ij", normals, normals))
    mean = normals[labels[::2, ::2] != BACKGROUND].mean(axis=0) if (labels != BACKGROUND).any() else light
    light = mean / max(np.linalg.norm(mean), 1e-9) + 0.35 * light
    cosine = np.maximum(normals @ (light / np.linalg.norm(light)), 0) / np.maximum(length, 1e-9)
    cosine = cv2.resize(cv2.blur(cosine.astype(np.float32), (3, 3)), labels.shape[::-1], interpolation=cv2.INTER_LINEAR)
    shade = np.where(labels == BACKGROUND, np.float32(1), (1 - strength) + strength * cosine)
    return cv2.multiply(image, cv2.merge([shade] * 3), dtype=cv2.CV_8U)


def _to_grid(points_mm: np.ndarray, labels: np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cells of step x step pixels: the surface point at each cell's centre, mean of the four pixels around it.

    A cell counts as surface only where all four see it, so that no point is averaged with nothing.
    """
    low, high = step // 2 - 1, step // 2
    corners = [(low, low), (low, high), (high, low), (high, high)]
    surface = np.ones([n // step for n in labels.shape], bool)
    total = np.zeros((*surface.shape, 3), np.float32)
    vessels = np.zeros(surface.shape, np.float32)
    for row, column in corners:
        own = labels[row::step, column::step]
        surface &= own != BACKGROUND
        vessels += own == VESSELS
        total += points_mm[row::step, column::step]
    total[~surface] = 0
    return total / 4, surface.astype(np.uint8), (vessels >= 2).astype(np.uint8)


def _something_else(image: np.ndarray, rng) -> np.ndarray:
    """Cortex that is not this case's: mirrored (no rotation makes it the same), shuffled, smeared, or plain noise."""
    kind = rng.integers(4)
    if kind <= 1:
        return np.ascontiguousarray(image[:, ::-1])
    if kind == 2:
        parts = int(rng.integers(3, 7))
        side = len(image) // parts
        tiles = [(r * side, c * side) for r in range(parts) for c in range(parts)]
        result = image.copy()
        for (row, column), k in zip(tiles, rng.permutation(len(tiles)), strict=True):
            tile = image[tiles[k][0] : tiles[k][0] + side, tiles[k][1] : tiles[k][1] + side]
            result[row : row + side, column : column + side] = np.rot90(tile, rng.integers(4))
        return result
    coarse = rng.integers(0, 256, (*rng.integers(1, 40, 2), 3)).astype(np.uint8)
    return cv2.resize(coarse, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)
