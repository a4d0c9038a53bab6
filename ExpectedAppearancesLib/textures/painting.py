"""Procedural colours of a cortex: mottled parenchyma, fine arteries, wet highlights, and veins shaded as tubes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Colour = tuple[float, float, float]  # RGB, 0..255


@dataclass(frozen=True)
class Palette:
    """Colours of one appearance. blush: where parenchyma is fuller of blood; crown: where it is paler."""

    parenchyma: Colour
    blush: Colour
    crown: Colour
    artery: Colour
    vein: Colour
    vein_edge: Colour
    mottling: float = 1.0
    arteries: int = 14
    wetness: float = 1.0


def noise(rng: np.random.Generator, size: int, cells: float) -> np.ndarray:
    """(size, size) smooth noise, mean 0, deviation 1; `cells` blobs fit across it."""
    import cv2

    count = max(2, round(cells)) + 3
    coarse = rng.normal(size=(count, count)).astype(np.float32)
    step = (count - 3) / size
    grid = (np.arange(size, dtype=np.float32) * step + 1) + rng.uniform(0, 0.9)
    x, y = np.meshgrid(grid, grid)
    smooth = cv2.remap(coarse, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return (smooth - smooth.mean()) / (smooth.std() + 1e-6)


def fractal(rng: np.random.Generator, size: int, cells: float, octaves: int, fall: float = 0.55) -> np.ndarray:
    """Noise of several scales, each twice as fine and `fall` times as strong as the one before; deviation 1."""
    total = sum(fall**i * noise(rng, size, min(cells * 2**i, size / 2)) for i in range(octaves))
    return total / total.std()


def mix(image: np.ndarray, colour: Colour | np.ndarray, share: np.ndarray) -> np.ndarray:
    """Blend float RGB (H, W, 3) towards `colour` by share (H, W)."""
    return image + (np.asarray(colour, np.float32) - image) * share[..., None]


def soft_step(values: np.ndarray, middle: float, width: float) -> np.ndarray:
    return 1 / (1 + np.exp(-(values - middle) / width))


def paint_parenchyma(rng: np.random.Generator, size: int, palette: Palette) -> np.ndarray:
    """Float RGB (size, size, 3) of parenchyma with mottling of scales from gyri down to single pixels."""
    image = np.broadcast_to(np.asarray(palette.parenchyma, np.float32), (size, size, 3)).copy()
    image = mix(image, palette.crown, 0.75 * soft_step(fractal(rng, size, 4, 3), 0.3, 0.35))
    image = mix(image, palette.blush, 0.7 * palette.mottling * soft_step(fractal(rng, size, 5, 4), 0.75, 0.3))
    image = mix(image, palette.blush, 0.35 * palette.mottling * soft_step(fractal(rng, size, 28, 3), 0.9, 0.3))
    light = 1 + 0.05 * fractal(rng, size, 9, 4) + 0.022 * fractal(rng, size, 60, 3, 0.8)
    return image * light[..., None].astype(np.float32)


def paint_arteries(rng: np.random.Generator, image: np.ndarray, palette: Palette) -> np.ndarray:
    """Draw a net of fine red arteries, 1 to 3 px wide, and of fainter capillaries onto float RGB."""
    import cv2

    size = image.shape[0]
    layer = np.zeros((size, size), np.float32)
    for _ in range(palette.arteries):
        edge = rng.integers(4)
        along, inward = rng.uniform(0, size), rng.uniform(-0.1, 0.4) * size
        start = [(along, inward), (size - inward, along), (along, size - inward), (inward, along)][edge]
        heading = np.pi / 2 * (edge + 1) + rng.normal(0, 0.6)
        _draw_artery(rng, layer, np.array(start), heading, rng.uniform(1.8, 3.0), depth=0)
    capillaries = np.zeros_like(layer)
    for _ in range(round(palette.arteries * 12)):
        _draw_artery(rng, capillaries, rng.uniform(0, size, 2), rng.uniform(0, 6.3), 1.0, depth=3)
    share = 0.75 * cv2.GaussianBlur(layer, (0, 0), 0.6) + 0.3 * cv2.GaussianBlur(capillaries, (0, 0), 0.7)
    # Fine vessels fade where they dive below the surface.
    fading = 0.55 + 0.45 * soft_step(fractal(rng, size, 7, 2), -0.3, 0.4)
    return mix(image, palette.artery, np.clip(share * fading, 0, 0.9).astype(np.float32))


def _draw_artery(rng, layer, start, heading, width_px, depth) -> None:
    import cv2

    size = layer.shape[0]
    count = int(rng.uniform(12, 34) * (1.0 if depth < 3 else 0.45))
    step = size / 128
    headings = heading + np.cumsum(rng.normal(0, 0.22, count))
    points = start + np.cumsum(step * np.stack([np.cos(headings), np.sin(headings)], axis=1), axis=0)
    thickness = max(1, round(width_px))
    strength = min(1.0, 0.35 + 0.3 * width_px)
    cv2.polylines(layer, [np.round(points * 16).astype(np.int32)], False, strength, thickness, cv2.LINE_AA, shift=4)
    if depth >= 3:
        return
    for turn in (rng.uniform(0.3, 0.8), -rng.uniform(0.3, 0.8)):
        _draw_artery(rng, layer, points[-1], headings[-1] + turn, width_px * 0.75, depth + 1)
    side = rng.integers(count // 3, count)
    _draw_artery(rng, layer, points[side], headings[side] + rng.choice([-1, 1]) * 1.0, width_px * 0.6, depth + 1)


def tube_profile(points_px: np.ndarray, radii_px: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """(distance to the nearest centreline / radius (H, W), its direction (H, W, 2)); distance 9 far from any vessel."""
    across = np.full((size, size), 9.0, np.float32)
    direction = np.zeros((size, size, 2), np.float32)
    for (x, y), radius in zip(points_px, radii_px):
        reach = 2.5 * radius
        left, right = max(0, int(x - reach)), min(size, int(x + reach) + 2)
        top, bottom = max(0, int(y - reach)), min(size, int(y + reach) + 2)
        if left >= right or top >= bottom:
            continue
        dx = (np.arange(left, right, dtype=np.float32) - x)[None] / radius
        dy = (np.arange(top, bottom, dtype=np.float32) - y)[:, None] / radius
        distance = np.hypot(dx, dy)
        box = across[top:bottom, left:right]
        nearer = distance < box
        box[nearer] = distance[nearer]
        vectors = np.stack(np.broadcast_arrays(dx, dy), axis=-1)
        direction[top:bottom, left:right][nearer] = vectors[nearer]
    return across, direction


def paint_veins(
    rng: np.random.Generator, image: np.ndarray, palette: Palette, across: np.ndarray, shaded: np.ndarray
) -> np.ndarray:
    """Colour the veins (across < 1) and the shadow beside them; `shaded` (H, W): brightness of the tube."""
    size = image.shape[0]
    image = image * (1 - 0.38 * np.exp(-(((across - 1) / 0.35) ** 2)) * (across >= 1))[..., None]
    image = mix(image, palette.blush, 0.3 * np.exp(-np.clip(across - 1, 0, None) / 0.5) * (across >= 1))
    colour = np.broadcast_to(np.asarray(palette.vein, np.float32), image.shape)
    colour = mix(colour, palette.vein_edge, np.clip(across, 0, 1) ** 2.5)
    # Blood streams and the wall's thickness vary along the vein.
    variation = 1 + 0.09 * fractal(rng, size, 16, 3) + 0.03 * fractal(rng, size, 90, 2)
    colour = colour * variation[..., None].astype(np.float32) * shaded[..., None]
    inside = np.clip((1.04 - across) / 0.12, 0, 1)
    return mix(image, colour, inside)


def wet_highlights(normals: np.ndarray, light: np.ndarray, sharpness: float) -> np.ndarray:
    """Blinn's highlight of a viewer straight above: (H, W, 3) unit normals, light direction -> (H, W) in 0..1."""
    half = np.asarray(light, float) / np.linalg.norm(light) + [0, 0, 1]
    half /= np.linalg.norm(half)
    return np.clip(normals @ half, 0, 1) ** sharpness


def normals_of_height(height_px: np.ndarray) -> np.ndarray:
    dy, dx = np.gradient(height_px)
    normals = np.stack([-dx, -dy, np.ones_like(dx)], axis=-1)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)
