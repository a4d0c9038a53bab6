"""The class-wise Gram distance of a finished image to its texture, always measured in the same way."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np
import torch

from ..masks.labels import CLASS_NAMES
from ..textures.library import Texture
from .gram import CLASSES, ClassTerm, TargetGrams, class_masks, rows_of
from .images import to_vgg_input
from .vgg import VggFeatures


class GramMeasure:
    """Distances in fp32, of the image as it is saved (8 bit), whatever it was optimised in and with."""

    def __init__(self, vgg: VggFeatures):
        """vgg: with float32 weights."""
        self.vgg = vgg
        self._targets = TargetGrams(vgg)

    @torch.no_grad()
    def distances(self, image_rgb: np.ndarray, labels: np.ndarray, texture: Texture) -> dict[str, float]:
        """By class name: the squared distance of the Grams of RGB uint8 (H, W, 3) inside the class to the texture's,
        over the squared norm of the texture's, summed over the five layers. Classes not shown are left out.
        """
        with _without_tf32():
            return self._distances(image_rgb, labels, texture)

    def _distances(self, image_rgb: np.ndarray, labels: np.ndarray, texture: Texture) -> dict[str, float]:
        device = self.vgg.conv1_1_weight.device
        targets = self._targets.of(texture, *labels.shape)
        masks = self.vgg.carry_masks(class_masks(torch.from_numpy(labels)[None].to(device), CLASSES))
        features = self.vgg(to_vgg_input(image_rgb)[None].to(device))
        found = {}
        for index, c in enumerate(CLASSES):
            terms = [ClassTerm.of(m[:, index], t[None, index], torch.float32) for m, t in zip(masks, targets)]
            if any(terms) and not torch.isnan(targets[0][index]).any():
                found[CLASS_NAMES[c]] = sum(float(t.add(rows_of(f), None)) for t, f in zip(terms, features) if t)
        return found


@contextlib.contextmanager
def _without_tf32() -> Iterator[None]:
    """On CUDA fp32 may mean TF32, which has bf16's precision nearly; a measure must not."""
    flags = torch.backends.cuda.matmul, torch.backends.cudnn
    before = [flag.allow_tf32 for flag in flags]
    try:
        for flag in flags:
            flag.allow_tf32 = False
        yield
    finally:
        for flag, value in zip(flags, before):
            flag.allow_tf32 = value
