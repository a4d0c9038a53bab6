"""The trained network as ONNX with a JSON beside it: all that the operating room needs."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import torch

from .. import files
from ..errors import ExpectedAppearancesError
from ..registration.predictor import FORMAT_VERSION
from .presets import Preset

MODEL_NAME, META_NAME = "model.onnx", "model.json"
PARITY = 1e-4


def export_model(network: torch.nn.Module, preset: Preset, meta: dict, folder: Path) -> None:
    """Write model.onnx and model.json; raises ExpectedAppearancesError when onnxruntime and torch differ by 1e-4."""
    network = network.eval().to(memory_format=torch.contiguous_format)
    example = torch.rand(1, 3, preset.size_px, preset.size_px, generator=torch.Generator().manual_seed(0))
    with files.replacing(folder / MODEL_NAME) as temporary:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the exporter warns that it is the older of two
            torch.onnx.export(
                network,
                (example,),
                str(temporary),
                input_names=["image"],
                output_names=["output"],
                opset_version=17,
                dynamo=False,
            )
        difference = _largest_difference(network, temporary, example)
        if not difference < PARITY:
            raise ExpectedAppearancesError(f"exported model differs from the trained one by {difference:.2g}")
    meta = {"format_version": FORMAT_VERSION, "model_sha256": files.sha256(folder / MODEL_NAME)} | meta
    files.write_json(folder / META_NAME, meta | {"export_difference": difference})


def _largest_difference(network, path: Path, example: torch.Tensor) -> float:
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (exported,) = session.run(None, {"image": example.numpy()})
    with torch.no_grad():
        expected = network(example).numpy()
    return float(np.abs(exported - expected).max() / max(1.0, np.abs(expected).max()))
