"""Where training and synthesis compute."""

from __future__ import annotations

import torch

from .errors import InputError


def choose_device(name: str) -> torch.device:
    """'auto', 'cpu' or 'cuda' -> torch.device. Raises InputError when CUDA is asked for and not usable."""
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError("device: no CUDA device is usable here; choose --device cpu or auto (see `check`).")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def fast_dtype(device: torch.device) -> torch.dtype:
    """bfloat16 where the processor multiplies it in hardware, else float32."""
    if device.type == "cuda":
        return torch.bfloat16 if torch.cuda.is_bf16_supported() else torch.float32
    supported = torch.backends.mkldnn.is_available() and torch.ops.mkldnn._is_mkldnn_bf16_supported()
    return torch.bfloat16 if supported else torch.float32
