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
LINE_PX = 22
MOST = 12  # appearances shown
LABEL_COLOURS = np.array([[0, 0, 0], [225, 170, 160], [90, 30, 110]], np.uint8)


def write_contact_sheet(case: Case, method: str, textures: list[Texture]) -> Path:
    """Rows of (texture, its labels, mask, appearance), two to a row, each with its Gram distance to the texture;
    above them method, backbone and mean distances. Returns the PNG's path in the case."""
    _, appearances = store.read_appearances(case, method)
    index = store.read_index(case, method)
    by_name = {texture.name: texture for texture in textures}
    by_class = {item["image"]: item.get("gram_distance_by_class", {}) for item in index["items"]}
    known = [a for a in appearances if a.style in by_name]
    chosen = [known[i] for i in np.unique(np.linspace(0, len(known) - 1, min(MOST, len(known))).astype(int))]
    strips = []
    for appearance in chosen:
        texture = by_name[appearance.style]
        tiles = [
            texture.image,
            LABEL_COLOURS[texture.labels],
            LABEL_COLOURS[files.read_label_map(appearance.labels_path)],
            files.read_image_rgb(appearance.image_path),
        ]
        strip = np.hstack([_tile(t) for t in tiles])
        distances = _listed(by_class[appearance.image_path.name])
        caption = f"{appearance.style}: Gram distance {appearance.gram_distance:.3f} {distances}"
        strips.append(np.vstack([_line(caption, strip.shape[1]), strip]))
    if len(strips) % 2:
        strips.append(np.full_like(strips[0], 255))
    gap = np.full((len(strips[0]), 12, 3), 255, np.uint8)
    rows = [np.hstack([strips[i], gap, strips[i + 1]]) for i in range(0, len(strips), 2)]
    mean = float(np.mean([a.gram_distance for a in appearances]))
    settings = index["settings"]
    title = (
        f"method {method}, {settings.get('backbone', 'unknown backbone')}, {settings.get('iterations', '?')} "
        f"iterations, {len(appearances)} appearances: mean Gram distance {mean:.3f}"
    )
    path = store.folder_of(case, method) / store.CONTACT_SHEET
    files.write_png(path, np.vstack([_line(title, rows[0].shape[1]), *rows]))
    return path


def _listed(distances: dict[str, float]) -> str:
    return "(" + ", ".join(f"{name} {d:.3f}" for name, d in distances.items()) + ")" if distances else ""


def _line(text: str, width: int) -> np.ndarray:
    line = np.full((LINE_PX, width, 3), 255, np.uint8)
    ascii_text = text.encode("ascii", "replace").decode()  # the font has no other letters
    cv2.putText(line, ascii_text, (4, LINE_PX - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return line


def _tile(image: np.ndarray) -> np.ndarray:
    scale = TILE_PX / max(image.shape[:2])
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    tile = np.full((TILE_PX, TILE_PX, 3), 255, np.uint8)
    tile[: small.shape[0], : small.shape[1]] = small
    return tile
