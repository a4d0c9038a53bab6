"""Last refinement of a pose: the outline of the vessels is brought onto the edges of the frame itself.

What the network takes for a vessel leans on where it believes the vessels to be. The frame does not: across a vessel's
outline its colour changes, and which change that is the frame tells. A classical tracker's search along the outline's
normals (Harris and Stennett, RAPID, 1990), on the colour axis that best tells inside from outside (Fisher's).
Numpy and OpenCV only.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import cv2
import numpy as np

from ..geometry.camera import Camera
from ..geometry.silhouette import Silhouette
from .descent import Descent, turn_and_place
from .pnp import PoseFit, projection_jacobian

SHARPER = 2  # frames are looked at in so many times the size that the network reads
NEAR_PX, FAR_PX = 4.0, 8.0  # how far edges are sought from the outline, to both sides
SURE = 0.8  # matched by so much, a near search has found the place
STEPS = 4  # of each search
POINTS = 400  # of the outline, at most
STEP_PX = 0.5  # between samples along a normal
NEAREST_PX, FARTHEST_PX = 1.0, 3.0  # off the outline: where the colours of its inside and outside are taken
WINDOW_PX = 2.0  # an edge lies between the means over so much
SIGMA_PX = 0.6  # error of an edge that was found
INDEPENDENT = 60.0  # the whole outline counts as this many independent points: neighbours err together
PRIOR = 100.0  # covariance of the fit is taken this many times: its own edges lean on its pose
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
        """Gauss-Newton from `fit`, which stays a weak prior, on the uint8 (H, W, 3) image: halved, then as it is.

        A far search strays where vessels are many and faint: it is made where a near one matched little, and what
        matches better goes on.
        """
        half, outline = _Picture.of(image_rgb, self.camera, 2), self._outline(fit)
        search = _EdgeSearch.for_colours(half, outline)
        found = search and self._descend(fit, outline, search, NEAR_PX)
        if found is None or found.matched < SURE:
            far = search and self._descend(fit, outline, search, FAR_PX)
            far = far and self._go_on(fit, far, half)
            if far and (found is None or far.matched > found.matched):
                found = far
        if found is None:
            return Contrast(fit, 0.0, NEAR_PX, 0.0, 0.0)
        return self._go_on(fit, found, _Picture.of(image_rgb, self.camera, 1)) or found

    def _go_on(self, fit: PoseFit, found: Contrast, picture: _Picture) -> Contrast | None:
        """A near search from where another one ended."""
        outline = self._outline(found.fit)
        search = _EdgeSearch.for_colours(picture, outline)
        return search and self._descend(fit, outline, search, NEAR_PX)

    def _outline(self, fit: PoseFit) -> _Outline:
        edges, inner = self._silhouette.edges_with_inside(fit.camera_from_world)
        every = len(edges) // POINTS + 1
        corners = np.concatenate([edges[::every, 0], edges[::every, 1], inner[::every]])
        corners = np.ascontiguousarray((self._vertices_mm[corners] - fit.centre_world_mm).T)
        return _Outline(fit, corners)

    def _descend(self, fit: PoseFit, outline: _Outline, search: _EdgeSearch, reach_px: float) -> Contrast | None:
        descent = Descent(fit, outline.fit, PRIOR)
        relative = outline.middles
        focal = np.array([search.camera.fx, search.camera.fy])
        for _ in range(STEPS):
            points, normals = outline.seen(descent.rotation, descent.position, search.camera)
            found = search.edges(points, normals, reach_px)
            if found is None:
                return None
            offsets_px, weight, tissue = found
            turned = descent.rotation @ relative
            jacobian = projection_jacobian(turned, turned + descent.position[:, None], focal)
            gradient = normals[0] * jacobian[:, 0] + normals[1] * jacobian[:, 1]
            if descent.step(gradient, weight * (INDEPENDENT / (SIGMA_PX**2 * tissue)), offsets_px):
                break
        refined = descent.result()
        if refined is None:
            return None
        used = weight > 0
        return Contrast(
            refined,
            float(weight.sum() / tissue),
            float(np.abs(offsets_px[used]).mean()) if used.any() else reach_px,
            search.separation,
            descent.moved_mm(self._radius_mm),
        )


@dataclass(frozen=True, eq=False)
class _Outline:
    """The outline as seen from the pose of `fit`. corners_mm (3, 3 E): of its E edges the beginnings, the ends, and a
    vertex within; from the fit's centre."""

    fit: PoseFit
    corners_mm: np.ndarray

    @property
    def middles(self) -> np.ndarray:
        """Of the edges, (3, E)."""
        count = self.corners_mm.shape[1] // 3
        return (self.corners_mm[:, :count] + self.corners_mm[:, count : 2 * count]) / 2

    def seen(self, rotation: np.ndarray, position: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """The edges' middles and outward normals in the image (2, E), from a pose given as `Descent` has it."""
        seen = rotation @ self.corners_mm + position[:, None]
        focal, principal = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        pixels = seen[:2] / np.maximum(seen[2], 1.0) * focal[:, None] + principal[:, None]
        a, b, within = np.split(pixels, 3, axis=1)
        return (a + b) / 2, _outward(a, b, within)


def _outward(a_px: np.ndarray, b_px: np.ndarray, within_px: np.ndarray) -> np.ndarray:
    """Unit normals (2, E) of the image's segments a-b (2, E) that point away from `within` (2, E)."""
    x, y = b_px - a_px
    across, down = within_px - a_px
    # Of (y, -x), which is a normal, the direction that points away.
    scale = np.where(y * across - x * down > 0, -1.0, 1.0) / np.maximum(np.sqrt(x * x + y * y), 1e-9)
    return np.stack([y * scale, -x * scale])


@dataclass(frozen=True, eq=False)
class _Picture:
    """A frame as `camera` takes it: image float32 (H, W, 3), a little blurred; dark uint8 (H, W), 1 off the field."""

    camera: Camera
    image: np.ndarray
    dark: np.ndarray

    @staticmethod
    def of(image_rgb: np.ndarray, camera: Camera, shrink: int) -> _Picture:
        if shrink > 1:
            camera = camera.resized(camera.width // shrink, camera.height // shrink)
            image_rgb = cv2.resize(image_rgb, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        red, green, blue = cv2.split(image_rgb)
        lightest = cv2.max(cv2.max(red, green), blue)
        dark = cv2.erode((lightest < DARK).astype(np.uint8), np.ones((3, 3), np.uint8))
        dark = cv2.dilate(dark, np.ones((5, 5), np.uint8))
        return _Picture(camera, cv2.GaussianBlur(image_rgb, (0, 0), 0.7).astype(np.float32), dark)


@dataclass(frozen=True, eq=False)
class _EdgeSearch:
    """Looks along normals for the vessels' edges in values (H, W), the picture on the colour axis of this frame."""

    camera: Camera
    values: np.ndarray
    dark: np.ndarray
    separation: float

    @staticmethod
    def for_colours(picture: _Picture, outline: _Outline) -> _EdgeSearch | None:
        """The axis on which colours beside the outline differ most; None where too little of it lies on tissue."""
        points_px, normals = outline.seen(*turn_and_place(outline.fit), picture.camera)
        if points_px.shape[1] < LEAST_POINTS:
            return None
        beside = np.arange(NEAREST_PX, FARTHEST_PX + STEP_PX / 2, STEP_PX)
        where = _along(points_px, normals, np.concatenate([-beside, beside]))
        colours = cv2.remap(picture.image, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        on_tissue = _on_tissue(picture.dark, where)
        if on_tissue.sum() < LEAST_POINTS:
            return None
        # Differences across the outline, so that light which changes from place to place does not count.
        inside, outside = colours[:, : len(beside)].mean(axis=1), colours[:, len(beside) :].mean(axis=1)
        across = (inside - outside)[on_tissue].astype(float)
        mean = across.mean(axis=0)
        apart = across - mean
        axis = np.linalg.solve(apart.T @ apart / (len(across) - 1) + 4 * np.eye(3), mean)
        values = cv2.transform(picture.image, axis[None].astype(np.float32))
        return _EdgeSearch(picture.camera, values, picture.dark, float(np.sqrt(max(mean @ axis, 0.0))))

    def edges(
        self, points_px: np.ndarray, normals: np.ndarray, reach_px: float
    ) -> tuple[np.ndarray, np.ndarray, int] | None:
        """Offset of the step along each normal that is most like the expected one, px (E,), its weight (E,), and how
        many points lie on tissue; None when these are too few."""
        samples_px, across, step = _search(reach_px)
        where = _along(points_px, normals, samples_px)
        on_tissue = _on_tissue(self.dark, where)
        tissue = int(on_tissue.sum())
        if tissue < LEAST_POINTS:
            return None
        values = cv2.remap(self.values, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        expected = max(float((values @ across) @ on_tissue) / tissue, 1e-9)
        response, margin = cv2.filter2D(values, -1, step), step.shape[1] // 2
        best = response[:, margin:-margin].argmax(axis=1) + margin
        best = np.clip(best, margin + 1, len(samples_px) - margin - 2)
        place, flat = best + len(samples_px) * np.arange(len(best)), response.ravel() / np.float32(expected)
        before, peak, after = flat[place - 1], flat[place], flat[place + 1]
        bend = before - 2 * peak + after
        between = np.where(bend < -1e-9, 0.5 * (before - after) / np.minimum(bend, -1e-9), 0.0)
        offsets_px = samples_px[best] + STEP_PX * np.clip(between, -1, 1)
        last = reach_px - WINDOW_PX + STEP_PX
        near = np.clip(1 - (offsets_px / last) ** 2, 0, 1) ** 2
        is_peak = (peak >= before) & (peak >= after)
        return offsets_px, np.clip(peak, 0, 1.5) * near * is_peak * on_tissue, tissue


@functools.lru_cache(maxsize=8)
def _search(reach_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offsets of the samples (K,), what takes from them the mean difference of inside and outside (K,), and the filter
    (1, 2 W + 1) that answers to a step between the means of W samples before and behind."""
    samples_px = np.arange(-reach_px, reach_px + STEP_PX / 2, STEP_PX)
    beside = (np.abs(samples_px) > NEAREST_PX - STEP_PX / 2) & (np.abs(samples_px) < FARTHEST_PX + STEP_PX / 2)
    across = np.where(beside, -2 * np.sign(samples_px) / beside.sum(), 0).astype(np.float32)
    window = round(WINDOW_PX / STEP_PX)
    step = np.sign(np.arange(window, -window - 1, -1))[None] / window
    return samples_px, across, step.astype(np.float32)


def _along(points_px: np.ndarray, normals: np.ndarray, offsets_px: np.ndarray) -> np.ndarray:
    """Positions (E, K, 2) float32 at those offsets (K,) along the normals (2, E) of points (2, E)."""
    points_px, normals = (values.T.astype(np.float32)[:, None] for values in (points_px, normals))
    return points_px + normals * offsets_px.astype(np.float32)[:, None]


def _on_tissue(dark: np.ndarray, where: np.ndarray) -> np.ndarray:
    """bool (E,): whether no position (E, K, 2) of a point lies off the field."""
    off = cv2.remap(dark, where, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=1)
    return ~off.any(axis=1)
