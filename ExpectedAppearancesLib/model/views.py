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
from ..augmentation.surroundings import continue_tissue, fill_outside, opening
from ..case.case import Case
from ..errors import InputError
from ..geometry.pose import pose_from_rotation, rotation_matrix
from ..masks.labels import BACKGROUND, VESSELS
from ..masks.renderer import MaskRenderer
from ..masks.stage import craniotomy_of, parenchyma_of, sampler_of
from ..poses.sampling import PoseSampler
from ..registration.encoding import network_camera
from .fold import known_poses, seen_from

COMPOSED_PX = 256  # smaller views are composed at twice their size, then averaged: frames are anti-aliased too
DRAWN_TRIANGLE_PX = 4.0  # area, seen from afar: software rendering of smaller ones costs much and shows nothing


@dataclass(frozen=True)
class View:
    """image uint8 (S, S, 3); camera_from_world (4, 4), of a bent view the nearest; on the grid of half the size:
    points_mm float32 (G, G, 3), the surface point seen, world mm; surface, vessels uint8 (G, G). A negative view has no
    surface."""

    image: np.ndarray
    camera_from_world: np.ndarray
    points_mm: np.ndarray
    surface: np.ndarray
    vessels: np.ndarray


@dataclass(frozen=True)
class ViewSettings:
    """How views are drawn. styles: textures used. negatives: share of views of something else.

    poses_file: views are seen from this file's poses only (the paper's protocol repeats its poses); None: from fresh
    ones. varied: False for the paper's views: appearances as they were synthesised, elastically deformed, and nothing
    else.
    """

    method: str
    size_px: int
    styles: tuple[str, ...]
    fresh_poses: bool
    negatives: float
    elastic_px: float
    seed: int
    poses_file: str | None = None
    varied: bool = True


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
        self._sampler: PoseSampler = sampler_of(self.case, settings.seed)
        nearest_mm, farthest_mm = self._sampler.ranges.working_distance_mm
        # Of a wide range's farthest views the triangles would spoil the near ones.
        px_mm = min(farthest_mm, 2 * nearest_mm) / self._large.fx
        drawn = [mesh.simplified(DRAWN_TRIANGLE_PX * px_mm**2) for mesh in (self.case.vessels, parenchyma)]
        self._renderer = MaskRenderer(*drawn, self._large)
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
        # Where in the composed view the cells' centres lie.
        middles = (np.arange(settings.size_px // 2, dtype=np.float32) + 0.5) * 2 * self._oversampling - 0.5
        self._cells_px = np.stack(np.meshgrid(middles, middles), axis=-1)
        frame = self.case.camera
        scale = self._large.width / max(frame.width, frame.height)
        self._bars = (
            round((self._large.height - frame.height * scale) / 2),
            round((self._large.width - frame.width * scale) / 2),
        )

    def view(self, index: int) -> View:
        rng = np.random.default_rng([self.settings.seed, 7, index])
        varied = self.settings.varied
        if self._painter:
            seen = self._poses
            pose = self._fresh_pose(index) if seen is None else seen[rng.integers(len(seen))]
            labels, depth_mm, points = self._renderer.render_surface(pose)
            where_px = self._painter.overview_px(points)
            if varied:
                image = self._painter.paint(labels, depth_mm, where_px, pose, rng)
                cortex = self._painter.cortex(rng)
            else:
                image = self._painter.as_synthesised(where_px, rng)
        else:
            appearance = self._appearances[rng.integers(len(self._appearances))]
            fresh = self.settings.fresh_poses and self._poses is None
            turn = self._camera_turn(appearance.camera_from_world, rng) if fresh else np.eye(3)
            pose = pose_from_rotation(turn, np.zeros(3)) @ appearance.camera_from_world
            labels, _, points = self._renderer.render_surface(pose)
            image = self._turned(appearance, turn)
            cortex = appearance.image
        if varied:
            image = self._in_a_field(image, labels, points, cortex, rng)
        else:
            self._clear_bars(labels, 1)
            image = cv2.copyTo(image, labels)
        return self._finish(image, pose, labels, points, rng)

    def _in_a_field(self, image, labels, points, cortex, rng) -> np.ndarray:
        """The view with what lies around the surface; what the craniotomy hides of it is taken out of `labels`."""
        hidden = opening(cv2.transform(points, self._frontal), self._middle_mm, self._extent_mm, rng)
        if hidden is not None:
            labels *= hidden
        self._clear_bars(labels, 1)
        tissue = labels != BACKGROUND
        if hidden is None:
            image, tissue = continue_tissue(image, tissue.astype(np.uint8), rng)
        return fill_outside(image, ~tissue, cortex, rng)

    def close(self) -> None:
        self._renderer.close()

    def _fresh_pose(self, index: int) -> np.ndarray:
        """A pose of the view's own; of a view before it where the ranges leave so little room that none is found: of
        the thousands of a training one would end it, although all that `render` drew were found."""
        while True:
            try:
                return self._sampler.sample(index)
            except InputError:
                if index == 0:
                    raise
            index -= 1

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
        cells_px = self._cells_px
        if self.settings.elastic_px > 0:
            # Smooth: a coarse field holds it. Its unit is a pixel of 128.
            amplitude = self.settings.elastic_px / 2 * rng.uniform()
            coarse = elastic.displacement_field((64, 64), amplitude, 64 * rng.uniform(0.12, 0.3), rng)
            field = cv2.resize(coarse * np.float32(size / 64), (size, size), interpolation=cv2.INTER_LINEAR)
            small = elastic.warp(small, field)
            # The brain moves and takes its points along: what a pixel shows stays true.
            moved = cv2.resize(coarse, cells_px.shape[1::-1], interpolation=cv2.INTER_LINEAR)
            cells_px = cells_px + moved * np.float32(len(labels) / 64)
        if self.settings.varied:
            small = microscope.apply(small, rng)
        points, surface, vessels = _to_grid(points, labels, cells_px)
        if self.settings.elastic_px > 0:
            pose = elastic.nearest_pose(pose, points, surface, self.camera)
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


def _to_grid(
    points_mm: np.ndarray, labels: np.ndarray, cells_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The surface point (G, G, 3) at each cell's centre (G, G, 2), between the four pixels around it; and whether it is
    surface, and vessel.

    A cell counts as surface only where all four see it, so that no point is averaged with nothing.
    """
    surface = cv2.remap((labels != BACKGROUND).astype(np.float32), cells_px, None, cv2.INTER_LINEAR) > 0.9999
    vessels = cv2.remap((labels == VESSELS).astype(np.float32), cells_px, None, cv2.INTER_LINEAR) >= 0.5
    points = cv2.remap(points_mm, cells_px, None, cv2.INTER_LINEAR)
    surface = surface.astype(np.uint8)
    return cv2.copyTo(points, surface), surface, vessels.astype(np.uint8)
