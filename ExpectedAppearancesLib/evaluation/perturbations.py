"""What may disturb a frame in the operating room, at stated strengths, for the robustness table.

Each perturbation takes a frame and the camera it is said to be taken by, and returns both; lengths are fractions of the
frame's shorter side. With the same generator state a stronger one grows out of a weaker one: same place and direction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from ..augmentation import elastic
from ..geometry.camera import Camera

DARK = 12  # a pixel below this in every channel is no part of the lit field
DISPLAY_GAMMA = 2.2
# Sigma of the bulge of brain shift across and along the way the tissue moves, in units of the field's size. Short along
# that way, 10 mm would fold the image over.
SHIFT_WIDTHS = (0.3, 1.2)


@dataclass(frozen=True)
class FrameState:
    """image uint8 RGB (H, W, 3); camera: what registration is told; px_per_mm at the vessels' depth."""

    image: np.ndarray
    camera: Camera
    px_per_mm: float


@dataclass(frozen=True)
class Perturbation:
    """kind and strength as the table names them; apply(state, rng) -> (image, camera)."""

    kind: str
    strength: str
    apply: Callable[[FrameState, np.random.Generator], tuple[np.ndarray, Camera]]


def perturbations() -> list[Perturbation]:
    """All of the table, each kind from weak to strong."""
    rows = []

    def add(kind: str, strengths, text: str, function) -> None:
        for value in strengths:
            rows.append(Perturbation(kind, text.format(value), _image_only(function, value)))

    for kind, function in (("instrument", instrument), ("blood", blood), ("sponge", sponge)):
        add(f"occlusion by {kind}", (10, 20, 30, 40), "{} % of the field", function)
    add("specular spots", (10, 30, 90), "{} spots", specular_spots)
    add("defocus", (0.5, 1.0, 2.0), "sigma {} % of the side", defocus)
    add("motion blur", (1, 2, 4), "streak {} % of the side", motion_blur)
    add("exposure", (-2, -1, 1, 2), "{:+d} stops", exposure)
    add("white balance", (-30, -15, 15, 30), "red {:+d} %, blue the other way", white_balance)
    add("noise", (2, 5, 10), "standard deviation {} % of full scale", noise)
    add("JPEG", (50, 20, 10), "quality {}", jpeg)
    for percent in (-10, -5, -1, 1, 5, 10):
        rows.append(Perturbation("focal length given wrong", f"{percent:+d} %", _wrong_focal_length(percent)))
    for shift_mm in (2, 5, 10):
        rows.append(Perturbation("brain shift", f"{shift_mm} mm", _brain_shift(shift_mm)))
    return rows


def _image_only(function, value):
    return lambda state, rng: (function(state.image, value, rng), state.camera)


def _wrong_focal_length(percent: float):
    factor = 1 + percent / 100

    def apply(state: FrameState, _rng):
        return state.image, replace(state.camera, fx=state.camera.fx * factor, fy=state.camera.fy * factor)

    return apply


def _brain_shift(shift_mm: float):
    return lambda state, rng: (brain_shift(state.image, shift_mm * state.px_per_mm, rng), state.camera)


def brain_shift(image: np.ndarray, shift_px: float, rng: np.random.Generator) -> np.ndarray:
    """The tissue moved smoothly, at most by `shift_px`, with no affine part: the view's pose stays what it was."""
    return elastic.warp(image, shift_field(_field(image), shift_px, rng))


def shift_field(field: np.ndarray, shift_px: float, rng: np.random.Generator) -> np.ndarray:
    """Displacement (H, W, 2), float32, px: one broad bulge to one side. Within the lit field (H, W), bool, its
    least-squares affine part is zero and its longest displacement `shift_px`."""
    field = field if field.any() else np.ones_like(field)
    across_sigma, along_sigma = (width * np.sqrt(field.sum()) for width in SHIFT_WIDTHS)
    x, y = _grid(field.shape)
    rows, columns = np.nonzero(field)
    middle = [rng.uniform(*np.quantile(of, (0.3, 0.7))) for of in (columns, rows)]
    angle = rng.uniform(0, 2 * np.pi)
    along = np.cos(angle) * (x - middle[0]) + np.sin(angle) * (y - middle[1])
    across = np.cos(angle) * (y - middle[1]) - np.sin(angle) * (x - middle[0])
    bulge = np.exp(-0.5 * ((across / across_sigma) ** 2 + (along / along_sigma) ** 2))
    affine = np.stack([np.ones_like(x), x, y], axis=-1)
    bulge -= affine @ np.linalg.lstsq(affine[field], bulge[field], rcond=None)[0]
    bulge *= shift_px / np.abs(bulge[field]).max()
    # Outside the field there is nothing to move, and an affine part grows without end.
    bulge = np.clip(bulge, -shift_px, shift_px)
    return (bulge[..., None] * np.array([np.cos(angle), np.sin(angle)])).astype(np.float32)


def instrument(image: np.ndarray, percent: float, rng: np.random.Generator) -> np.ndarray:
    """A metal shaft from the border across the field, so wide that it hides `percent` of the lit field."""
    x, y = _centred(image)
    angle, offset = rng.uniform(0, 2 * np.pi), rng.uniform(-0.15, 0.15) * min(image.shape[:2])
    across = np.abs(-np.sin(angle) * x + np.cos(angle) * y - offset)
    along = np.cos(angle) * x + np.sin(angle) * y
    tip = 0.3 * min(image.shape[:2])
    # Beyond its tip the shaft ends round; a half plane would hide nothing of the other side.
    mask = _hiding(np.where(along < tip, across, np.hypot(across, along - tip)), image, percent)
    shade = 150 + 70 * np.cos(across * (6.0 / max(1.0, across[mask].max() if mask.any() else 1.0)))
    return _laid_over(image, mask, shade[..., None] * np.array([0.95, 0.98, 1.0]))


def blood(image: np.ndarray, percent: float, rng: np.random.Generator) -> np.ndarray:
    """Pools of blood over `percent` of the lit field."""
    pools = _smooth_noise(image, 5, rng)
    colour = np.array([120.0, 12.0, 14.0]) * (1 + 0.25 * _smooth_noise(image, 16, rng)[..., None])
    return _laid_over(image, _hiding(pools, image, percent), colour)


def sponge(image: np.ndarray, percent: float, rng: np.random.Generator) -> np.ndarray:
    """A square white sponge over `percent` of the lit field."""
    x, y = _centred(image)
    side = min(image.shape[:2])
    x, y, angle = x - rng.uniform(-0.25, 0.25) * side, y - rng.uniform(-0.25, 0.25) * side, rng.uniform(0, np.pi)
    turned = np.cos(angle) * x + np.sin(angle) * y, -np.sin(angle) * x + np.cos(angle) * y
    weave = 215 + 18 * _smooth_noise(image, 60, rng)[..., None] * np.ones(3)
    return _laid_over(image, _hiding(np.maximum(*np.abs(turned)), image, percent), weave)


def specular_spots(image: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """`count` saturated reflections with a soft edge, on the lit field."""
    side = min(image.shape[:2])
    rows, columns = np.nonzero(_field(image))
    light = np.zeros(image.shape[:2], np.float32)
    for _ in range(count if len(rows) else 0):
        at = rng.integers(len(rows))
        axes = [max(1, round(side * rng.uniform(0.004, 0.02))) for _ in range(2)]
        cv2.ellipse(light, (int(columns[at]), int(rows[at])), axes, rng.uniform(0, 180), 0, 360, 1.0, -1)
    light = cv2.GaussianBlur(light, (0, 0), max(0.4, 0.003 * side))[..., None]
    return _byte(image * (1 - light) + 255.0 * light)


def defocus(image: np.ndarray, percent: float, _rng) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), percent / 100 * min(image.shape[:2]))


def motion_blur(image: np.ndarray, percent: float, rng: np.random.Generator) -> np.ndarray:
    """A straight streak, in any direction."""
    half = percent / 200 * min(image.shape[:2])
    reach = int(np.ceil(half)) + 1
    angle = rng.uniform(0, np.pi)
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    for t in np.linspace(-half, half, 8 * reach + 1):
        x, y = reach + t * np.cos(angle), reach + t * np.sin(angle)
        column, row, fx, fy = int(x), int(y), x - int(x), y - int(y)
        kernel[row : row + 2, column : column + 2] += np.outer([1 - fy, fy], [1 - fx, fx]).astype(np.float32)
    return cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT_101)


def exposure(image: np.ndarray, stops: float, _rng) -> np.ndarray:
    """Twice the light for each stop, in linear light, saturating."""
    return _byte(255 * ((image / 255.0) ** DISPLAY_GAMMA * 2.0**stops) ** (1 / DISPLAY_GAMMA))


def white_balance(image: np.ndarray, percent: float, _rng) -> np.ndarray:
    return _byte(image * np.array([1 + percent / 100, 1.0, 1 - percent / 100]))


def noise(image: np.ndarray, percent: float, rng: np.random.Generator) -> np.ndarray:
    return _byte(image + 2.55 * percent * rng.standard_normal(image.shape))


def jpeg(image: np.ndarray, quality: int, _rng) -> np.ndarray:
    data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, int(quality)])[1]
    return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])


def _field(image: np.ndarray) -> np.ndarray:
    return (image > DARK).any(axis=-1)


def _hiding(score: np.ndarray, image: np.ndarray, percent: float) -> np.ndarray:
    """The pixels of lowest score (H, W) that hold `percent` of the lit field."""
    field = _field(image)
    return score <= np.quantile(score[field] if field.any() else score, percent / 100)


def _laid_over(image: np.ndarray, mask: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """`colour` (H, W, 3), 0..255, where the mask is, its edge a pixel or so soft."""
    alpha = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), max(0.5, 0.003 * min(mask.shape)))[..., None]
    return _byte(image * (1 - alpha) + colour * alpha)


def _smooth_noise(image: np.ndarray, nodes: int, rng: np.random.Generator) -> np.ndarray:
    coarse = rng.standard_normal((nodes, nodes)).astype(np.float32)
    return cv2.resize(coarse, image.shape[1::-1], interpolation=cv2.INTER_CUBIC).astype(np.float64)


def _grid(shape_hw: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[: shape_hw[0], : shape_hw[1]].astype(np.float64)
    return x, y


def _centred(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixel coordinates with the middle of the lit field as the origin."""
    x, y = _grid(image.shape[:2])
    rows, columns = np.nonzero(_field(image))
    if not len(rows):
        return x - image.shape[1] / 2, y - image.shape[0] / 2
    return x - columns.mean(), y - rows.mean()


def _byte(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
