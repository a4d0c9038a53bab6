"""The class-wise Gram loss of S_Theta (the paper's synthesis equation), for a batch of images."""

from __future__ import annotations

import torch

from .vgg import VggFeatures


def class_masks(labels: torch.Tensor, classes: tuple[int, ...]) -> torch.Tensor:
    """uint8 labels (B, H, W) -> float masks (B, C, H, W)."""
    return torch.stack([(labels == c) for c in classes], dim=1).float()


def class_gram(features: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Gram matrices (B, K, K) of features (B, K, H, W) times mask (B, H, W), over elements x mean of the mask."""
    batch, channels, height, width = features.shape
    masked = (features.float() * mask[:, None]).reshape(batch, channels, height * width)
    elements = channels * height * width * mask.mean(dim=(1, 2)).clamp_min(1e-8)
    return torch.bmm(masked, masked.transpose(1, 2)) / elements[:, None, None]


class _GramDistance(torch.autograd.Function):
    """Squared distance of one image's class-wise Grams to their targets at one layer, with its gradient by hand.

    Works on each class's pixels only and keeps nothing for the backward pass but the features' gradient, which is
    2 m^2 F (G - T) * 2 / elements: zero wherever the class's mask is zero, so nothing leaks between classes.
    """

    @staticmethod
    def forward(ctx, features, pixels, squared_masks, targets, elements):
        """features (1, K, H, W); per class: pixel indices (P,), mask^2 (P, 1), target (K, K), elements x mean mask.

        Each class's distance is relative to its target's squared norm.
        """
        flat = features[0].permute(1, 2, 0).reshape(-1, features.shape[1])
        gradient = torch.zeros_like(flat)
        total = torch.zeros((), device=features.device)
        for index, squared_mask, target, count in zip(pixels, squared_masks, targets, elements, strict=True):
            own = flat[index]
            difference = (own * squared_mask.to(own.dtype)).T.float() @ own.float() / count - target
            norm = target.square().sum()
            total += difference.square().sum() / norm
            gradient.index_add_(
                0, index, (own @ (difference * (4 / (count * norm))).to(own.dtype)) * squared_mask.to(own.dtype)
            )
        ctx.save_for_backward(gradient)
        ctx.shape = features.shape
        return total

    @staticmethod
    def backward(ctx, upstream):
        (gradient,) = ctx.saved_tensors
        _, channels, height, width = ctx.shape
        gradient = (gradient * upstream.to(gradient.dtype)).reshape(1, height, width, channels).permute(0, 3, 1, 2)
        return gradient, None, None, None, None


class ClassGramLoss:
    """Loss per image (B,) between the Grams of images and their targets, layer by layer and class by class.

    A class that a mask does not show, or that its target lacks, adds nothing.
    """

    def __init__(self, vgg: VggFeatures, labels: torch.Tensor, targets: list[torch.Tensor], classes: tuple[int, ...]):
        """labels (B, H, W); targets: per layer (B, C, K, K), NaN for a class the texture lacks."""
        self.vgg = vgg
        self._terms = []
        for masks, target in zip(vgg.carry_masks(class_masks(labels, classes)), targets, strict=True):
            layer = []
            for b in range(len(labels)):
                used = [c for c in range(len(classes)) if masks[b, c].any() and not torch.isnan(target[b, c]).any()]
                flat = [masks[b, c].flatten() for c in used]
                pixels = [m.nonzero().squeeze(1) for m in flat]
                squared = [m[p, None].square() for m, p in zip(flat, pixels, strict=True)]
                elements = [float(m.sum()) * target.shape[-1] for m in flat]
                layer.append((pixels, squared, [target[b, c] for c in used], elements))
            self._terms.append(layer)

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        total = torch.zeros(len(images), device=images.device)
        for features, layer in zip(self.vgg(images), self._terms, strict=True):
            distances = [_GramDistance.apply(features[b : b + 1], *term) for b, term in enumerate(layer)]
            total = total + torch.stack(distances)
        return total


@torch.no_grad()
def texture_grams(
    vgg: VggFeatures, image: torch.Tensor, labels: torch.Tensor, classes: tuple[int, ...]
) -> list[torch.Tensor]:
    """Targets of one texture: per layer (C, K, K); NaN for a class that the texture does not show."""
    grams = []
    masks = vgg.carry_masks(class_masks(labels[None], classes))
    for features, mask in zip(vgg(image[None]), masks, strict=True):
        layer = torch.cat([class_gram(features, mask[:, c]) for c in range(mask.shape[1])])
        missing = torch.tensor([not bool((labels == c).any()) for c in classes], device=layer.device)
        layer[missing] = float("nan")
        grams.append(layer)
    return grams
