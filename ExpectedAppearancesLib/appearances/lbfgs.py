"""L-BFGS for a batch of independent problems: history, step and stopping are each image's own."""

from __future__ import annotations

from collections.abc import Callable

import torch

# Sums over an image are taken over so many values in fp32, and over these sums in fp64: their roundings then depend
# neither on the batch nor on the number of threads.
VALUES_PER_SUM = 4096


def minimise(
    value_and_gradient: Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]],
    start: torch.Tensor,
    iterations: int = 50,
    history: int = 100,
    first_step: float = 1.0,
    largest_step: float = 20.0,
    tolerance: float = 1e-4,
    patience: int = 10,
    after_iteration: Callable[[int, torch.Tensor], None] | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Minimise a loss of x[b] for all b at once; value_and_gradient maps (B, ...) to the losses (B,) and (B, ...),
    without mixing images.

    Full steps without a line search, as the authors' optimiser; the first one moves x by `first_step` (root mean
    square), none by more than `largest_step`. A problem stops where `patience` iterations have not lowered its loss
    by `tolerance` of it; the others go on.
    Returns the best x seen (B, ...) and its loss (B,). One evaluation per iteration, and one for the last point.
    Nothing here waits for a GPU.
    """
    shape = start.shape
    x = _padded(start.detach())
    size = start[0].numel()
    memory = _History(x, min(history, iterations))
    best, best_loss = x.clone(), torch.full((shape[0],), float("inf"), device=x.device)
    scale = torch.ones((shape[0], 1), dtype=torch.float64, device=x.device)
    stalled = torch.zeros((shape[0], 1), dtype=torch.int32, device=x.device)
    previous_gradient = step = None
    for iteration in range(iterations + 1):
        values, gradient = value_and_gradient(x[:, :size].reshape(shape))
        values, gradient = values.detach(), _padded(torch.nan_to_num(gradient.detach()))
        better = values < best_loss
        stalled = torch.where((values < (1 - tolerance) * best_loss)[:, None], 0, stalled + 1)
        going = stalled < patience
        best_loss = torch.where(better, values, best_loss)
        best = torch.where(better[:, None], x, best)
        if after_iteration is not None:
            after_iteration(iteration, values)
        if iteration == iterations or (x.device.type == "cpu" and not going.any()):
            break
        squares = _dots(gradient, gradient)
        if step is None:
            scale = first_step / (squares / size).sqrt().clamp_min(1e-30)
            direction = gradient * -scale.float()
        else:
            scale = memory.add(step, gradient - previous_gradient, scale)
            direction, slope = memory.newton_direction(gradient, scale)
            # A step uphill means a worn-out history for that image: fall back to its gradient alone.
            direction = torch.where(slope >= 0, gradient * -scale.float(), direction)
        length = (_dots(direction, direction) / size).sqrt().clamp_min(1e-30)
        direction *= (largest_step / length).clamp(max=1.0).float()
        previous_gradient, step = gradient, torch.where(going, direction, 0.0)
        x = x + step
    return best[:, :size].reshape(shape), best_loss


def _padded(rows: torch.Tensor) -> torch.Tensor:
    """(B, ...) -> (B, N), N a multiple of VALUES_PER_SUM, filled up with zeros, a copy."""
    flat = rows.reshape(len(rows), -1).float()
    return torch.nn.functional.pad(flat, (0, -flat.shape[1] % VALUES_PER_SUM))


def _dots(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """(B, N), (B, N) -> (B, 1) float64."""
    return (a * b).view(len(a), -1, VALUES_PER_SUM).sum(dim=2).double().sum(dim=1, keepdim=True)


class _History:
    """The newest pairs (s, y) of every image, and the inner products between them.

    The two-loop recursion (Nocedal & Wright, algorithm 7.4) is run on the coefficients of its vectors in the basis of
    s, y and the gradient (Chen et al., Large-scale L-BFGS using MapReduce, 2014): each iteration reads the history
    twice, where the recursion itself passes over every pair about ten times.
    """

    def __init__(self, like: torch.Tensor, most: int):
        batch, size = like.shape
        self.rows = torch.empty((batch, 2 * most, size), device=like.device)  # s of pair i in row 2 i, y in 2 i + 1
        # Touched only as pairs come. The products' last row and column are the gradient's.
        self.products = torch.zeros((batch, 2 * most + 1, 2 * most + 1), dtype=torch.float64, device=like.device)
        self.rho = torch.zeros((batch, most), dtype=torch.float64, device=like.device)
        self.most = most
        self.added = 0

    def add(self, step: torch.Tensor, change: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
        """Keep the pair (B, N), (B, N), dropping the oldest; returns the initial Hessian's scale (B, 1)."""
        at = self.added % self.most
        self.added += 1
        self.rows[:, 2 * at] = step
        self.rows[:, 2 * at + 1] = change
        curvature, squares = _dots(change, step), _dots(change, change).clamp_min(1e-30)
        # An image whose curvature is not positive gets a pair of weight zero, which changes nothing for it.
        usable = curvature > 1e-10 * squares
        self.rho[:, at : at + 1] = torch.where(usable, 1 / curvature, 0.0)
        # Where the loss is concave (Grams near zero) it says nothing of the step's length: lengthen it.
        return torch.where(usable, curvature / squares, 2 * scale)

    def newton_direction(self, gradient: torch.Tensor, scale: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """-H gradient (B, N) and its product with the gradient (B, 1)."""
        kept = min(self.added, self.most)
        newest = (self.added - 1) % self.most
        last = self.products.shape[1] - 1
        rows = self.rows[:, : 2 * kept]
        fresh = torch.stack([rows[:, 2 * newest], rows[:, 2 * newest + 1], gradient], dim=1)
        found = _products(rows, fresh)
        for column, index in enumerate((2 * newest, 2 * newest + 1, last)):
            self.products[:, : 2 * kept, index] = found[:, :, column]
            self.products[:, index, : 2 * kept] = found[:, :, column]
        self.products[:, last, last:] = _dots(gradient, gradient)
        order = [(newest - i) % self.most for i in range(kept)]
        coefficients = torch.zeros_like(self.products[:, 0])
        coefficients[:, last] = 1.0
        alphas = {}
        for i in order:
            alphas[i] = self.rho[:, i] * (coefficients * self.products[:, 2 * i]).sum(dim=1)
            coefficients[:, 2 * i + 1] -= alphas[i]
        coefficients *= scale
        for i in reversed(order):
            beta = self.rho[:, i] * (coefficients * self.products[:, 2 * i + 1]).sum(dim=1)
            coefficients[:, 2 * i] += alphas[i] - beta
        slope = -(coefficients * self.products[:, last]).sum(dim=1, keepdim=True)
        own = coefficients[:, : 2 * kept, None].float()
        direction = torch.stack([torch.mv(rows[b].T, own[b, :, 0]) for b in range(len(rows))])
        direction = direction + coefficients[:, last:].float() * gradient
        return -direction, slope


def _products(rows: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
    """(B, R, N), (B, C, N) -> inner products (B, R, C) float64."""
    batch, count, _ = rows.shape
    found = []
    for b in range(batch):
        left = rows[b].view(count, -1, VALUES_PER_SUM).transpose(0, 1)
        right = columns[b].view(columns.shape[1], -1, VALUES_PER_SUM).permute(1, 2, 0)
        found.append(torch.bmm(left, right).double().sum(dim=0))
    return torch.stack(found)
