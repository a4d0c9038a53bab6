"""The class-wise Gram loss of S_Theta (L_Theta: paper, equation 2), for a batch of images."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from ..masks.labels import TISSUES
from ..textures.library import Texture
from .images import resized, to_vgg_input
from .vgg import VggFeatures

# Background has none: the field outside the craniotomy stays black, as in a masked frame.
CLASSES = TISSUES

# A Gram matrix is summed over so many pixels in the compute type, and over these sums in fp32: bf16 loses nothing
# that matters, and the order of the additions depends neither on the batch nor on the number of threads.
PIXELS_PER_SUM = 512


def class_masks(labels: torch.Tensor, classes: tuple[int, ...]) -> torch.Tensor:
    """uint8 labels (B, H, W) -> float masks (B, C, H, W)."""
    return torch.stack([(labels == c) for c in classes], dim=1).float()


def class_gram(features: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Gram matrices (B, K, K) of features (B, K, H, W) times mask (B, H, W), over elements x mean of the mask."""
    masked = (features.float() * mask[:, None]).flatten(2)
    masked = torch.nn.functional.pad(masked, (0, -masked.shape[2] % PIXELS_PER_SUM)).transpose(1, 2)
    elements = features.shape[1] * mask.sum(dim=(1, 2)).clamp_min(1e-8)
    return _gram(masked) / elements[:, None, None]


def _gram(rows: torch.Tensor) -> torch.Tensor:
    """(B, P, K) -> (B, K, K) float32; P is less than PIXELS_PER_SUM or a multiple of it."""
    batch, pixels, channels = rows.shape
    sums = rows.reshape(-1, min(PIXELS_PER_SUM, pixels), channels)
    sums = torch.bmm(sums.transpose(1, 2), sums).view(batch, -1, channels, channels).float()
    return sums[:, 0] if sums.shape[1] == 1 else sums.sum(dim=1)


@dataclass(frozen=True)
class ClassTerm:
    """What one class asks of one feature layer, for B images: their pixels, softened masks there and target Grams.

    pixels (B * P,) rows of the features laid out (B * H * W, K), those of full mask first, filled up to P with rows
    of mask 0; soft (B, P - full, 1): the masks after the first `full` rows; target (B, K, K); elements (B, 1, 1):
    number of elements x mean mask; weight (B, 1, 1): 1 over the target's squared norm, 0 where there is none.
    """

    pixels: torch.Tensor
    full: int
    soft: torch.Tensor
    target: torch.Tensor
    elements: torch.Tensor
    weight: torch.Tensor

    @staticmethod
    def of(masks: torch.Tensor, target: torch.Tensor, dtype: torch.dtype) -> ClassTerm | None:
        """masks (B, H, W), target (B, K, K) with NaN where the texture lacks the class; None where nothing is asked."""
        usable = ~torch.isnan(target).flatten(1).any(dim=1)
        flat = masks.flatten(1) * usable[:, None]
        counts = (flat > 0).sum(dim=1)
        if not int(counts.max()):
            return None
        length = -(-int(counts.max()) // min(PIXELS_PER_SUM, flat.shape[1])) * min(PIXELS_PER_SUM, flat.shape[1])
        order = torch.argsort(flat, dim=1, descending=True, stable=True)
        order = torch.nn.functional.pad(order, (0, max(0, length - flat.shape[1])))[:, :length]
        weights = torch.gather(flat, 1, order)
        weights[:, flat.shape[1] :] = 0
        full = int((weights >= 1 - 1e-6).sum(dim=1).min())
        offsets = torch.arange(len(masks), device=masks.device)[:, None] * flat.shape[1]
        target = torch.where(usable[:, None, None], target, torch.zeros_like(target))
        norms = target.square().sum(dim=(1, 2))
        asked = usable & (counts > 0) & (norms > 0)
        return ClassTerm(
            (order + offsets).flatten(),
            full,
            weights[:, full:, None].to(dtype),
            target,
            (flat.sum(dim=1).clamp_min(1e-8) * target.shape[-1])[:, None, None],
            torch.where(asked, 1 / norms.clamp_min(1e-30), torch.zeros_like(norms))[:, None, None],
        )

    def add(self, rows: torch.Tensor, gradient_rows: torch.Tensor | None) -> torch.Tensor:
        """Squared relative distance (B,) for features laid out (B * H * W, K); its gradient is added in place.

        The gradient, 4 m^2 F (G - T) / elements, is zero wherever the class's mask is zero: nothing leaks.
        """
        batch, channels = len(self.target), rows.shape[1]
        own = rows.index_select(0, self.pixels).view(batch, -1, channels)
        own[:, self.full :] *= self.soft
        # In place: deep layers' matrices are larger than their features.
        difference = _gram(own).div_(self.elements).sub_(self.target)
        distance = (difference.square().sum(dim=2) * self.weight[:, 0]).sum(dim=1)
        if gradient_rows is not None:
            difference *= 4 * self.weight / self.elements
            change = torch.bmm(own, difference.to(own.dtype))
            change[:, self.full :] *= self.soft
            gradient_rows.index_add_(0, self.pixels, change.view(-1, channels))
        return distance


class ClassGramLoss:
    """Loss per image (B,) between the Grams of images and their targets, layer by layer and class by class.

    Each class's distance is relative to its target's squared norm. A class that a mask does not show, or that its
    target lacks, adds nothing.
    """

    def __init__(
        self,
        vgg: VggFeatures,
        labels: torch.Tensor,
        targets: list[torch.Tensor],
        classes: tuple[int, ...],
        pixels_at_once: int | None = None,
    ):
        """labels (B, H, W); targets: per layer (B, C, K, K), NaN for a class the texture lacks.

        pixels_at_once: bound of the images taken through the network together (at least one); None: all.
        """
        self.vgg = vgg
        together = max(1, (pixels_at_once or labels.numel()) // labels[0].numel())
        self._parts = [slice(b, b + together) for b in range(0, len(labels), together)]
        # On a processor each image has its own lists of pixels; on a GPU one list, filled up, saves launches.
        self._per_image = labels.device.type == "cpu"
        self._terms = []
        for masks, target in zip(vgg.carry_masks(class_masks(labels, classes)), targets):
            groups = [slice(b, b + 1) for b in range(len(labels))] if self._per_image else self._parts
            self._terms.append(
                [
                    [ClassTerm.of(masks[g, c], target[g, c], vgg.compute_dtype) for c in range(len(classes))]
                    for g in groups
                ]
            )

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        """Loss (B,) of images (B, 3, H, W), without gradient."""
        total = torch.zeros(len(images), device=images.device)
        for p, part in enumerate(self._parts):
            for layer, features in enumerate(self.vgg(images[part])):
                self._add_layer(total, p, layer, features, None)
        return total

    def value_and_gradient(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Loss (B,) and its gradient (B, 3, H, W), float32."""
        total = torch.zeros(len(images), device=images.device)
        gradient = torch.empty(images.shape, device=images.device)
        for p, part in enumerate(self._parts):
            gradient[part] = self.vgg.input_gradient(
                self.vgg.activations(images[part]), lambda layer, x, g, p=p: self._add_layer(total, p, layer, x, g)
            )
        return total, gradient

    def _add_layer(
        self, total: torch.Tensor, part_index: int, layer: int, features: torch.Tensor, gradient: torch.Tensor | None
    ) -> None:
        part = self._parts[part_index]
        flat = rows_of(features)
        flat_gradient = None if gradient is None else rows_of(gradient)
        if not self._per_image:
            for term in filter(None, self._terms[layer][part_index]):
                total[part] += term.add(flat, flat_gradient)
            return
        size = len(flat) // len(features)
        for b in range(len(features)):
            own = slice(b * size, (b + 1) * size)
            for term in filter(None, self._terms[layer][part.start + b]):
                total[part.start + b] += term.add(flat[own], None if gradient is None else flat_gradient[own])[0]


def rows_of(features: torch.Tensor) -> torch.Tensor:
    """Channels-last (B, K, H, W) seen as (B * H * W, K), the same memory."""
    return features.permute(0, 2, 3, 1).view(-1, features.shape[1])


@torch.no_grad()
def texture_grams(
    vgg: VggFeatures, image: torch.Tensor, labels: torch.Tensor, classes: tuple[int, ...]
) -> list[torch.Tensor]:
    """Targets of one texture: per layer (C, K, K); NaN for a class that the texture does not show."""
    grams = []
    masks = vgg.carry_masks(class_masks(labels[None], classes))
    for features, mask in zip(vgg(image[None]), masks):
        layer = torch.cat([class_gram(features, mask[:, c]) for c in range(mask.shape[1])])
        missing = torch.tensor([not bool((labels == c).any()) for c in classes], device=layer.device)
        layer[missing] = float("nan")
        grams.append(layer)
    return grams


class TargetGrams:
    """Targets of textures at the size of the images to make: computed once, the newest few kept."""

    KEPT = 4  # images come texture by texture; more would only take memory

    def __init__(self, vgg: VggFeatures):
        self._vgg = vgg
        self._kept: dict[tuple, list[torch.Tensor]] = {}

    def of(self, texture: Texture, height: int, width: int) -> list[torch.Tensor]:
        """As `texture_grams` gives them, for CLASSES, on the weights' device."""
        key = (texture.sha256, height, width)  # another one may be called alike: a cluster's workers serve many runs
        if key not in self._kept:
            image, labels = resized(texture, height, width)
            device = self._vgg.conv1_1_weight.device
            tensors = to_vgg_input(image).to(device), torch.from_numpy(labels).to(device)
            self._kept[key] = texture_grams(self._vgg, *tensors, CLASSES)
            while len(self._kept) > self.KEPT:
                del self._kept[next(iter(self._kept))]
        return self._kept[key]
