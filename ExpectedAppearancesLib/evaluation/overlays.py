"""Outlines of the vessels on a frame, true in green and predicted in blue, as in the paper's figure 4."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from ..masks.labels import VESSELS

TRUE_RGB = (40, 220, 60)
PREDICTED_RGB = (50, 110, 255)


def draw_overlay(
    image: np.ndarray, true_labels: np.ndarray | None, predicted_labels: np.ndarray | None, thickness_px: int = 0
) -> np.ndarray:
    """Copy of a uint8 RGB frame (H, W, 3) with the vessels' outlines of the label maps (H, W); None draws nothing.

    thickness_px: of the predicted outline; 0 chooses one for the size. Raises ValueError when the sizes differ.
    """
    result = image.copy()
    thin = thickness_px or max(1, round(min(image.shape[:2]) / 256))
    # The true outline is wider, so that it still shows where the predicted one covers it.
    for labels, colour, width_px in ((true_labels, TRUE_RGB, thin + 1), (predicted_labels, PREDICTED_RGB, thin)):
        if labels is None:
            continue
        if labels.shape != image.shape[:2]:
            raise ValueError(f"label map {labels.shape} does not fit image {image.shape}")
        vessels = (labels == VESSELS).astype(np.uint8)
        contours = cv2.findContours(vessels, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
        cv2.drawContours(result, contours, -1, colour, width_px, cv2.LINE_AA)
    return result


def with_caption(image: np.ndarray, text: str) -> np.ndarray:
    """The frame with a line of ASCII text on a dark strip below it."""
    text = text.encode("utf-8", "replace").decode()  # OpenCV crashes on a name that is no text
    height, width = image.shape[:2]
    strip = np.full((max(22, height // 20), width, 3), 24, np.uint8)
    scale, font = len(strip) / 40, cv2.FONT_HERSHEY_SIMPLEX
    text_width = cv2.getTextSize(text, font, scale, 1)[0][0]
    scale *= min(1.0, (width - 10) / max(text_width, 1))
    cv2.putText(strip, text, (5, round(len(strip) * 0.7)), font, scale, (235, 235, 235), 1, cv2.LINE_AA)
    return np.vstack([image, strip])


def sheet(tiles: Sequence[np.ndarray], columns: int = 4, gap_px: int = 6) -> np.ndarray:
    """uint8 RGB tiles in a grid, row by row, each scaled down to fit the size of the first."""
    if not tiles:
        raise ValueError("no tiles for a sheet")
    height, width = tiles[0].shape[:2]
    columns = min(columns, len(tiles))
    rows = math.ceil(len(tiles) / columns)
    result = np.full((rows * (height + gap_px) - gap_px, columns * (width + gap_px) - gap_px, 3), 255, np.uint8)
    for i, tile in enumerate(tiles):
        scale = min(height / tile.shape[0], width / tile.shape[1])
        if scale != 1:
            size = (min(width, round(tile.shape[1] * scale)), min(height, round(tile.shape[0] * scale)))
            tile = cv2.resize(tile, size, interpolation=cv2.INTER_AREA)
        top, left = (i // columns) * (height + gap_px), (i % columns) * (width + gap_px)
        result[top : top + tile.shape[0], left : left + tile.shape[1]] = tile
    return result


def choose_frames(error: np.ndarray, styles: Sequence[str | None], count: int = 12) -> list[int]:
    """Indices of `count` frames from the best to the worst error (N,), spread over the styles.

    Evenly spaced ranks, the best and the worst included; within a small window of each rank the style that was shown
    least is taken, except at the two ends. Where frames have no error (NaN: no pose), one of them comes last.
    """
    order = np.argsort(error, kind="stable")  # NaN last
    known = order[: int((~np.isnan(error)).sum())]
    chosen = _spread(known, styles, min(count - 1 if len(known) < len(order) else count, len(known)))
    return chosen + order[len(known) :][: min(1, count - len(chosen))].tolist()


def _spread(order: np.ndarray, styles: Sequence[str | None], count: int) -> list[int]:
    shown = dict.fromkeys(styles, 0)
    chosen: list[int] = []
    reach = len(order) // (4 * count) if count else 0  # less than half a step: windows share no frame
    for position, rank in enumerate(np.linspace(0, len(order) - 1, count).round().astype(int)):
        ends = position in (0, count - 1)
        window = order[[rank]] if ends else order[rank - reach : rank + reach + 1]
        index = min(window.tolist(), key=lambda i: shown[styles[i]])
        shown[styles[index]] += 1
        chosen.append(index)
    return chosen
