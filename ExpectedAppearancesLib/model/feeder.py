"""Batches of training views from processes of their own.

Rendering and training are kept apart: loading all of VTK and torch's optimisers into one process has crashed, and two
processes use two cores.
"""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import os
import queue
import signal
import traceback
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .views import ViewSettings

QUEUE_BATCHES = 6
TIMEOUT_S = 300.0
ORPHAN_LOOKS_S = 2.0  # how often a process whose views nobody takes looks whether anybody is left
THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LP_NUM_THREADS")


@dataclass(frozen=True)
class Batch:
    """images uint8 (B, S, S, 3); camera_from_world (B, 4, 4); points_mm (B, G, G, 3); surface, vessels (B, G, G)."""

    images: np.ndarray
    camera_from_world: np.ndarray
    points_mm: np.ndarray
    surface: np.ndarray
    vessels: np.ndarray


class Feeder:
    """Yields the batches of views first, first + size, ... in order. A context manager: leaving it ends the processes.

    workers: processes that draw batches in turn; their number changes nothing in what is drawn.
    """

    def __init__(self, case_folder: Path, settings: ViewSettings, batch: int, first_batch: int = 0, workers: int = 1):
        context = multiprocessing.get_context("spawn")
        self._queues = [context.Queue(max(2, QUEUE_BATCHES // workers)) for _ in range(workers)]
        self._processes = [
            context.Process(
                target=_serve,
                args=(str(case_folder), settings, batch, first_batch + k, workers, own),
                daemon=True,
            )
            for k, own in enumerate(self._queues)
        ]
        self._taken = 0

    def __enter__(self) -> Feeder:
        # One thread each for numpy, OpenCV and Mesa's rasteriser: more would fight with training for its cores. They
        # are read when the libraries load, so the new process must inherit them.
        usual = {name: os.environ.get(name) for name in THREAD_LIMITS}
        os.environ.update(dict.fromkeys(THREAD_LIMITS, "1"))
        try:
            for process in self._processes:
                process.start()
        finally:
            for name, value in usual.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value
        return self

    def __exit__(self, *_error) -> None:
        for process, own in zip(self._processes, self._queues):
            process.terminate()
            process.join(10)
            own.cancel_join_thread()
            own.close()

    def next(self) -> Batch:
        """The next batch. Raises RuntimeError with the other process's traceback when it failed."""
        turn = self._taken % len(self._queues)
        for _ in range(int(TIMEOUT_S)):
            try:
                item = self._queues[turn].get(timeout=1.0)
            except queue.Empty:
                process = self._processes[turn]
                if process.is_alive():
                    continue
                raise RuntimeError(f"rendering of training views ended (exit code {process.exitcode})") from None
            if isinstance(item, str):
                raise RuntimeError(f"rendering of training views failed:\n{item}")
            self._taken += 1
            return Batch(*item)
        raise RuntimeError(f"no training view was rendered in {TIMEOUT_S:.0f} s")


class ViewMemory:
    """Batches that mix new views with ones seen before; what comes out depends only on the seed and the step."""

    def __init__(self, feeder: Feeder, batch: int, remembered: int, seed: int):
        self._feeder, self._batch, self._remembered, self._seed = feeder, batch, remembered, seed
        self._views: list[tuple[np.ndarray, ...]] = []
        self.drawn = 0  # batches taken from the feeder

    def next(self, step: int) -> Batch:
        fresh = self._draw()
        while len(self._views) + len(fresh) < self._batch:
            self._views += fresh
            fresh = self._draw()
        rng = np.random.default_rng([self._seed, step])
        again = rng.choice(len(self._views), self._batch - len(fresh), replace=False) if self._views else []
        chosen = fresh + [self._views[i] for i in again]
        if len(fresh) < self._batch:
            self._views = (self._views + fresh)[-self._remembered :]
        return Batch(*(np.stack(parts) for parts in zip(*chosen)))

    def _draw(self) -> list[tuple[np.ndarray, ...]]:
        self.drawn += 1
        batch = self._feeder.next()
        return list(zip(*vars(batch).values()))


def draw_views(case_folder: Path, settings: ViewSettings, count: int, workers: int = 1) -> Batch:
    """Views 0 ... count - 1 at once, through a feeder."""
    size = min(count, 16)
    with Feeder(case_folder, settings, size, workers=workers) as feeder:
        drawn = [feeder.next() for _ in range(math.ceil(count / size))]
    return Batch(*(np.concatenate(parts)[:count] for parts in zip(*(vars(batch).values() for batch in drawn))))


def _serve(case_folder: str, settings: ViewSettings, batch: int, first_batch: int, stride: int, out) -> None:
    # Ctrl+C reaches this process as well, but it is for who takes the views to say when there are enough.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        import cv2

        from .views import ViewSource

        cv2.setNumThreads(1)
        source = ViewSource(Path(case_folder), settings)
        number = first_batch
        while True:
            views = [source.view(number * batch + i) for i in range(batch)]
            drawn = (
                np.stack([v.image for v in views]),
                np.stack([v.camera_from_world for v in views]),
                np.stack([v.points_mm for v in views]),
                np.stack([v.surface for v in views]),
                np.stack([v.vessels for v in views]),
            )
            if not _given(out, drawn):
                return
            number += stride
    except BaseException:  # the training process must learn of it, whatever it is
        out.put(traceback.format_exc())


def _given(out, drawn: tuple[np.ndarray, ...]) -> bool:
    """Puts the batch in; False where nobody is left to take it."""
    while multiprocessing.parent_process().is_alive():
        with contextlib.suppress(queue.Full):
            out.put(drawn, timeout=ORPHAN_LOOKS_S)
            return True
    out.cancel_join_thread()  # what was put in before would be waited for
    return False
