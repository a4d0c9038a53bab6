"""S_Theta: images whose class-wise Gram matrices equal a texture's, optimised in batches (the paper's section 2.2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from ..textures.library import Texture
from .gram import CLASSES, ClassGramLoss, TargetGrams
from .images import to_rgb, to_vgg_input
from .lbfgs import minimise
from .vgg import BGR_MEAN, VggFeatures
from .workload import DEFAULT_ITERATIONS, PIXELS_AT_ONCE

START_NOISE = 10.0  # grey levels, standard deviation: with less, the Grams' flat spot at zero costs iterations


@dataclass(frozen=True)
class Job:
    """One image to make: label map uint8 (H, W), texture, and the seed of its first noise."""

    labels: np.ndarray
    texture: Texture
    seed: int


class Synthesizer:
    """Makes images for jobs of one size; a texture's Grams are computed once and kept.

    An image is the same, bit for bit on a processor, whatever other jobs it is made with.
    """

    def __init__(self, vgg: VggFeatures, device: torch.device, iterations: int = DEFAULT_ITERATIONS):
        self.vgg = vgg.to(device)
        self.device = device
        self.iterations = iterations
        self.targets = TargetGrams(self.vgg)
        if device.type == "cuda":
            torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True

    def run(
        self, jobs: Sequence[Job], on_iteration: Callable[[float], None] = lambda fraction: None
    ) -> list[np.ndarray]:
        """RGB uint8 (H, W, 3) of each job; every job must have the same size. on_iteration gets the share done."""
        labels = torch.from_numpy(np.stack([job.labels for job in jobs])).to(self.device)
        targets = [torch.stack(t) for t in zip(*(self.targets.of(job.texture, *labels.shape[1:]) for job in jobs))]
        at_once = PIXELS_AT_ONCE if self.device.type == "cpu" else None
        loss = ClassGramLoss(self.vgg, labels, targets, CLASSES, at_once)
        inside = (labels > 0)[:, None].float()
        outside = -torch.tensor(BGR_MEAN, device=self.device)[None, :, None, None] * (1 - inside)

        def value_and_gradient(x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            values, gradient = loss.value_and_gradient(x * inside + outside)
            return values, gradient * inside

        start = torch.stack([_start(job) for job in jobs]).to(self.device)
        images, _ = minimise(
            value_and_gradient, start, self.iterations, after_iteration=lambda i, _: on_iteration(i / self.iterations)
        )
        return [to_rgb(one) for one in images * inside + outside]


def _start(job: Job) -> torch.Tensor:
    """The texture's mean colour in each class, plus noise: neural doodle starts from noise alone and spends its
    first iterations on these means."""
    generator = torch.Generator().manual_seed(job.seed)
    start = START_NOISE * torch.randn((3, *job.labels.shape), generator=generator)
    texture = to_vgg_input(job.texture.image)
    for c in CLASSES:
        own = torch.from_numpy(job.texture.labels == c)
        if own.any():
            mean = texture[:, own].mean(dim=1)
            start += mean[:, None, None] * torch.from_numpy(job.labels == c)
    return start
