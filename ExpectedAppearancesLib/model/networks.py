"""The networks of P_Omega. All take RGB (B, 3, S, S) in 0..1 and know nothing of cameras or millimetres."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn


class PaperRegressor(nn.Module):
    """P_Omega (paper, section 2.3): 3 blocks of (conv, conv, ReLU), average pooling after all but the last, then
    128-64-32-6."""

    def __init__(self, size_px: int, inputs: int = 3):
        super().__init__()
        layers, previous, channels = [], inputs, (16, 32, 64)
        for i, width in enumerate(channels):
            layers += [nn.Conv2d(previous, width, 3, padding=1), nn.Conv2d(width, width, 3, padding=1), nn.ReLU()]
            layers += [nn.AvgPool2d(2)] if i < len(channels) - 1 else []
            previous = width
        self.features = nn.Sequential(*layers)
        side = size_px // 4
        self.head = nn.Sequential(
            nn.Linear(previous * side * side, 128),
            nn.ReLU(),
            nn.Linear(128, 64),
            nn.ReLU(),
            nn.Linear(64, 32),
            nn.ReLU(),
            nn.Linear(32, 6),
        )
        for module in self.modules():
            if isinstance(module, (nn.Conv2d, nn.Linear)):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(module.bias)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """-> (B, 6): rotation vector relative to the case's reference (rad), scaled translation."""
        return self.head(self.features(image - 0.5).flatten(1))


def _block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU()
    )


class DenseSurfaceNet(nn.Module):
    """U-Net that tells, for each cell of a grid half the input's size, which point of the surface it sees.

    -> (B, 6, S/2, S/2): surface coordinates in units of the case's scale (3), log of their scale of error (1),
    logit of "the case's surface is here" (1), logit of "vessel" (1).
    What comes up is added to what was kept, not concatenated, and no layer works at the input's own size: on a CPU
    these two would cost more than everything else together.
    """

    def __init__(self, width: float = 1.0, outputs: int = 6):
        super().__init__()
        c = [16 * round(width * n / 16) for n in (48, 96, 160, 224)]
        self.stem = nn.Sequential(nn.PixelUnshuffle(2), _block(12, c[0]), _block(c[0], c[0]))
        self.down2 = nn.Sequential(_block(c[0], c[1], 2), _block(c[1], c[1]))
        self.down3 = nn.Sequential(_block(c[1], c[2], 2), _block(c[2], c[2]))
        self.down4 = nn.Sequential(_block(c[2], c[3], 2), _block(c[3], c[3]))
        self.context = nn.Linear(c[3], c[3])
        self.bottom = _block(c[3], c[3])
        self.narrow3, self.up3 = nn.Conv2d(c[3], c[2], 1), _block(c[2], c[2])
        self.narrow2, self.up2 = nn.Conv2d(c[2], c[1], 1), _block(c[1], c[1])
        self.narrow1, self.up1 = nn.Conv2d(c[1], c[0], 1), _block(c[0], c[0])
        self.head = nn.Conv2d(c[0], outputs, 1)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        x1 = self.stem(image - 0.5)
        x2 = self.down2(x1)
        x3 = self.down3(x2)
        x4 = self.down4(x3)
        # What lies where depends on the whole view: its mean is given to every cell.
        x4 = self.bottom(x4 + self.context(x4.mean(dim=(2, 3)))[:, :, None, None])
        x = self.up3(_twice(self.narrow3(x4)) + x3)
        x = self.up2(_twice(self.narrow2(x)) + x2)
        x = self.up1(_twice(self.narrow1(x)) + x1)
        return self.head(x).float()


def _twice(x: torch.Tensor) -> torch.Tensor:
    return F.interpolate(x, scale_factor=2.0, mode="nearest")


class SegmentedRegressor(nn.Module):
    """The paper's rivals (Haouchine et al. 2022): a U-Net segments the vessels, and the pose network reads them.

    reads: 'probability' (ProbSEG) or 'mask', the thresholded one (BinSEG). The two parts learn side by side and apart:
    the pose network from rendered masks only, as it was published, so that it never sees a segmentation in training.
    """

    RAMP = 50.0  # the threshold is a ramp 1 / RAMP wide, in logits: rounding then cannot turn a pixel over

    def __init__(self, size_px: int, width: float, reads: str):
        super().__init__()
        self.reads = reads
        self.segmenter = DenseSurfaceNet(width, outputs=1)
        self.regressor = PaperRegressor(size_px // 2, inputs=1)

    def forward(self, image: torch.Tensor, rendered: torch.Tensor | None = None):
        """-> (B, 6); given rendered masks (B, 1, S/2, S/2): logits of the vessels, and the pose of those masks."""
        logits = self.segmenter(image)
        if rendered is not None:
            with torch.autocast(image.device.type, enabled=False):  # bf16 has too few digits for a pose
                return logits, self.regressor(rendered)
        binary = self.reads == "mask"
        return self.regressor((logits * self.RAMP + 0.5).clamp(0, 1) if binary else torch.sigmoid(logits))


def build_network(estimator: str, size_px: int, width: float, reads: str = "image") -> nn.Module:
    if reads != "image":
        return SegmentedRegressor(size_px, width, reads)
    return PaperRegressor(size_px) if estimator == "regression" else DenseSurfaceNet(width)
