"""VGG features for S_Theta: relu1_1 ... relu5_1 with average pooling, and label masks carried down beside them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import torch
import torch.nn.functional as F

from ..errors import InputError

SHIPPED_WEIGHTS = Path(__file__).parent / "weights" / "vgg16_imagenet_to_conv5_1_fp16.safetensors"
VGG19_OFFICIAL = ("https://download.pytorch.org/models/vgg19-dcbb9e9d.pth", "dcbb9e9d")
BGR_MEAN = (103.939, 116.779, 123.68)  # of ImageNet, 0..255
CONVOLUTIONS = {"vgg16": (2, 2, 3, 3, 1), "vgg19": (2, 2, 4, 4, 1)}  # per block, up to conv5_1
WIDTHS = (64, 128, 256, 512, 512)


class VggFeatures(torch.nn.Module):
    """(B, 3, H, W) BGR 0..255 minus the mean -> features after relu of the first convolution of each block.

    compute_dtype: bfloat16 where the processor multiplies it fast, else float32. Weights are frozen. Everything is
    channels-last, and an image's features are the same bits whatever the batch it is in.
    """

    def __init__(self, weights: dict[str, torch.Tensor], backbone: str, compute_dtype: torch.dtype = torch.float32):
        super().__init__()
        self.backbone = backbone
        self.compute_dtype = compute_dtype
        self.names = _names(CONVOLUTIONS[backbone])
        for name in self.names:
            weight = weights[f"{name}.weight"].to(compute_dtype)
            # The gradient of a 3x3 convolution with respect to its input is one with the weights turned round. After
            # a pool it also takes the pool's 1/4, which is exact.
            turned = weight.transpose(0, 1).flip(2, 3) * (0.25 if self._follows_pool(name) else 1.0)
            for key, value in (("weight", weight), ("turned", turned)):
                self.register_buffer(
                    f"{name}_{key}", value.contiguous(memory_format=torch.channels_last), persistent=False
                )
            self.register_buffer(f"{name}_bias", weights[f"{name}.bias"].to(compute_dtype), persistent=False)
        # Of the newest size only: each photograph's is another, and all weights once more take tens of MB.
        self._packed: dict[tuple[str, str], tuple[torch.Size, torch.Tensor]] = {}

    def forward(self, image: torch.Tensor) -> list[torch.Tensor]:
        return [x for name, x in zip(self.names, self.activations(image)) if name.endswith("_1")]

    @torch.no_grad()
    def activations(self, image: torch.Tensor) -> list[torch.Tensor]:
        """What each convolution gives after relu, in the order of `names`: all that `input_gradient` needs."""
        x = image.to(self.compute_dtype).contiguous(memory_format=torch.channels_last)
        found = []
        for name in self.names:
            if self._follows_pool(name):
                x = F.avg_pool2d(x, 2)
            x = self._convolve(x, name, "weight", relu=True)
            found.append(x)
        return found

    @torch.no_grad()
    def input_gradient(
        self, activations: list[torch.Tensor], add_own: Callable[[int, torch.Tensor, torch.Tensor], None]
    ) -> torch.Tensor:
        """Gradient (B, 3, H, W) of a loss of the features with respect to the image; `activations` are used up.

        add_own(layer, features, gradient) adds to `gradient`, in place, what the loss itself says of feature layer
        0..4; it is called from the deepest to the first. No gradient of the weights, no graph: on a processor the
        passes over memory that those need cost more than the convolutions.
        """
        gradient = None
        layer = len(CONVOLUTIONS[self.backbone])
        for name in reversed(self.names):
            x = activations.pop()
            if gradient is None:
                gradient = torch.zeros_like(x)
            if name.endswith("_1"):
                layer -= 1
                add_own(layer, x, gradient)
            if gradient.shape == x.shape:
                torch.ops.aten.threshold_backward.grad_input(gradient, x, 0, grad_input=gradient)
            else:
                gradient = _through_relu_and_pool(gradient, x)
            gradient = self._convolve(gradient, name, "turned", relu=False)
        return gradient

    def _follows_pool(self, name: str) -> bool:
        return name.endswith("_1") and name != "conv1_1"

    def _convolve(self, x: torch.Tensor, name: str, key: str, relu: bool) -> torch.Tensor:
        """3x3 convolution, same size; the bias belongs to the way up only."""
        weight = getattr(self, f"{name}_{key}")
        bias = getattr(self, f"{name}_bias") if key == "weight" else None
        if x.device.type == "cpu" and _can_pack():
            size, packed = self._packed.get((name, key), (None, None))
            if size != x.shape[2:]:
                # Packed for one image: for another batch oneDNN could choose another blocking, so other roundings.
                packed = torch._C._nn.mkldnn_reorder_conv2d_weight(
                    weight.to_mkldnn(), [1, 1], [1, 1], [1, 1], 1, [1, *x.shape[1:]]
                )
                self._packed[name, key] = x.shape[2:], packed
            after = "relu" if relu else "none"
            return torch.ops.mkldnn._convolution_pointwise(x, packed, bias, [1, 1], [1, 1], [1, 1], 1, after, [], "")
        x = F.conv2d(x, weight, bias, padding=1)
        return x.relu_() if relu else x

    def carry_masks(self, masks: torch.Tensor) -> list[torch.Tensor]:
        """(B, C, H, W) class masks 0..1 -> the masks at each feature layer: halved at each pool, 3x3 box-averaged at
        each convolution, as in neural doodle."""
        carried, m = [], masks.float()
        for name in self.names:
            if self._follows_pool(name):
                m = F.avg_pool2d(m, 2)
            m = F.avg_pool2d(m, 3, stride=1, padding=1)
            if name.endswith("_1"):
                carried.append(m)
        return carried


@cache
def _can_pack() -> bool:
    return torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_convolution_pointwise")


def _through_relu_and_pool(gradient: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Gradient of the pool's output (times 1/4, see `turned`), spread over its 2x2 inputs where relu let them pass."""
    batch, channels, height, width = x.shape
    if height % 2 or width % 2:  # the pool left out the last row or column
        spread = F.pad(F.interpolate(gradient, scale_factor=2), (0, width % 2, 0, height % 2))
        return torch.ops.aten.threshold_backward(spread.contiguous(memory_format=torch.channels_last), x, 0)
    small = gradient.permute(0, 2, 3, 1).reshape(batch, height // 2, 1, width // 2, 1, channels)
    large = x.permute(0, 2, 3, 1).reshape(batch, height // 2, 2, width // 2, 2, channels)
    passed = torch.ops.aten.threshold_backward(small, large, 0)
    return passed.reshape(batch, height, width, channels).permute(0, 3, 1, 2)


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
    missing = [name for name in _names(CONVOLUTIONS[backbone]) if f"{name}.weight" not in tensors]
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


def _names(counts: Sequence[int]) -> list[str]:
    """Of the convolutions, of which there are so many in each block: conv1_1, conv1_2, conv2_1, ..."""
    return [f"conv{block + 1}_{k + 1}" for block, count in enumerate(counts) for k in range(count)]


def _from_torchvision(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """torchvision's state -> convB_K names, and its standardised RGB 0..1 input -> BGR 0..255 minus the mean."""
    indices = sorted(
        {int(key.split(".")[1]) for key in tensors if key.startswith("features.") and key.endswith("weight")}
    )
    counts = (2, 2, 3, 3, 3) if len(indices) == 13 else (2, 2, 4, 4, 4)
    converted = {}
    for name, index in zip(_names(counts), indices):
        converted[f"{name}.weight"] = tensors[f"features.{index}.weight"].float()
        converted[f"{name}.bias"] = tensors[f"features.{index}.bias"].float()
    scale = 255 * torch.tensor([0.229, 0.224, 0.225])
    first = converted["conv1_1.weight"] / scale[None, :, None, None]
    converted["conv1_1.weight"] = first.flip(1)
    return converted
