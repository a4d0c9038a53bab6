"""The paper's synthesis as plainly as PyTorch allows: the reference that the engine is measured against.

One image at a time in fp32, autograd through the whole masks, torch.optim.LBFGS with its history of 100, started from
small noise, as neural doodle does it. Nothing of the engine is used but the numbers of the weights.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F

BGR_MEAN = torch.tensor([103.939, 116.779, 123.68])
LAYERS = ("conv1_1", "conv2_1", "conv3_1", "conv4_1", "conv5_1")
CLASSES = (1, 2)
NOISE = 10.0  # grey levels
# torch's optimiser stops at gradients of 1e-7, which a distance of order 1 over 200,000 values is always below.
LOSS_SCALE = 1e5


def synthesise(
    weights: dict[str, torch.Tensor],
    labels: np.ndarray,
    texture_rgb: np.ndarray,
    texture_labels: np.ndarray,
    seed: int,
    iterations: int = 50,
) -> np.ndarray:
    """RGB uint8 (H, W, 3) for a label map (H, W) and a texture of the same size. weights: convB_K.weight, .bias."""
    targets = []
    with torch.no_grad():
        texture = torch.from_numpy(texture_rgb[..., ::-1].copy()).permute(2, 0, 1).float() - BGR_MEAN[:, None, None]
        for features, masks in zip(network(weights, texture[None]), carried_masks(weights, texture_labels)):
            targets.append([gram(features, mask) for mask in masks])
    masks = carried_masks(weights, labels)
    inside = torch.from_numpy(labels > 0)[None, None].float()
    outside = -BGR_MEAN[None, :, None, None] * (1 - inside)
    image = NOISE * torch.randn((1, 3, *labels.shape), generator=torch.Generator().manual_seed(seed))
    image.requires_grad_(True)
    optimiser = torch.optim.LBFGS([image], max_iter=iterations, max_eval=iterations + 1, history_size=100)

    def evaluate() -> torch.Tensor:
        optimiser.zero_grad()
        loss = 0.0
        for features, layer_masks, layer_targets in zip(network(weights, image * inside + outside), masks, targets):
            for mask, target in zip(layer_masks, layer_targets):
                loss = loss + (gram(features, mask) - target).square().sum() / target.square().sum()
        (LOSS_SCALE * loss).backward()
        return LOSS_SCALE * loss.detach()

    optimiser.step(evaluate)
    with torch.no_grad():
        bgr = (image * inside + outside)[0] + BGR_MEAN[:, None, None]
        return bgr.round().clamp(0, 255).byte().permute(1, 2, 0).numpy()[..., ::-1].copy()


def network(weights: dict[str, torch.Tensor], x: torch.Tensor) -> list[torch.Tensor]:
    found = []
    for name in convolution_names(weights):
        if name in LAYERS[1:]:
            x = F.avg_pool2d(x, 2)
        x = F.relu(F.conv2d(x, weights[f"{name}.weight"], weights[f"{name}.bias"], padding=1))
        if name in LAYERS:
            found.append(x)
    return found


def carried_masks(weights: dict[str, torch.Tensor], labels: np.ndarray) -> list[list[torch.Tensor]]:
    masks = torch.stack([torch.from_numpy(labels == c) for c in CLASSES])[:, None].float()
    found = []
    for name in convolution_names(weights):
        if name in LAYERS[1:]:
            masks = F.avg_pool2d(masks, 2)
        masks = F.avg_pool2d(masks, 3, stride=1, padding=1)
        if name in LAYERS:
            found.append(list(masks))
    return found


def gram(features: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """(1, K, H, W), (1, H, W) -> (K, K)."""
    masked = (features * mask).flatten(2)[0]
    return masked @ masked.T / (masked.numel() * mask.mean())


def convolution_names(weights: dict[str, torch.Tensor]) -> list[str]:
    return sorted(name.removesuffix(".weight") for name in weights if name.endswith(".weight"))
