"""Between RGB images and what VGG reads."""

from __future__ import annotations

import numpy as np
import torch

from ..textures.library import Texture
from .vgg import BGR_MEAN


def resized(texture: Texture, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """The texture at the size of the image to make: its longer side equals the image's longer side."""
    import cv2

    scale = max(height, width) / max(texture.labels.shape)
    size = (max(16, round(texture.labels.shape[1] * scale)), max(16, round(texture.labels.shape[0] * scale)))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    image = cv2.resize(texture.image, size, interpolation=method)
    return image, cv2.resize(texture.labels, size, interpolation=cv2.INTER_NEAREST)


def to_vgg_input(image_rgb: np.ndarray) -> torch.Tensor:
    bgr = torch.from_numpy(np.ascontiguousarray(image_rgb[..., ::-1])).permute(2, 0, 1).float()
    return bgr - torch.tensor(BGR_MEAN)[:, None, None]


def to_rgb(image: torch.Tensor) -> np.ndarray:
    bgr = image.cpu() + torch.tensor(BGR_MEAN)[:, None, None]
    return bgr.round().clamp(0, 255).byte().permute(1, 2, 0).numpy()[..., ::-1].copy()
