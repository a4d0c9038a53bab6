"""Training state as safetensors and JSON: nothing is pickled, and a killed run goes on from its last checkpoint."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from .. import files
from ..errors import InputError

NAME = "checkpoint.safetensors"


def save(folder: Path, network, average: dict, best: dict, optimizer, state: dict) -> None:
    """Network, its running average, the best average so far, Adam's moments, and `state` (JSON), in one file."""
    tensors = {f"network.{k}": v for k, v in network.state_dict().items()}
    tensors |= {f"average.{k}": v for k, v in average.items()}
    tensors |= {f"best.{k}": v for k, v in best.items()}
    names = [name for name, _ in network.named_parameters()]
    for i, moments in optimizer.state_dict()["state"].items():
        tensors |= {f"adam.{names[i]}.{k}": torch.as_tensor(v) for k, v in moments.items()}
    tensors = {k: v.detach().cpu().contiguous().clone() for k, v in tensors.items()}
    with files.replacing(folder / NAME) as temporary:
        try:
            save_file(tensors, str(temporary), metadata={"state": json.dumps(state)})
        except SafetensorError as error:  # its own for what is an OSError elsewhere, such as a full disk
            raise OSError(str(error)) from error


def load(folder: Path, network, optimizer, settings: dict) -> tuple[dict, dict, dict] | None:
    """Restore network and optimizer; returns (average, best, state), or None when there is nothing to go on from:
    no checkpoint, a damaged one, or one of other settings."""
    path = folder / NAME
    if not path.is_file():
        return None
    try:
        with safe_open(str(path), framework="pt") as stream:
            state = json.loads((stream.metadata() or {}).get("state", "null"))
            if not state or state.get("settings") != settings:
                return None
            # Copies: the tensors are the mapped file itself, which Windows lets nobody replace by the next checkpoint.
            tensors = {key: stream.get_tensor(key).clone() for key in stream.keys()}  # noqa: SIM118 (not a dict)
    except (SafetensorError, ValueError, OSError):
        return None
    parts = {"network": {}, "average": {}, "best": {}}
    moments: dict[str, dict] = {}
    for key, tensor in tensors.items():
        part, _, rest = key.partition(".")
        if part == "adam":
            name, _, moment = rest.rpartition(".")
            moments.setdefault(name, {})[moment] = tensor
        else:
            parts[part][rest] = tensor
    network.load_state_dict(parts["network"])
    names = [name for name, _ in network.named_parameters()]
    optimizer_state = optimizer.state_dict()
    optimizer_state["state"] = {i: moments[name] for i, name in enumerate(names) if name in moments}
    optimizer.load_state_dict(optimizer_state)
    device = next(network.parameters()).device
    on_device = ({k: v.to(device) for k, v in parts[part].items()} for part in ("average", "best"))
    return *on_device, state


def best_weights(folder: Path) -> dict[str, torch.Tensor]:
    """The best average of a training so far. Raises InputError where there is none."""
    path = folder / NAME
    try:
        with safe_open(str(path), framework="pt") as stream:
            names = [key for key in stream.keys() if key.startswith("best.")]  # noqa: SIM118 (not a dict)
            return {name.partition(".")[2]: stream.get_tensor(name) for name in names}
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path}: no saved training ({error}); give the model folder of a trained case.") from error
