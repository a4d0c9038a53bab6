"""What a surgical microscope, its light and the open field do to an image; the pose stays what it was.

Strong photometric variety is what lets a network trained on a few textures cope with one it has never seen.
Lengths are fractions of the image's shorter side, so one look serves every resolution.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

Range = tuple[float, float]


@dataclass(frozen=True)
class MicroscopeLook:
    """Ranges that each image draws from uniformly; names that end in _probability are shares of images."""

    exposure_stops: Range = (-1.5, 1.2)
    contrast: Range = (0.6, 1.5)
    white_balance: Range = (0.7, 1.35)  # gain of each channel
    hue_deg: Range = (-22.0, 22.0)
    saturation: Range = (0.3, 1.6)
    gamma: Range = (0.6, 1.6)
    light_gradient: Range = (0.0, 0.35)  # slow unevenness of the light
    vignetting: Range = (0.0, 0.6)  # loss of light in the corner
    defocus: Range = (0.0, 0.012)  # sigma
    motion: Range = (0.0, 0.035)  # length of the streak
    motion_probability: float = 0.15
    noise: Range = (0.0, 0.04)  # standard deviation, of full scale
    specular_spots: Range = (0.0, 14.0)  # number
    specular_probability: float = 0.6
    fine_vessels: Range = (1.0, 8.0)  # number of thin arteries that the mesh does not have
    fine_vessels_probability: float = 0.4
    blood_probability: float = 0.15
    sponge_probability: float = 0.1
    instrument_probability: float = 0.15
    retractor_probability: float = 0.05
    circular_field: Range = (0.36, 0.6)  # radius
    circular_field_probability: float = 0.15
    jpeg_quality: Range = (10.0, 95.0)
    jpeg_probability: float = 0.2

    def __post_init__(self) -> None:
        for field in fields(self):
            low, high = (0.0, getattr(self, field.name)) if "_probability" in field.name else getattr(self, field.name)
            if not low <= high or (field.name.endswith("_probability") and high > 1):
                raise ValueError(f"{field.name}: {getattr(self, field.name)} is not a valid range")


DEFAULT = MicroscopeLook()
NO_CHANGE = MicroscopeLook(
    exposure_stops=(0, 0),
    contrast=(1, 1),
    white_balance=(1, 1),
    hue_deg=(0, 0),
    saturation=(1, 1),
    gamma=(1, 1),
    light_gradient=(0, 0),
    vignetting=(0, 0),
    defocus=(0, 0),
    motion_probability=0.0,
    noise=(0, 0),
    specular_probability=0.0,
    fine_vessels_probability=0.0,
    blood_probability=0.0,
    sponge_probability=0.0,
    instrument_probability=0.0,
    retractor_probability=0.0,
    circular_field_probability=0.0,
    jpeg_probability=0.0,
)


def apply(image: np.ndarray, rng: np.random.Generator, look: MicroscopeLook | None = None) -> np.ndarray:
    """uint8 RGB (H, W, 3) -> uint8 RGB (H, W, 3), the input unchanged. The same generator state gives the same image.
    Without a `look`, the default one at a strength that is drawn too.

    In the order of the light: scene (arteries, blood, instruments, reflections), illumination, optics, sensor, file.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"image {image.shape} {image.dtype} is not uint8 RGB")
    look = look or _toned_down(DEFAULT, rng.uniform(0.15, 1.0))
    scene = image.copy()
    if rng.random() < look.fine_vessels_probability:
        _draw_fine_vessels(scene, rng, look)
    # Colour before the occluders: blood and steel keep their own colour under any texture.
    scene = _colour(scene, rng, look)
    if rng.random() < look.blood_probability:
        scene = _draw_blood(scene, rng)
    if rng.random() < look.sponge_probability:
        scene = _draw_sponge(scene, rng)
    if rng.random() < look.instrument_probability:
        scene = _draw_instrument(scene, rng)
    if rng.random() < look.retractor_probability:
        scene = _draw_retractor(scene, rng)
    light = _light(scene.shape[:2], rng, look)
    if rng.random() < look.specular_probability:
        scene = _draw_specular_spots(scene, rng, look)
    scene = _blur(scene, rng, look)
    result = _expose(scene, light, rng, look)
    if rng.random() < look.circular_field_probability:
        result = _cut_to_circle(result, rng, look)
    if rng.random() < look.jpeg_probability:
        quality = int(rng.uniform(*look.jpeg_quality))
        result = cv2.imdecode(cv2.imencode(".jpg", result, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], cv2.IMREAD_COLOR)
    return result


# Lengths and amounts whose neutral value is not NO_CHANGE's, or which a mild look may have in full.
_NOT_TONED = {"motion", "specular_spots", "fine_vessels", "circular_field", "jpeg_quality"}


def _toned_down(look: MicroscopeLook, strength: float) -> MicroscopeLook:
    """Every range drawn together towards no change: most frames are mild in all ways at once, few in none."""
    changed = {}
    for field in fields(look):
        if not field.name.endswith("_probability") and field.name not in _NOT_TONED:
            neutral = getattr(NO_CHANGE, field.name)[0]
            low, high = getattr(look, field.name)
            changed[field.name] = (neutral + (low - neutral) * strength, neutral + (high - neutral) * strength)
    return replace(look, **changed)


def _colour(image: np.ndarray, rng: np.random.Generator, look: MicroscopeLook) -> np.ndarray:
    """White balance, hue and saturation as one 3x3 matrix; the hue turns about the grey axis."""
    angle, saturation = math.radians(rng.uniform(*look.hue_deg)), rng.uniform(*look.saturation)
    grey = np.full((3, 3), 1 / 3)
    cross = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / math.sqrt(3)
    chroma = math.cos(angle) * (np.eye(3) - grey) + math.sin(angle) * cross
    gains = rng.uniform(*look.white_balance, size=3)
    return cv2.transform(image, np.diag(gains) @ (grey + saturation * chroma))


def _light(shape_hw: tuple[int, int], rng: np.random.Generator, look: MicroscopeLook) -> np.ndarray | None:
    """Factor of the illumination (H, W, 3), float32: slow unevenness times vignetting; None when there is none."""
    height, width = shape_hw
    strength, corner = rng.uniform(*look.light_gradient), rng.uniform(*look.vignetting)
    nodes = rng.uniform(1 - strength, 1 + strength, (3, 3)).astype(np.float32)
    if strength == corner == 0:
        return None
    light = cv2.resize(nodes, (width, height), interpolation=cv2.INTER_CUBIC)
    light *= 1 - np.float32(corner) * _squared_radius(height, width)
    return cv2.cvtColor(light, cv2.COLOR_GRAY2RGB)


@functools.lru_cache(maxsize=8)
def _squared_radius(height: int, width: int) -> np.ndarray:
    """Squared distance from the middle (H, W), 1 in the corners."""
    y, x = np.linspace(-1, 1, height, dtype=np.float32), np.linspace(-1, 1, width, dtype=np.float32)
    return (x[None, :] ** 2 + y[:, None] ** 2) / 2


def _blur(image: np.ndarray, rng: np.random.Generator, look: MicroscopeLook) -> np.ndarray:
    short_side = min(image.shape[:2])
    sigma_px = rng.uniform(*look.defocus) * short_side
    if sigma_px > 0.25:
        image = cv2.GaussianBlur(image, (0, 0), sigma_px)
    if rng.random() < look.motion_probability:
        length_px, angle = rng.uniform(*look.motion) * short_side, rng.uniform(0, math.pi)
        size = 2 * math.ceil(length_px / 2) + 1
        step, kernel = length_px / 2 * np.array([math.cos(angle), math.sin(angle)]), np.zeros((size, size), np.uint8)
        ends = np.rint((np.array([-step, step]) + size // 2) * 16).astype(int)
        cv2.line(kernel, ends[0].tolist(), ends[1].tolist(), 255, 1, cv2.LINE_AA, shift=4)
        if size > 1:
            image = cv2.filter2D(image, -1, kernel.astype(np.float32) / kernel.sum(dtype=np.float32))
    return image


def _expose(image: np.ndarray, light: np.ndarray | None, rng: np.random.Generator, look: MicroscopeLook) -> np.ndarray:
    """Light, exposure, contrast about the mean, noise, then a gamma for each channel as a table."""
    gain, contrast = 2 ** rng.uniform(*look.exposure_stops), rng.uniform(*look.contrast)
    scene = cv2.multiply(image, light, dtype=cv2.CV_32F) if light is not None else image.astype(np.float32)
    offset = float(np.mean(cv2.mean(scene)[:3])) * gain * (1 - contrast)
    scene = cv2.addWeighted(scene, gain * contrast, scene, 0, offset)
    noise = rng.uniform(*look.noise) * 255
    if noise > 0:
        scene = cv2.scaleAdd(_noise(scene.shape, rng), noise, scene)
    common = rng.uniform(*look.gamma)
    exponents = common * rng.uniform(0.9, 1.1, 3) if look.gamma[0] < look.gamma[1] else np.full(3, common)
    table = np.rint(255 * np.linspace(0, 1, 256)[:, None] ** exponents).astype(np.uint8)
    return cv2.LUT(cv2.convertScaleAbs(cv2.max(scene, 0.0)), table[None])


def _noise(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Standard normal numbers, float32: a random window of a fixed bank, as drawing them costs most of the time."""
    count = math.prod(shape)
    bank = _noise_bank(2 * count)
    start = int(rng.integers(0, len(bank) - count + 1))
    return bank[start : start + count].reshape(shape)


@functools.lru_cache(maxsize=4)
def _noise_bank(count: int) -> np.ndarray:
    return np.random.default_rng(2023).standard_normal(count, np.float32)


def _draw_fine_vessels(image: np.ndarray, rng: np.random.Generator, look: MicroscopeLook) -> None:
    """Thin wandering red lines, in place: clutter that looks like vessels and is not in the model."""
    height, width = image.shape[:2]
    short_side = min(height, width)
    for _ in range(round(rng.uniform(*look.fine_vessels))):
        start = rng.uniform(0, 1, 2) * (width, height)
        headings = rng.uniform(0, 2 * math.pi) + np.cumsum(rng.normal(0, 0.35, 12))
        steps = rng.uniform(0.015, 0.05) * short_side * np.stack([np.cos(headings), np.sin(headings)], 1)
        points = np.rint((start + np.cumsum(steps, 0)) * 16).astype(np.int32)
        column, row = np.clip(start.astype(int), 0, (width - 1, height - 1))
        colour = image[row, column] * rng.uniform((0.55, 0.25, 0.25), (1.0, 0.8, 0.8))
        thickness = max(1, round(rng.uniform(0.002, 0.012) * short_side))
        cv2.polylines(image, [points], False, colour.tolist(), thickness, cv2.LINE_AA, shift=4)


def _draw_blood(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Pools of blood: irregular red blobs, darker and lighter within, from a drop to a fifth of the field."""
    height, width = image.shape[:2]
    short_side = min(height, width)
    mask = np.zeros((height, width), np.uint8)
    angles = np.linspace(0, 2 * math.pi, 14, endpoint=False)
    around = np.stack([np.cos(angles), np.sin(angles)], 1)
    for _ in range(rng.integers(1, 5)):
        radii = rng.uniform(0.03, 0.2) * short_side * rng.uniform(0.6, 1.4, 14)
        outline = rng.uniform(0, 1, 2) * (width, height) + radii[:, None] * around
        cv2.fillPoly(mask, [np.rint(outline).astype(np.int32)], 255, cv2.LINE_AA)
    shades = rng.uniform(0.6, 1.4, (5, 5)).astype(np.float32)
    shade = cv2.resize(shades, (width, height), interpolation=cv2.INTER_CUBIC)
    red = rng.uniform(60, 180) * np.array([1.0, *rng.uniform(0.0, 0.25, 2)], np.float32)
    colour = cv2.cvtColor(shade, cv2.COLOR_GRAY2RGB) * red
    return _blend(image, mask, colour, rng.uniform(0.75, 1.0), rng.uniform(0.004, 0.02) * short_side)


def _draw_instrument(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A metal shaft from the border, or the two blades of a forceps, with bands of light and dark along it."""
    height, width = image.shape[:2]
    short_side, angle = min(height, width), rng.uniform(0, 2 * math.pi)
    tip = np.array([width, height]) * rng.uniform(0.1, 0.9, 2)
    thickness = rng.uniform(0.15, 0.45) ** 2 * short_side  # 2 to 20 %, more often thin
    metal = rng.uniform(50, 210) + rng.uniform(-10, 10, 3)
    bands = rng.uniform(0.5, 1.7, 4)
    for blade in range(1 + (rng.random() < 0.3)):
        direction = np.array([math.cos(angle + 0.2 * blade), math.sin(angle + 0.2 * blade)])
        sideways = np.array([-direction[1], direction[0]])
        start = tip + 2 * thickness * blade * sideways
        for part, band in zip((1.0, 0.75, 0.5, 0.2), bands):
            mask = np.zeros((height, width), np.uint8)
            line = start + sideways * thickness * (1 - part) * rng.uniform(-0.4, 0.4)
            ends = [np.rint(end).astype(int).tolist() for end in (line, line + direction * (height + width))]
            cv2.line(mask, *ends, 255, max(1, round(thickness * part)), cv2.LINE_AA)
            image = _blend(image, mask, np.clip(metal * band, 0, 255), 1.0, 0.05 * thickness)
    return image


def _draw_sponge(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A cotton patch: a pale woven rectangle, often stained."""
    height, width = image.shape[:2]
    short_side = min(height, width)
    sides = rng.uniform(0.08, 0.45, 2) * short_side
    centre = rng.uniform(0.1, 0.9, 2) * (width, height)
    corners = cv2.boxPoints((centre.tolist(), sides.tolist(), rng.uniform(0, 180)))
    mask = np.zeros((height, width), np.uint8)
    cv2.fillPoly(mask, [np.rint(corners * 16).astype(np.int32)], 255, cv2.LINE_AA, shift=4)
    stain = rng.uniform(0, 0.6)
    colour = (1 - stain) * rng.uniform(180, 250) + stain * rng.uniform((120, 20, 20), (200, 90, 80))
    weave = cv2.GaussianBlur(_noise((height, width), rng), (0, 0), rng.uniform(0.5, 2.5))
    weave *= np.float32(rng.uniform(4, 25)) / max(weave.std(), np.float32(1e-6))
    return _blend(image, mask, colour + weave[..., None], 1.0, 0.0)


def _draw_retractor(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A broad blade from the border, of metal or in shadow, with a rounded end."""
    height, width = image.shape[:2]
    short_side, angle = min(height, width), rng.uniform(0, 2 * math.pi)
    direction = np.array([math.cos(angle), math.sin(angle)])
    tip = np.array([width, height]) / 2 + direction * rng.uniform(0.25, 0.5) * short_side
    far = tip + direction * (height + width)
    mask = np.zeros((height, width), np.uint8)
    ends = [np.rint(end).astype(int).tolist() for end in (tip, far)]
    cv2.line(mask, *ends, 255, round(rng.uniform(0.15, 0.35) * short_side), cv2.LINE_AA)
    return _blend(image, mask, np.full(3, rng.uniform(30, 200)) + rng.uniform(-10, 10, 3), 1.0, 0.006 * short_side)


def _draw_specular_spots(image: np.ndarray, rng: np.random.Generator, look: MicroscopeLook) -> np.ndarray:
    """White reflections of the lamp on the wet surface, in a loose cluster of small ellipses."""
    height, width = image.shape[:2]
    short_side, mask = min(height, width), np.zeros((height, width), np.uint8)
    middle, spread = rng.uniform(0.1, 0.9, 2), rng.uniform(0.05, 0.5)
    for _ in range(round(rng.uniform(*look.specular_spots))):
        centre = (middle + rng.normal(0, spread, 2)) * (width, height)
        axes = rng.uniform(0.004, 0.03, 2) * short_side
        centre, axes = (np.rint(value * 16).astype(int).tolist() for value in (centre, axes))
        cv2.ellipse(mask, centre, axes, rng.uniform(0, 180), 0, 360, 255, -1, cv2.LINE_AA, shift=4)
    return _blend(image, mask, np.full(3, 255.0), rng.uniform(0.6, 1.0), 0.004 * short_side)


def _blend(image: np.ndarray, mask: np.ndarray, colour: np.ndarray, opacity: float, edge_px: float) -> np.ndarray:
    """`colour`, one or (H, W, 3), over `image` where the uint8 mask says, its edge softened over about `edge_px`."""
    if edge_px > 0.25:
        mask = cv2.GaussianBlur(mask, (0, 0), edge_px)
    alpha = mask * np.float32(opacity / 255)
    flat = np.empty_like(image)
    flat[:] = np.clip(colour, 0, 255)
    return cv2.blendLinear(image, flat, 1 - alpha, alpha)


def _cut_to_circle(image: np.ndarray, rng: np.random.Generator, look: MicroscopeLook) -> np.ndarray:
    """Black outside the round field of the microscope."""
    height, width = image.shape[:2]
    radius = rng.uniform(*look.circular_field) * min(height, width)
    centre = np.array([width - 1, height - 1]) / 2 + rng.normal(0, 0.02, 2) * min(height, width)
    mask = np.zeros((height, width), np.uint8)
    cv2.circle(mask, np.rint(centre * 16).astype(int).tolist(), round(radius * 16), 255, -1, cv2.LINE_AA, shift=4)
    return cv2.multiply(image, cv2.cvtColor(mask, cv2.COLOR_GRAY2RGB), scale=1 / 255)
