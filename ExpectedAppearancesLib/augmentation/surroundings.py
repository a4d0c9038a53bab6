"""What lies around the planned surface in a real field: the craniotomy's edge, dura, drapes, and cortex beyond it.

The mesh ends where somebody cut it; the field does not end there. A network that has only seen views that end at the
mesh's own rim measures depth by it.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

OPENING = 0.6  # share of views in which the craniotomy hides part of the surface; in the others tissue goes on
WIDEST = 0.12  # of the image's side: how far it goes on at most beyond the mesh's rim
EVERYWHERE = 0.2  # share of those in which it fills what it can reach
BLACK, CORTEX = 0.4, 0.25  # shares of what is seen outside; the rest is cloth


def opening(where_px: np.ndarray, centre_px: np.ndarray, extent_px: float, rng) -> np.ndarray | None:
    """uint8 (H, W): 1 where the craniotomy leaves the surface open; None where it hides nothing.

    where_px: (H, W, 2), place of each pixel in a frontal overview, in which the edge is drawn, so that it stays in
    place on the surface. centre_px, extent_px: middle and size of the surface there.
    """
    if rng.uniform() >= OPENING:
        return None
    size = 128  # the edge is smooth: a coarse map holds it
    scale = size / (2.0 * extent_px)
    count = 24
    angles = np.linspace(0, 2 * math.pi, count, endpoint=False)
    wave = sum(
        rng.normal(0, 0.09 / k) * np.cos(k * angles + rng.uniform(0, 2 * math.pi)) for k in range(1, 6)
    ) + rng.normal(0, 0.015, count)
    radius = rng.uniform(0.42, 0.72) * np.clip(1 + wave, 0.75, 1.35)
    # Squarish to round, as bone flaps are.
    power = rng.uniform(2, 6)
    turned = angles + rng.uniform(0, math.pi)
    radius = radius / (np.abs(np.cos(turned)) ** power + np.abs(np.sin(turned)) ** power) ** (1 / power)
    middle = rng.normal(0, 0.06, 2)
    points = (middle + radius[:, None] * np.stack([np.cos(angles), np.sin(angles)], 1)) * extent_px * scale + size / 2
    mask = np.zeros((size, size), np.uint8)
    cv2.fillPoly(mask, [np.rint(points * 16).astype(np.int32)], 1, shift=4)
    shift = size / 2 - np.asarray(centre_px) * scale
    there = cv2.transform(where_px, np.array([[scale, 0, shift[0]], [0, scale, shift[1]]], np.float32))
    return cv2.remap(mask, there, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)


def continue_tissue(image: np.ndarray, inside: np.ndarray, rng) -> tuple[np.ndarray, np.ndarray]:
    """`image` (H, W, 3) uint8 with its tissue mirrored over the rim of `inside` (H, W) uint8, as far as a random and
    uneven width; and where tissue is now, bool (H, W).

    A patient's cortex does not end where the mesh was cut: where it does so in training, the rim tells the depth, and
    tells it wrongly in the field.
    """
    height, width = inside.shape
    # From a little inside, so that the rim leaves no line; at half the size, as this is slow.
    kept = cv2.erode(inside, np.ones((5, 5), np.uint8))[::2, ::2]
    if not kept.any() or inside.all():
        return image, inside > 0
    away, nearest = cv2.distanceTransformWithLabels(1 - kept, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    there = np.flatnonzero(kept)
    place_of = np.zeros((int(nearest.max()) + 1, 2), np.float32)
    place_of[nearest.ravel()[there]] = np.stack(np.divmod(there, kept.shape[1])[::-1], axis=1)
    own = np.stack(np.meshgrid(*(np.arange(n, dtype=np.float32) for n in kept.shape[::-1])), axis=-1)
    mirrored = 2 * place_of[nearest] - own
    reachable = cv2.remap(kept, mirrored, None, cv2.INTER_NEAREST)
    uneven = cv2.resize(rng.uniform(0.5, 1.5, (4, 4)).astype(np.float32), kept.shape[::-1])
    width_px = np.inf if rng.uniform() < EVERYWHERE else rng.uniform(0, WIDEST) * len(kept)
    grown = cv2.resize(reachable * (away < width_px * uneven), (width, height), interpolation=cv2.INTER_NEAREST)
    where_px = cv2.resize(2 * mirrored, (width, height))
    grown &= 1 - cv2.resize(kept, (width, height), interpolation=cv2.INTER_NEAREST)
    cv2.copyTo(cv2.remap(image, where_px, None, cv2.INTER_LINEAR), grown, image)
    return image, (grown | inside) > 0


def fill_outside(image: np.ndarray, outside: np.ndarray, cortex: np.ndarray, rng) -> np.ndarray:
    """`image` (H, W, 3) uint8 with black, more cortex (`cortex`) or cloth where `outside` (H, W)."""
    chance = rng.uniform()
    height, width = outside.shape
    if chance < BLACK:
        around = np.zeros_like(image)
    elif chance < BLACK + CORTEX:
        angle, scale = rng.uniform(0, 2 * math.pi), rng.uniform(0.5, 1.5) * max(cortex.shape[:2]) / max(height, width)
        turn = scale * np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        turn = np.hstack([turn, rng.uniform(0, 200, (2, 1))])
        around = cv2.warpAffine(
            cortex, turn, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REFLECT
        )
        if rng.uniform() < 0.5:  # dura: pale, with little colour left
            pale = rng.uniform(0.3, 0.8)
            around = cv2.addWeighted(around, 1 - pale, np.full_like(around, rng.integers(90, 230)), pale, 0)
    else:
        coarse = rng.integers(0, 256, (*rng.integers(1, 7, 2), 3)).astype(np.float32)
        grey = coarse.mean(axis=2, keepdims=True)
        coarse = grey + (coarse - grey) * np.float32(rng.uniform(0, 1))
        around = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
        grain = rng.normal(0, rng.uniform(0, 20), (32, 32)).astype(np.float32)
        grain = cv2.resize(grain, (width, height), interpolation=cv2.INTER_LINEAR)
        around = cv2.add(around, cv2.merge([grain] * 3), dtype=cv2.CV_8U)
    cv2.copyTo(around, outside.astype(np.uint8), image)
    return image
