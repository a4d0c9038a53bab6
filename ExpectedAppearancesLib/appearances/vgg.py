"""VGG features for S_Theta: relu1_1 ... relu5_1 with average pooling, and label masks carried down beside them."""

from __future__ import annotations

from pathlib import Path

import torch
import torch.nn.functional as F

from ..errors import InputError

SHIPPED_WEIGHTS = Path(__file__).parent / "weights" / "vgg16_imagenet_to_conv5_1_fp16.safetensors"
VGG19_OFFICIAL = ("https://download.pytorch.org/models/vgg19-dcbb9e9d.pth", "dcbb9e9d")
BGR_MEAN = (103.939, 116.779, 123.68)  # of ImageNet, 0..255
CONVOLUTIONS = {"vgg16": (2, 2, 3, 3, 1), "vgg19": (2, 2, 4, 4, 1)}  # per block, up to conv5_1
_WIDTHS = (64, 128, 256, 512, 512)


class VggFeatures(torch.nn.Module):
    """(B, 3, H, W) BGR 0..255 minus the mean -> features after relu of the first convolution of each block.

    compute_dtype: bfloat16 where the processor multiplies it fast, else float32. Weights are frozen.
    """

    def __init__(self, weights: dict[str, torch.Tensor], backbone: str, compute_dtype: torch.dtype = torch.float32):
        super().__init__()
        self.backbone = backbone
        self.compute_dtype = compute_dtype
        self.names = [
            f"conv{block + 1}_{k + 1}" for block, count in enumerate(CONVOLUTIONS[backbone]) for k in range(count)
        ]
        for name in self.names:
            weight = weights[f"{name}.weight"].to(compute_dtype).contiguous(memory_format=torch.channels_last)
            self.register_buffer(f"{name}_weight", weight, persistent=False)
            self.register_buffer(f"{name}_bias", weights[f"{name}.bias"].to(compute_dtype), persistent=False)

    def forward(self, image: torch.Tensor) -> list[torch.Tensor]:
        x = image.to(self.compute_dtype).contiguous(memory_format=torch.channels_last)
        features = []
        for name in self.names:
            if name.endswith("_1") and name != "conv1_1":
                x = F.avg_pool2d(x, 2)
            x = F.relu(F.conv2d(x, getattr(self, f"{name}_weight"), getattr(self, f"{name}_bias"), padding=1))
            if name.endswith("_1"):
                features.append(x)
        return features

    def carry_masks(self, masks: torch.Tensor) -> list[torch.Tensor]:
        """(B, C, H, W) class masks 0..1 -> the masks at each feature layer: halved at each pool, 3x3 box-averaged at
        each convolution, as in neural doodle (METHOD.md, synthesis details)."""
        carried, m = [], masks.float()
        for name in self.names:
            if name.endswith("_1") and name != "conv1_1":
                m = F.avg_pool2d(m, 2)
            m = F.avg_pool2d(m, 3, stride=1, padding=1)
            if name.endswith("_1"):
                carried.append(m)
        return carried


def load_vgg(weights_path: Path | None = None, compute_dtype: torch.dtype = torch.float32) -> VggFeatures:
    """The shipped VGG-16, or a file's: torchvision's vgg16 / vgg19 .pth, or .safetensors. Raises InputError."""
    path = Path(weights_path) if weights_path else SHIPPED_WEIGHTS
    if not path.is_file():
        raise InputError(
            f"{path}: VGG weights not found; give a file with --weights, or leave it out for the shipped ones."
        )
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            tensors = load_file(str(path))
        else:
            tensors = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch and safetensors raise many kinds for a damaged file
        raise InputError(f"{path}: VGG weights cannot be read ({error}); download the file again.") from error
    if "features.0.weight" in tensors:
        tensors = _from_torchvision(tensors)
    backbone = "vgg19" if "conv3_4.weight" in tensors else "vgg16"
    missing = [
        f"conv{block + 1}_{k + 1}"
        for block, count in enumerate(CONVOLUTIONS[backbone])
        for k in range(count)
        if f"conv{block + 1}_{k + 1}.weight" not in tensors
    ]
    if missing:
        raise InputError(f"{path}: not VGG-16 or VGG-19 weights, {', '.join(missing)} missing; give the ImageNet file.")
    return VggFeatures(tensors, backbone, compute_dtype)


def download_vgg19(folder: Path) -> Path:
    """The official ImageNet VGG-19 (548 MB), its hash checked; kept in `folder`. Raises InputError when offline."""
    url, hash_prefix = VGG19_OFFICIAL
    path = Path(folder) / Path(url).name
    if not path.is_file():
        try:
            Path(folder).mkdir(parents=True, exist_ok=True)
            torch.hub.download_url_to_file(url, str(path), hash_prefix=hash_prefix, progress=True)
        except (OSError, RuntimeError) as error:
            raise InputError(
                f"{path}: the official VGG-19 weights could not be downloaded ({error}); download {url} elsewhere and "
                "give the file with --weights, or leave --weights out to use the shipped VGG-16."
            ) from error
    return path


def _from_torchvision(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """torchvision's state -> convB_K names, and its standardised RGB 0..1 input -> BGR 0..255 minus the mean."""
    indices = sorted(
        {int(key.split(".")[1]) for key in tensors if key.startswith("features.") and key.endswith("weight")}
    )
    counts = (2, 2, 3, 3, 3) if len(indices) == 13 else (2, 2, 4, 4, 4)
    names = [f"conv{block + 1}_{k + 1}" for block, count in enumerate(counts) for k in range(count)]
    converted = {}
    for name, index in zip(names, indices, strict=False):
        converted[f"{name}.weight"] = tensors[f"features.{index}.weight"].float()
        converted[f"{name}.bias"] = tensors[f"features.{index}.bias"].float()
    scale = 255 * torch.tensor([0.229, 0.224, 0.225])
    first = converted["conv1_1.weight"] / scale[None, :, None, None]
    converted["conv1_1.weight"] = first.flip(1)
    return converted
