"""Thumbnails and digests of textures, made in a process of their own: 3D Slicer's must not load OpenCV meanwhile.

`python -m ExpectedAppearancesLib.textures.thumbnails FOLDER` reads FOLDER/wanted.json, [[name, image, labels], ...],
and writes FOLDER/made.json: {name: {"sha256", "thumbnail"} or {"problem"}}.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from .. import files
from ..errors import InputError
from ..masks.labels import VESSELS
from .library import read_texture

WANTED, MADE = "wanted.json", "made.json"
THUMBNAIL_PX = 84
OUTLINE_RGB = (60, 220, 90)  # no tissue is green


def ask_for(folder: Path, textures: list[tuple[str, Path, Path | None]]) -> None:
    wanted = [[name, str(image), str(labels) if labels else None] for name, image, labels in textures]
    files.write_json(folder / WANTED, wanted)


def answer(folder: Path) -> dict[str, dict]:
    """What was made; {} where nothing was."""
    try:
        return files.read_json(folder / MADE, "thumbnails")
    except InputError:
        return {}


def make(folder: Path) -> None:
    made = {}
    for name, image, labels in json.loads((folder / WANTED).read_text(encoding="utf-8")):
        try:
            texture = read_texture(name, Path(image), Path(labels) if labels else None)
        except InputError as error:
            made[name] = {"problem": str(error)}
            continue
        path = folder / f"{texture.sha256}.png"
        files.write_png(path, thumbnail(texture.image, texture.labels, THUMBNAIL_PX))
        made[name] = {"sha256": texture.sha256, "thumbnail": str(path)}
    files.write_json(folder / MADE, made)


def thumbnail(image_rgb: np.ndarray, labels: np.ndarray, side_px: int) -> np.ndarray:
    """uint8 (side, side, 3): the middle of the picture with the vessels' outlines drawn over it."""
    import cv2

    side = min(image_rgb.shape[:2])
    top, left = ((length - side) // 2 for length in image_rgb.shape[:2])
    image = cv2.resize(
        image_rgb[top : top + side, left : left + side], (side_px, side_px), interpolation=cv2.INTER_AREA
    )
    shown = cv2.resize(
        labels[top : top + side, left : left + side], (side_px, side_px), interpolation=cv2.INTER_NEAREST
    )
    vessels = (shown == VESSELS).astype(np.uint8)
    image[(vessels == 1) & (cv2.erode(vessels, np.ones((3, 3), np.uint8)) == 0)] = OUTLINE_RGB
    return image


def main(argv: list[str]) -> int:
    make(Path(argv[0]))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
