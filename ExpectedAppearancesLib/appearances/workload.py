"""What synthesis costs: operations and memory of an image, and how many images fit in what is free."""

from __future__ import annotations

import torch

from .vgg import CONVOLUTIONS, WIDTHS

# Ends as near to the texture as the paper's 50 iterations from small noise (docs/benchmarks.md).
DEFAULT_ITERATIONS = 28
PIXELS_AT_ONCE = 2**17  # through the network on a processor: larger tensors are given anew by the system every time
SHARE_OF_FREE = 0.5  # others compute here too
# Peak resident memory of one image of 256 px besides the history of L-BFGS (2 x 3 x 4 bytes a pixel and pair) was
# 2,350 bytes a pixel in bf16; fp32 takes twice that.
BYTES_PER_PIXEL = 4700
VECTORS = 12  # of an image's size, in fp32, that an iteration holds besides the history


def bytes_per_image(shape: tuple[int, int], iterations: int) -> int:
    """Memory that one more image in the batch takes: history and vectors."""
    return shape[0] * shape[1] * 3 * 4 * (2 * min(iterations, 100) + VECTORS)


def images_at_once(shape: tuple[int, int], iterations: int, device: torch.device) -> int:
    """How many images (H, W) to optimise together: what fits in half of the free memory, and on a processor no more
    than go through the network together, since more would gain nothing."""
    pixels = shape[0] * shape[1]
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        each = bytes_per_image(shape, iterations) + BYTES_PER_PIXEL * pixels
        return max(1, int(SHARE_OF_FREE * free / each))
    import psutil

    free = psutil.virtual_memory().available - BYTES_PER_PIXEL * max(pixels, PIXELS_AT_ONCE)
    fitting = int(SHARE_OF_FREE * free / bytes_per_image(shape, iterations))
    return max(1, min(fitting, PIXELS_AT_ONCE // pixels))


def operations_per_evaluation(shape: tuple[int, int], backbone: str, class_shares: tuple[float, ...]) -> float:
    """Floating-point operations (2 per multiply-add) of one loss and gradient: the convolutions, once up and once
    down to the image, and the Gram matrices and their gradients on each class's share of the pixels. What is
    proportional to pixels times channels only (relu, pools, L-BFGS) is left out."""
    pixels, operations, before = float(shape[0] * shape[1]), 0.0, 3
    for block, (count, width) in enumerate(zip(CONVOLUTIONS[backbone], WIDTHS)):
        if block:
            pixels /= 4
        for _ in range(count):
            operations += 2 * (2 * 9 * before * width * pixels)
            before = width
        operations += 2 * (2 * pixels * sum(class_shares) * width * width)
    return operations
