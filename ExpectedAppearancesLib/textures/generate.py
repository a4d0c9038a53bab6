"""Makes the textures that ship: `python -m ExpectedAppearancesLib.textures.generate FOLDER [SEED]`.

They are painted, not photographed, so they carry no patient's data and no foreign licence.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from .. import files
from ..masks.labels import PARENCHYMA, VESSELS
from . import painting
from .library import LABELS_SUFFIX, Texture
from .painting import Palette

SIZE_PX = 512
VEIN_SHARE = (0.10, 0.15)
SMALLEST_RADIUS_PX = 7.0
CLEARANCE_PX = 10
FAMILY_PX = 65.0
STEP_PX = 2.0
PALETTES = {
    "apricot": Palette((232, 172, 118), (206, 98, 66), (246, 206, 158), (186, 44, 28), (126, 60, 70), (84, 26, 34)),
    "blush": Palette((222, 164, 152), (190, 92, 88), (238, 194, 182), (176, 40, 48), (110, 96, 128), (78, 40, 62)),
    "clay": Palette(
        (176, 134, 104), (140, 76, 56), (202, 166, 134), (150, 50, 36), (102, 100, 118), (70, 44, 48), 0.8, 9, 0.6
    ),
    "crimson": Palette(
        (192, 84, 62), (150, 30, 26), (224, 132, 96), (140, 14, 16), (96, 66, 96), (62, 20, 34), 1.3, 18, 1.3
    ),
    "dusk": Palette(
        (138, 102, 100), (104, 56, 62), (172, 138, 130), (116, 30, 38), (76, 66, 88), (46, 26, 38), 0.9, 10, 1.0
    ),
    "ivory": Palette(
        (238, 206, 170), (220, 144, 110), (250, 230, 204), (196, 62, 40), (150, 56, 52), (104, 26, 26), 0.8, 20, 0.7
    ),
    "mauve": Palette(
        (198, 148, 152), (156, 84, 96), (220, 182, 186), (160, 36, 58), (92, 92, 134), (62, 46, 82), 1.0, 12, 1.2
    ),
    "rosewood": Palette(
        (164, 94, 84), (124, 44, 44), (194, 132, 114), (124, 22, 26), (116, 54, 46), (66, 22, 20), 1.2, 12, 1.0
    ),
    "slate": Palette(
        (170, 150, 138), (142, 96, 88), (198, 184, 170), (146, 56, 50), (84, 102, 124), (52, 52, 72), 0.7, 8, 0.5
    ),
    "sunset": Palette(
        (226, 130, 74), (196, 62, 36), (246, 178, 104), (170, 28, 16), (120, 84, 92), (86, 30, 28), 1.1, 16, 1.4
    ),
}


def make_texture(name: str, seed: int = 0) -> Texture:
    """The texture called `name` (a key of PALETTES) for `seed`: SIZE_PX square, the same each time."""
    rng = np.random.default_rng([seed, sorted(PALETTES).index(name)])
    points_px, radii_px = grow_veins(rng)
    across, direction = painting.tube_profile(points_px, radii_px, SIZE_PX)
    image, labels = paint(rng, PALETTES[name], across, direction)
    return Texture(name, image, labels)


def grow_veins(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Centre lines (N, 2) in px and radii (N,) of veins that come in over the sides and branch, without crossing.

    Grows them until they cover a share of the picture within VEIN_SHARE.
    """
    while True:
        points, radii = np.empty((0, 2)), np.empty(0)
        for _ in range(60):
            side, along = rng.integers(4), rng.uniform(0.1, 0.9) * SIZE_PX
            start = [(along, 0), (SIZE_PX, along), (along, SIZE_PX), (0, along)][side]
            heading = np.pi / 2 * (side + 1) + rng.uniform(-0.7, 0.7)
            points, radii = _grow(rng, points, radii, np.array(start, float), heading, rng.uniform(10, 19), 0)
            if len(points) and _share(points, radii) >= VEIN_SHARE[0]:
                break
        if len(points) and VEIN_SHARE[0] <= _share(points, radii) <= VEIN_SHARE[1]:
            return points, radii


def _share(points_px: np.ndarray, radii_px: np.ndarray) -> float:
    # A quarter of the size is exact enough and much faster.
    return float((painting.tube_profile(points_px / 4, radii_px / 4, SIZE_PX // 4)[0] < 1).mean())


def _grow(rng, points, radii, start, heading: float, radius_px: float, generation: int):
    """`points` and `radii` with one more vein and its branches, or unchanged where there is no room for it."""
    count = int(rng.uniform(0.7, 1.3) * SIZE_PX / STEP_PX) if generation == 0 else int(rng.uniform(60, 140))
    bend, drift, headings = 0.0, 0.0, []
    for _ in range(count):
        # The bend returns to 0, so that a vein winds about its course and does not curl up.
        drift = 0.93 * drift + rng.normal(0, 0.009) - 0.0012 * bend
        bend += drift
        headings.append(heading + bend)
    line = start + STEP_PX * np.cumsum(np.stack([np.cos(headings), np.sin(headings)], axis=1), axis=0)
    outside = np.flatnonzero(((line < -20) | (line > SIZE_PX + 20)).any(axis=1))
    line = line[: outside[0]] if len(outside) else line
    if len(line) < 40:
        return points, radii
    # A branch starts inside its parent, which is near for a while.
    obstacle = np.hypot(*(points - start).T) > (FAMILY_PX if generation else 0)
    if obstacle.any():
        gaps = np.hypot(*(line[::3, None] - points[None, obstacle]).transpose(2, 0, 1)) - radii[obstacle] - radius_px
        if gaps.min() < CLEARANCE_PX:
            return points, radii
    widths = np.linspace(radius_px, max(0.8 * radius_px, SMALLEST_RADIUS_PX), len(line))
    widths = widths * (1 + 0.05 * np.sin(np.arange(len(line)) / 9 + rng.uniform(0, 6)))
    if not len(outside):  # the vein dives below the surface
        widths *= np.clip((len(line) - np.arange(len(line))) / 45, 0.1, 1) ** 0.7
    points, radii = np.concatenate([points, line]), np.concatenate([radii, widths])
    if generation < 2:
        for _ in range(4 if generation == 0 else 1):  # most find no room
            at = rng.integers(len(line) // 5, len(line) * 4 // 5)
            child = max(SMALLEST_RADIUS_PX, widths[at] * rng.uniform(0.55, 0.8))
            turn = rng.choice([-1, 1]) * rng.uniform(0.7, 1.15)
            points, radii = _grow(rng, points, radii, line[at], headings[at] + turn, child, generation + 1)
    return points, radii


def paint(rng, palette: Palette, across: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(RGB, labels) of a view straight from above under one lamp; only the big veins are labelled as vessels."""
    import cv2

    lamp = np.array([*rng.uniform(-0.7, 0.7, 2), 1.0])
    lamp /= np.linalg.norm(lamp)
    image = painting.paint_parenchyma(rng, SIZE_PX, palette)
    image = painting.paint_arteries(rng, image, palette)
    # Gyri: shaded relief under the lamp.
    gyri = painting.normals_of_height(22 * painting.fractal(rng, SIZE_PX, 4, 2, 0.35))
    image *= np.clip(0.25 + 0.8 * (gyri @ lamp), 0.45, 1.2)[..., None].astype(np.float32)
    inside = across < 1
    rise = np.sqrt(np.clip(1 - across**2, 0, 1))
    tube = np.concatenate([np.where(inside[..., None], direction, 0), rise[..., None]], axis=-1)
    shaded = np.where(inside, 0.62 + 0.55 * np.clip(tube @ lamp, 0, 1), 1).astype(np.float32)
    image = painting.paint_veins(rng, image, palette, across, shaded)

    # The film of fluid is rough: highlights break up into spots on parenchyma and into streaks along veins.
    ripple = painting.normals_of_height(
        5 * painting.fractal(rng, SIZE_PX, 10, 2, 0.5) + 1.1 * painting.fractal(rng, SIZE_PX, 48, 2, 0.6)
    )
    film = gyri + ripple + np.where(inside[..., None], 1.6 * tube, 0)
    film /= np.linalg.norm(film, axis=-1, keepdims=True)
    gloss = painting.wet_highlights(film, lamp, 90.0)
    wet = painting.soft_step(painting.fractal(rng, SIZE_PX, 6, 3), 0.7, 0.25)
    share = np.clip(1.6 * (gloss - 0.62), 0, 1) * np.where(inside, 0.4 + 0.6 * wet, wet) * palette.wetness
    share = cv2.GaussianBlur(np.clip(share, 0, 0.95).astype(np.float32), (0, 0), 0.9)
    image = painting.mix(image, (255, 248, 240), share)
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    labels = np.where(inside, VESSELS, PARENCHYMA).astype(np.uint8)
    return np.clip(np.round(image), 0, 255).astype(np.uint8), labels


def generate(folder: Path, seed: int = 0) -> None:
    """Write NAME.png and NAME.labels.png of every palette to `folder`. Raises InputError where it cannot."""
    for name in sorted(PALETTES):
        texture = make_texture(name, seed)
        files.write_png(Path(folder) / f"{name}.png", texture.image)
        files.write_png(Path(folder) / f"{name}{LABELS_SUFFIX}", texture.labels)


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3) or sys.argv[1].startswith("-"):
        sys.exit("usage: python -m ExpectedAppearancesLib.textures.generate FOLDER [SEED]")
    generate(Path(sys.argv[1]), *(int(value) for value in sys.argv[2:]))
