"""S_Theta: images whose class-wise Gram matrices equal a texture's, optimised in batches (the paper's section 2.2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ..masks.labels import PARENCHYMA, VESSELS
from ..textures.library import Texture
from .gram import ClassGramLoss, texture_grams
from .lbfgs import minimise
from .vgg import BGR_MEAN, VggFeatures

CLASSES = (PARENCHYMA, VESSELS)  # background: the field outside the craniotomy stays black, as in a masked frame
START_NOISE = 10.0  # grey levels, standard deviation: with less, the Grams' flat spot at zero costs iterations


@dataclass(frozen=True)
class Job:
    """One image to make: label map uint8 (H, W), texture, and the seed of its first noise."""

    labels: np.ndarray
    texture: Texture
    seed: int


class Synthesizer:
    """Makes images for jobs of one size; a texture's Grams are computed once and kept."""

    def __init__(self, vgg: VggFeatures, device: torch.device, iterations: int = 50):
        self.vgg = vgg.to(device)
        self.device = device
        self.iterations = iterations
        self._targets: dict[tuple, list[torch.Tensor]] = {}

    def run(
        self, jobs: Sequence[Job], on_iteration: Callable[[int], None] = lambda iteration: None
    ) -> list[tuple[np.ndarray, float]]:
        """RGB uint8 (H, W, 3) and final class-wise Gram distance of each job; every job must have the same size."""
        labels = torch.from_numpy(np.stack([job.labels for job in jobs])).to(self.device)
        height, width = labels.shape[1:]
        targets = [torch.stack(t) for t in zip(*(self._target(j.texture, height, width) for j in jobs), strict=True)]
        loss = ClassGramLoss(self.vgg, labels, targets, CLASSES)
        start = torch.stack([self._start(job) for job in jobs])
        inside = (labels > 0)[:, None].float()
        outside = -torch.tensor(BGR_MEAN, device=self.device)[None, :, None, None] * (1 - inside)

        def value_and_gradient(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            values, gradient = loss.value_and_gradient(x * inside + outside)
            return values, gradient * inside

        images, distances = minimise(
            value_and_gradient,
            start,
            self.iterations,
            after_iteration=lambda iteration, _values: on_iteration(iteration),
        )
        images = images * inside + outside
        return [(_to_rgb(image), float(distance)) for image, distance in zip(images, distances, strict=True)]

    def _target(self, texture: Texture, height: int, width: int) -> list[torch.Tensor]:
        key = (texture.name, height, width)
        if key not in self._targets:
            image, labels = _resized(texture, height, width)
            tensor = _to_vgg_input(image).to(self.device)
            self._targets[key] = texture_grams(self.vgg, tensor, torch.from_numpy(labels).to(self.device), CLASSES)
        return self._targets[key]

    def _start(self, job: Job) -> torch.Tensor:
        """The texture's mean colour in each class, plus noise: neural doodle starts from noise alone and spends its
        first iterations on these means."""
        generator = torch.Generator().manual_seed(job.seed)
        start = START_NOISE * torch.randn((3, *job.labels.shape), generator=generator)
        texture = _to_vgg_input(job.texture.image)
        for c in CLASSES:
            own = torch.from_numpy(job.texture.labels == c)
            if own.any():
                mean = texture[:, own].mean(dim=1)
                start += mean[:, None, None] * torch.from_numpy(job.labels == c)
        return start.to(self.device)


def _resized(texture: Texture, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """The texture at the size of the image to make: its longer side equals the image's longer side."""
    import cv2

    scale = max(height, width) / max(texture.labels.shape)
    size = (max(16, round(texture.labels.shape[1] * scale)), max(16, round(texture.labels.shape[0] * scale)))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    image = cv2.resize(texture.image, size, interpolation=method)
    return image, cv2.resize(texture.labels, size, interpolation=cv2.INTER_NEAREST)


def _to_vgg_input(image_rgb: np.ndarray) -> torch.Tensor:
    bgr = torch.from_numpy(np.ascontiguousarray(image_rgb[..., ::-1])).permute(2, 0, 1).float()
    return bgr - torch.tensor(BGR_MEAN)[:, None, None]


def _to_rgb(image: torch.Tensor) -> np.ndarray:
    bgr = image.cpu() + torch.tensor(BGR_MEAN)[:, None, None]
    return bgr.round().clamp(0, 255).byte().permute(1, 2, 0).numpy()[..., ::-1].copy()
