"""Training losses of P_Omega."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from ..registration.encoding import PoseEncoding


def regression_loss(output: torch.Tensor, target: torch.Tensor, encoding: PoseEncoding) -> torch.Tensor:
    """L_Omega (paper, equation 3): ||t - t^|| (mm) + ||r - r^|| (rad), mean over the batch. Both (B, 6)."""
    translation = (output[:, 3:] - target[:, 3:]) * encoding.translation_scale_mm
    return (translation.norm(dim=1) + (output[:, :3] - target[:, :3]).norm(dim=1)).mean()


def segmentation_loss(logits: torch.Tensor, vessels: torch.Tensor) -> torch.Tensor:
    """Cross-entropy of the vessels plus 1 - Dice: vessels fill a small part of a view. Both (B, 1, G, G)."""
    probability = torch.sigmoid(logits)
    dice = (2 * (probability * vessels).sum() + 1) / (probability.sum() + vessels.sum() + 1)
    return F.binary_cross_entropy_with_logits(logits, vessels) + 1 - dice


def dense_loss(
    output: torch.Tensor, points_mm: torch.Tensor, surface: torch.Tensor, vessels: torch.Tensor, encoding: PoseEncoding
) -> torch.Tensor:
    """Negative log-likelihood of the surface points, whose distance from the prediction falls off as exp(-d / sigma) in
    space, plus cross-entropy of surface and vessels. output (B, 6, G, G); points_mm (B, G, G, 3); surface and vessels
    (B, G, G).
    """
    centre = torch.as_tensor(encoding.centre_world_mm, dtype=torch.float32, device=output.device)
    target = ((points_mm - centre) / encoding.scale_mm).permute(0, 3, 1, 2)
    distance = (output[:, :3] - target).square().sum(dim=1).add(1e-10).sqrt()
    log_sigma = output[:, 3].clamp(-7, 3)
    seen = surface.float()
    likelihood = distance * torch.exp(-log_sigma) + 3 * log_sigma
    # Vessels carry the pose; a plain distance keeps early training from hiding in large sigmas.
    weight = seen * (1 + vessels.float())
    coordinates = ((likelihood + 10 * distance) * weight).sum() / weight.sum().clamp_min(1)
    is_surface = F.binary_cross_entropy_with_logits(output[:, 4], seen)
    is_vessel = (F.binary_cross_entropy_with_logits(output[:, 5], vessels.float(), reduction="none") * seen).sum()
    return coordinates + 2 * is_surface + 2 * is_vessel / seen.sum().clamp_min(1)
