"""The engine beside the paper's recipe in plain PyTorch, on the same label map and texture, in one run.

Both end in 8-bit images, whose class-wise Gram distance is measured by the same fp32 code. The engine runs as it does
by default (28 iterations), the reference 50, as the paper does.
"""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import plain_synthesis
import psutil
import torch
from safetensors.torch import load_file

from ExpectedAppearancesLib.appearances.gram import CLASSES
from ExpectedAppearancesLib.appearances.images import resized
from ExpectedAppearancesLib.appearances.measure import GramMeasure
from ExpectedAppearancesLib.appearances.synthesis import Job, Synthesizer
from ExpectedAppearancesLib.appearances.vgg import SHIPPED_WEIGHTS, load_vgg
from ExpectedAppearancesLib.appearances.workload import DEFAULT_ITERATIONS, images_at_once, operations_per_evaluation
from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.devices import choose_device, fast_dtype
from ExpectedAppearancesLib.files import read_label_map
from ExpectedAppearancesLib.masks.stage import read_rendered, render_case
from ExpectedAppearancesLib.textures.library import Texture, read_library, shipped_textures_folder

ROUNDS = {128: 3, 256: 2}
BUDGET_S = 120  # for each size; on a busy computer one round must do
SQUARE = 3072


def measure(inputs: Path) -> dict:
    """{"synthesis": {"128": {...}, "256": {...}}}; rounds alternate, medians of rates and ratios."""
    labels = _label_map(inputs)
    folder = inputs / "textures"
    textures = read_library(folder if folder.is_dir() else shipped_textures_folder())
    device = choose_device("auto")
    weights = {name: tensor.float() for name, tensor in load_file(str(SHIPPED_WEIGHTS)).items()}
    distance = GramMeasure(load_vgg())
    synthesizer = Synthesizer(load_vgg(None, fast_dtype(device)), device)
    synthesizer.run([Job(_at(labels, 64), textures[0], 0)])  # libraries loaded, threads started
    return {
        "synthesis": {
            "device": device.type,
            "threads": torch.get_num_threads(),
            "precision": str(synthesizer.vgg.compute_dtype).removeprefix("torch."),
        }
        | {str(size): _side_by_side(_at(labels, size), textures, synthesizer, weights, distance) for size in ROUNDS}
    }


def _side_by_side(
    labels: np.ndarray, textures: list[Texture], synthesizer: Synthesizer, weights: dict, distance: GramMeasure
) -> dict:
    size = labels.shape[0]
    batch = images_at_once(labels.shape, DEFAULT_ITERATIONS, synthesizer.device)
    class_shares = tuple(float((labels == c).mean()) for c in CLASSES)
    each = operations_per_evaluation(labels.shape, synthesizer.vgg.backbone, class_shares)
    operations = each * (DEFAULT_ITERATIONS + 1)
    own, plain, shares, distances, peaks = [], [], [], [], {"own": 0.0, "plain": 0.0}
    start = time.monotonic()
    for turn in range(ROUNDS[size]):
        if turn and time.monotonic() - start > BUDGET_S:
            break
        texture = textures[turn % len(textures)]
        image, texture_labels = resized(texture, *labels.shape)
        synthesizer.targets.of(texture, *labels.shape)  # once for a texture, however many images: not an image's cost
        before = _matmul_rate(synthesizer)
        with _peak_memory(peaks, "own"):
            begin = time.perf_counter()
            made = synthesizer.run([Job(labels, texture, 100 * turn + i) for i in range(batch)])
            own.append(batch / (time.perf_counter() - begin))
        shares.append(own[-1] * operations / np.mean([before, _matmul_rate(synthesizer)]))
        with _peak_memory(peaks, "plain"):
            begin = time.perf_counter()
            reference = plain_synthesis.synthesise(weights, labels, image, texture_labels, turn)
            plain.append(1 / (time.perf_counter() - begin))
        both = made[0], reference
        distances.append([sum(distance.distances(found, labels, texture).values()) for found in both])
    ratios = np.array(own) / np.array(plain)
    own_distance, plain_distance = np.mean(distances, axis=0)
    return {
        "images_per_s": round(float(np.median(own)), 3),
        "reference_images_per_s": round(float(np.median(plain)), 4),
        "ratio": round(float(np.median(ratios)), 2),
        "gram_distance": round(float(own_distance), 3),
        "reference_gram_distance": round(float(plain_distance), 3),
        "gram_distance_ratio": round(float(own_distance / plain_distance), 3),
        "share_of_matmul": round(float(np.median(shares)), 2),
        "peak_memory_mb": round(peaks["own"]),
        "reference_peak_memory_mb": round(peaks["plain"]),
        "batch": batch,
        "rounds": len(own),
    }


def _matmul_rate(synthesizer: Synthesizer) -> float:
    """Operations per second of torch.mm on large squares in the engine's type, the best of a few."""
    a, b = (torch.randn(SQUARE, SQUARE).to(synthesizer.device, synthesizer.vgg.compute_dtype) for _ in range(2))
    best = float("inf")
    for _ in range(6):
        _finish(synthesizer.device)
        begin = time.perf_counter()
        torch.mm(a, b)
        _finish(synthesizer.device)
        best = min(best, time.perf_counter() - begin)
    return 2 * SQUARE**3 / best


def _finish(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize()


@contextmanager
def _peak_memory(peaks: dict[str, float], name: str):
    """Highest resident memory in the block above that before it, MB."""
    process, done = psutil.Process(), threading.Event()
    start = process.memory_info().rss

    def watch() -> None:
        while not done.wait(0.02):
            peaks[name] = max(peaks[name], (process.memory_info().rss - start) / 2**20)

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        done.set()
        watcher.join()


def _label_map(inputs: Path) -> np.ndarray:
    with tempfile.TemporaryDirectory() as folder:
        case = Case.create(Path(folder) / "case", inputs / "vessels.vtp", inputs / "cortex.vtp", inputs / "camera.json")
        render_case(case, _silent, poses=1)
        labels = read_label_map(read_rendered(case)[0]["labels"])
    side = min(labels.shape)
    top, left = (labels.shape[0] - side) // 2, (labels.shape[1] - side) // 2
    return labels[top : top + side, left : left + side]


def _at(labels: np.ndarray, size: int) -> np.ndarray:
    return cv2.resize(labels, (size, size), interpolation=cv2.INTER_NEAREST)


_silent: Callable[[float, str], None] = lambda fraction, message: None  # noqa: E731
