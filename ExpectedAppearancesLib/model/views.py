"""Training views: what the network sees and what it should say, drawn afresh for every index.

Runs where VTK is loaded and torch is not (see feeder.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from ..appearances.projection import SurfacePainter
from ..appearances.store import Appearance, read_appearances
from ..augmentation import elastic, microscope
from ..augmentation.impostors import impostor
from ..augmentation.surroundings import fill_outside, opening
from ..case.case import Case
from ..geometry.pose import pose_from_rotation, rotation_matrix
from ..masks.labels import BACKGROUND, VESSELS
from ..masks.renderer import MaskRenderer
from ..masks.stage import craniotomy_of, parenchyma_of, sampler_of
from ..poses.sampling import PoseSampler
from .encoding import network_camera
from .fold import known_poses, seen_from

COMPOSED_PX = 256  # smaller views are composed at twice their size, then averaged: frames are anti-aliased too


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
    """How views are drawn. styles: textures used. negatives: share of views of something else.

    poses_file: views are seen from this file's poses only (the paper's protocol repeats its poses); None: from fresh
    ones.
    """

    method: str
    size_px: int
    styles: tuple[str, ...]
    fresh_poses: bool
    negatives: float
    elastic_px: float
    seed: int
    poses_file: str | None = None


class ViewSource:
    """view(i) depends only on the case, the settings and i."""

    def __init__(self, case_folder: Path, settings: ViewSettings):
        self.case = Case.open(case_folder)
        self.settings = settings
        craniotomy = craniotomy_of(self.case)
        parenchyma = parenchyma_of(self.case, craniotomy)
        self.camera = network_camera(self.case.camera, settings.size_px)
        self._oversampling = 2 if 2 * settings.size_px <= COMPOSED_PX else 1
        self._large = self.camera.resized(*(2 * [settings.size_px * self._oversampling]))
        self._renderer = MaskRenderer(self.case.vessels, parenchyma, self._large)
        self._sampler: PoseSampler = sampler_of(self.case, settings.seed)
        _, appearances = read_appearances(self.case, settings.method)
        self._appearances = [a for a in appearances if a.style in settings.styles]
        self._poses = known_poses(Path(settings.poses_file)) if settings.poses_file else None
        if self._poses is not None and settings.method == "image":
            self._appearances = [a for a in self._appearances if seen_from(a, self._poses)]
        self._painter = None
        if settings.method == "surface":
            self._painter = SurfacePainter(self.case.vessels, parenchyma, self._appearances)
        # The surface's outline seen from the front: where the craniotomy's edge is drawn.
        axis, up = craniotomy.outward_axis, craniotomy.up
        self._frontal = np.float32([np.cross(axis, up), up])
        across = parenchyma.vertices_mm @ self._frontal.T
        self._middle_mm = (across.min(axis=0) + across.max(axis=0)) / 2
        self._extent_mm = float((across.max(axis=0) - across.min(axis=0)).mean())
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
        if self._painter:
            seen = self._poses
            pose = self._sampler.sample(index) if seen is None else seen[rng.integers(len(seen))]
            labels, depth_mm, points = self._renderer.render_surface(pose)
            image = self._painter.paint(labels, depth_mm, self._painter.overview_px(points), pose, rng)
            cortex = self._painter.cortex(rng)
        else:
            appearance = self._appearances[rng.integers(len(self._appearances))]
            fresh = self.settings.fresh_poses and self._poses is None
            turn = self._camera_turn(appearance.camera_from_world, rng) if fresh else np.eye(3)
            pose = pose_from_rotation(turn, np.zeros(3)) @ appearance.camera_from_world
            labels, _, points = self._renderer.render_surface(pose)
            image = self._turned(appearance, turn)
            cortex = appearance.image
        hidden = opening(cv2.transform(points, self._frontal), self._middle_mm, self._extent_mm, rng)
        if hidden is not None:
            labels *= hidden
        self._clear_bars(labels, 1)
        image = fill_outside(image, labels == BACKGROUND, cortex, rng)
        return self._finish(image, pose, labels, points, rng)

    def close(self) -> None:
        self._renderer.close()

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
        return cv2.warpPerspective(appearance.image, homography, size, flags=cv2.INTER_LINEAR)

    def _finish(self, image, pose, labels, points, rng) -> View:
        size = self.settings.size_px
        small = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA) if len(image) > size else image
        if self.settings.elastic_px > 0:
            # Smooth: a coarse field holds it. Its unit is a pixel of 128.
            amplitude = self.settings.elastic_px / 2 * rng.uniform()
            coarse = elastic.displacement_field((64, 64), amplitude, 64 * rng.uniform(0.12, 0.3), rng)
            field = cv2.resize(coarse * np.float32(size / 64), (size, size), interpolation=cv2.INTER_LINEAR)
            small = elastic.warp(small, field)
            # The brain moves and takes its points along: what a pixel shows stays true, the pose's mean does too.
            large = cv2.resize(coarse * np.float32(len(labels) / 64), labels.shape[::-1])
            moved = self._grid + large
            labels = cv2.remap(labels, moved, None, cv2.INTER_NEAREST)
            points = cv2.remap(points, moved, None, cv2.INTER_NEAREST)
        small = microscope.apply(small, rng)
        points, surface, vessels = _to_grid(points, labels, 2 * self._oversampling)
        if rng.uniform() < self.settings.negatives:
            small = impostor(small, rng)
            surface, vessels = np.zeros_like(surface), np.zeros_like(vessels)
        self._clear_bars(small, self._oversampling)
        return View(small, pose, points, surface, vessels)

    def _clear_bars(self, array: np.ndarray, reduction: int) -> None:
        """Zero, in place, the bars that a frame that is not square leaves in the network's input.

        array: (H, W, ...), `reduction` times smaller than the composed view.
        """
        rows, columns = (bar // reduction for bar in self._bars)
        array[:rows], array[len(array) - rows :] = 0, 0
        array[:, :columns], array[:, array.shape[1] - columns :] = 0, 0


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
