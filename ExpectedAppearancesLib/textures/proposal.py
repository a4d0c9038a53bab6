"""A first label map for a photograph of cortex, to be corrected by hand."""

from __future__ import annotations

import numpy as np

from ..masks.labels import BACKGROUND, PARENCHYMA, VESSELS

WORKING_SIDE_PX = 512
VESSEL_SIGMAS_PX = (5.0, 8.0, 12.0)  # half the width of the vessels that are looked for, at the working size
DARK_LEVEL = 25  # of 255: outside of the microscope's field
# Of Otsu's threshold: ridges that reach the second count, and what goes on from them above the first.
RIDGE_LEVELS = (1.1, 2.2)
SMALLEST_VESSEL_SHARE = 4e-4  # of the image; smaller ridges are arterioles and specular rims


def propose_labels(image_rgb: np.ndarray) -> np.ndarray:
    """uint8 labels (H, W) of a photograph (H, W, 3): 0 where it is dark, 2 on dark ridges, 1 elsewhere.

    Ridges: Sato et al., Medical Image Analysis 1998, on the green channel, in which blood is darkest.
    """
    from skimage.filters import apply_hysteresis_threshold, sato, threshold_otsu
    from skimage.measure import label
    from skimage.transform import resize

    height, width = image_rgb.shape[:2]
    scale = min(1.0, WORKING_SIDE_PX / max(height, width))
    small = resize(
        image_rgb,
        (max(1, round(height * scale)), max(1, round(width * scale))),
        anti_aliasing=True,
        preserve_range=True,
    )
    field = _largest(small.max(axis=-1) > DARK_LEVEL, label)
    green = np.where(field, small[..., 1], np.median(small[..., 1][field]) if field.any() else 0.0)
    ridges = sato(green, sigmas=VESSEL_SIGMAS_PX, black_ridges=True)
    # The rim of the field is an edge, not a vessel.
    rim_px = int(3 * max(VESSEL_SIGMAS_PX))
    inside = _eroded(field, rim_px)
    ridges[~inside] = 0.0
    labels = np.where(field, PARENCHYMA, BACKGROUND).astype(np.uint8)
    if inside.any() and np.ptp(ridges[inside]) > 1e-6:
        threshold = threshold_otsu(ridges[inside])
        found = apply_hysteresis_threshold(ridges, *(level * threshold for level in RIDGE_LEVELS))
        components = label(found)
        sizes = np.bincount(components.ravel())
        keep = sizes >= SMALLEST_VESSEL_SHARE * found.size
        keep[0] = False
        labels[keep[components]] = VESSELS
    rows = np.minimum((np.arange(height) * scale).astype(int), labels.shape[0] - 1)
    columns = np.minimum((np.arange(width) * scale).astype(int), labels.shape[1] - 1)
    return labels[rows[:, None], columns]


def _largest(mask: np.ndarray, label) -> np.ndarray:
    """The largest connected part of `mask` with its holes filled: the microscope's field, seen whole."""
    from scipy.ndimage import binary_fill_holes

    components = label(mask)
    sizes = np.bincount(components.ravel())
    if len(sizes) < 2:
        return mask
    return binary_fill_holes(components == 1 + np.argmax(sizes[1:]))


def _eroded(mask: np.ndarray, by_px: int) -> np.ndarray:
    """`mask` without its rim against what is dark; the image's own border is no rim."""
    from scipy.ndimage import distance_transform_edt

    return mask if mask.all() else distance_transform_edt(mask) > by_px
