"""Where a dense network's training starts: at weights that were learnt on a generated patient.

What a vessel looks like under a microscope is learnt there once; which place on the brain it is, for each patient anew.
`python -m ExpectedAppearancesLib.model.starting MODEL_FOLDER` writes the weights that ship, from a training's folder.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from .. import files
from ..errors import InputError
from . import checkpoint

SHIPPED = Path(__file__).parent / "weights" / "generated_patient_fp16.safetensors"
LEARNT_ANEW = "head."  # surface coordinates: they mean other places on another patient


def load_start(network: nn.Module) -> bool:
    """Put the shipped weights into a network of the same layers; False, and nothing is changed, for another one.

    Raises InputError when the file is missing or damaged.
    """
    try:
        shipped = load_file(str(SHIPPED))
    except (OSError, SafetensorError) as error:
        raise InputError(f"{SHIPPED}: cannot be read ({error}); install the package again.") from error
    own = network.state_dict()
    kept = {name: tensor for name, tensor in own.items() if not name.startswith(LEARNT_ANEW)}
    if {name: tensor.shape for name, tensor in kept.items()} != {name: t.shape for name, t in shipped.items()}:
        return False
    network.load_state_dict(own | {name: tensor.to(own[name].dtype) for name, tensor in shipped.items()})
    return True


def write_start(model_folder: Path, path: Path = SHIPPED) -> None:
    """Write the best weights of the training in `model_folder`, in half precision. Raises InputError without them."""
    best = checkpoint.best_weights(Path(model_folder))
    tensors = {
        name: (tensor.half() if tensor.is_floating_point() else torch.zeros_like(tensor)).contiguous()
        for name, tensor in best.items()
        if not name.startswith(LEARNT_ANEW)
    }
    with files.replacing(path) as temporary:
        save_file(tensors, str(temporary))


if __name__ == "__main__":
    if len(sys.argv) != 2 or sys.argv[1].startswith("-"):
        sys.exit("usage: python -m ExpectedAppearancesLib.model.starting MODEL_FOLDER")
    write_start(Path(sys.argv[1]))
