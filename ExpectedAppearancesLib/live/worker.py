"""One thread that works on the newest frame only: what arrives meanwhile replaces what waits."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")
STOP_S = 3.0


@dataclass(frozen=True)
class WorkerCounts:
    """submitted = done + dropped + waiting (0 or 1) + in_flight (0 or 1); unseen: results replaced before taken."""

    submitted: int = 0
    done: int = 0
    dropped: int = 0
    unseen: int = 0
    in_flight: int = 0


class NewestWins(Generic[Task, Result]):
    """Calls `process(task)` in a thread of its own, one at a time; at most one task waits, always the newest.

    `process` returns its result, also for what failed: an exception would end the work, so it is a fault and is kept
    in `failure`.
    """

    def __init__(self, process: Callable[[Task], Result]):
        self._process = process
        self._condition = threading.Condition()
        self._waiting: Task | None = None
        self._result: Result | None = None
        self._counts = dict.fromkeys(WorkerCounts.__dataclass_fields__, 0)
        self._generation = 0
        self._stopping = False
        self.failure: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="ExpectedAppearances registration", daemon=True)
        self._thread.start()

    @property
    def counts(self) -> WorkerCounts:
        with self._condition:
            return WorkerCounts(**self._counts)

    def submit(self, task: Task) -> None:
        """Give a task; the one that waits, if any, is dropped. Never blocks on work."""
        with self._condition:
            if self._stopping:
                return
            self._counts["submitted"] += 1
            if self._waiting is not None:
                self._counts["dropped"] += 1
            self._waiting = task
            self._condition.notify_all()

    def take(self, timeout_s: float = 0.0) -> Result | None:
        """The newest result that was not taken yet, or None. Waiting here lets Python's other threads run."""
        with self._condition:
            if self._result is None and timeout_s > 0 and not self._stopping:
                self._condition.wait_for(lambda: self._result is not None or self._stopping, timeout_s)
            result, self._result = self._result, None
            return result

    def forget(self) -> None:
        """Drop what waits, what is in flight once it is done, and what was not taken."""
        with self._condition:
            self._generation += 1
            self._counts["dropped"] += self._waiting is not None
            self._counts["unseen"] += self._result is not None
            self._waiting = self._result = None

    def stop(self, timeout_s: float = STOP_S) -> bool:
        """End the thread after the task in flight; its result is not kept. False when it takes longer than that."""
        with self._condition:
            self._stopping = True
            self._waiting = self._result = None
            self._condition.notify_all()
        if self._thread is not threading.current_thread():
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._condition:
                self._condition.wait_for(lambda: self._stopping or self._waiting is not None)
                if self._stopping:
                    return
                task, self._waiting = self._waiting, None
                generation = self._generation
                self._counts["in_flight"] = 1
            result = None
            try:
                result = self._process(task)
            except BaseException as error:
                logging.getLogger(__name__).exception("The registration of a frame failed")
                self.failure = error
            finally:
                task = None  # a frame must not live on here until the next one comes
                with self._condition:
                    self._counts["in_flight"] = 0
                    self._counts["done"] += 1
                    if result is not None and not self._stopping:
                        if generation != self._generation:
                            self._counts["unseen"] += 1
                        else:
                            self._counts["unseen"] += self._result is not None
                            self._result = result
                    self._condition.notify_all()
            result = None
