"""Masks, textures and appearances side by side, to be looked at before hours of training."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from .. import files
from ..case.case import Case
from ..textures.library import Texture
from . import store

TILE_PX = 192
LABEL_COLOURS = np.array([[0, 0, 0], [225, 170, 160], [90, 30, 110]], np.uint8)


def write_contact_sheet(case: Case, method: str, textures: list[Texture], most: int = 12) -> Path:
    """Rows of (texture, its labels, mask, appearance), two to a row; returns the PNG's path in the case."""
    _, appearances = store.read_appearances(case, method)
    by_name = {texture.name: texture for texture in textures}
    known = [a for a in appearances if a.style in by_name]
    chosen = [known[i] for i in np.unique(np.linspace(0, len(known) - 1, min(most, len(known))).astype(int))]
    strips = []
    for appearance in chosen:
        texture = by_name[appearance.style]
        tiles = [
            texture.image,
            LABEL_COLOURS[texture.labels],
            LABEL_COLOURS[files.read_label_map(appearance.labels_path)],
            files.read_image_rgb(appearance.image_path),
        ]
        strips.append(np.hstack([_tile(t) for t in tiles]))
    if len(strips) % 2:
        strips.append(np.full_like(strips[0], 255))
    gap = np.full((TILE_PX, 12, 3), 255, np.uint8)
    sheet = np.vstack([np.hstack([strips[i], gap, strips[i + 1]]) for i in range(0, len(strips), 2)])
    path = store.folder_of(case, method) / "contact_sheet.png"
    files.write_png(path, sheet)
    return path


def _tile(image: np.ndarray) -> np.ndarray:
    scale = TILE_PX / max(image.shape[:2])
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    tile = np.full((TILE_PX, TILE_PX, 3), 255, np.uint8)
    tile[: small.shape[0], : small.shape[1]] = small
    return tile
