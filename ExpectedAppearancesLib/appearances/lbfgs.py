"""L-BFGS for a batch of independent problems: history, step and stopping are each image's own."""

from __future__ import annotations

from collections.abc import Callable

import torch


def minimise(
    loss: Callable[[torch.Tensor], torch.Tensor],
    start: torch.Tensor,
    iterations: int = 50,
    history: int = 100,
    first_step: float = 1.0,
    largest_step: float = 20.0,
    after_iteration: Callable[[int, torch.Tensor], None] | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Minimise loss(x)[b] over x[b] for all b at once; loss maps (B, ...) to (B,) without mixing images.

    Full steps without a line search, as the authors' optimiser; the first one moves x by `first_step` (root mean
    square), none by more than `largest_step`.
    Returns the best x seen (B, ...) and its loss (B,). One evaluation per iteration, and one for the last point.
    """
    x = start.detach().clone()
    shape = x.shape
    dots = lambda a, b: (a * b).sum(dim=1, keepdim=True)  # noqa: E731
    pairs: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]] = []
    best, best_loss = x.clone(), torch.full((shape[0],), float("inf"), device=x.device)
    scale = torch.ones((shape[0], 1), device=x.device)
    previous_gradient = step = None
    for iteration in range(iterations + 1):
        x.requires_grad_(True)
        values = loss(x)
        (gradient,) = torch.autograd.grad(values.sum(), x)
        x, values = x.detach(), values.detach()
        gradient = torch.nan_to_num(gradient).reshape(shape[0], -1)
        better = values < best_loss
        best_loss = torch.where(better, values, best_loss)
        best = torch.where(better.view(-1, *[1] * (len(shape) - 1)), x, best)
        if after_iteration is not None:
            after_iteration(iteration, values)
        if iteration == iterations:
            break
        if step is not None:
            change = gradient - previous_gradient
            curvature = dots(change, step)
            # An image whose curvature is not positive gets a pair of weight zero, which changes nothing for it.
            usable = curvature > 1e-10 * dots(change, change).clamp_min(1e-30)
            rho = torch.where(
                usable, 1 / torch.where(usable, curvature, torch.ones_like(curvature)), torch.zeros_like(curvature)
            )
            newest_scale = curvature / dots(change, change).clamp_min(1e-30)
            # Where the loss is concave (Grams near zero) it says nothing of the step's length: lengthen it.
            scale = torch.where(usable, newest_scale, 2 * scale)
            pairs.append((step, change, rho))
            del pairs[:-history]
        if step is None:
            scale = first_step / _root_mean_square(gradient)
        direction = -_inverse_hessian_times(gradient, pairs, scale, dots)
        # A step uphill means a worn-out history for that image: fall back to its gradient alone.
        direction = torch.where(dots(direction, gradient) >= 0, -scale * gradient, direction)
        direction = direction * (largest_step / _root_mean_square(direction)).clamp(max=1.0)
        previous_gradient, step = gradient, direction
        x = (x.reshape(shape[0], -1) + step).reshape(shape)
    return best, best_loss


def _root_mean_square(rows):
    return rows.square().mean(dim=1, keepdim=True).sqrt().clamp_min(1e-30)


def _inverse_hessian_times(vector, pairs, scale, dots):
    """The two-loop recursion (Nocedal & Wright, algorithm 7.4), row by row; scale (B, 1) is the initial Hessian's."""
    q, alphas = vector.clone(), []
    for s, y, rho in reversed(pairs):
        alpha = rho * dots(s, q)
        alphas.append(alpha)
        q = q - alpha * y
    q = q * scale
    for (s, y, rho), alpha in zip(pairs, reversed(alphas), strict=True):
        q = q + (alpha - rho * dots(y, q)) * s
    return q
