"""A thread that reads a source, hands its frames on, and opens it again when it was lost."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

from ..errors import InputError
from .frames import LiveFrame
from .sources import Source, SourceEnded, SourceLost

POLL_S = 0.004
RETRY_S = 1.0
STOP_S = 2.0


class FeedState(Enum):
    STOPPED = "stopped"
    OPENING = "opening"
    RUNNING = "running"
    LOST = "lost"
    ENDED = "ended"


@dataclass(frozen=True)
class FeedStatus:
    """problem: why frames do not come, or what was wrong with the last one; '' when all is well."""

    state: FeedState
    problem: str = ""
    dropped: int = 0


class Feed:
    """Reads `source` in a thread of its own and calls `deliver(frame)` there, until `stop`."""

    def __init__(self, source: Source, deliver: Callable[[LiveFrame], None], retry_s: float = RETRY_S):
        self._source, self._deliver, self._retry_s = source, deliver, retry_s
        self._stopping = threading.Event()
        self._holding = False
        self._status = FeedStatus(FeedState.OPENING)
        self._thread = threading.Thread(target=self._run, name="ExpectedAppearances frames", daemon=True)

    @property
    def status(self) -> FeedStatus:
        return self._status

    def start(self) -> None:
        self._thread.start()

    def hold(self, holding: bool) -> None:
        """Pause a source that can wait; one that cannot is read on, and its frames are for the receiver to leave."""
        self._holding = holding

    def stop(self, timeout_s: float = STOP_S) -> bool:
        """End the thread. False when it hangs in a driver: it then delivers nothing any more and ends by itself."""
        self._stopping.set()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                try:
                    self._source.open()
                    self._set(FeedState.RUNNING)
                    self._read_until_lost()
                except SourceEnded:
                    self._set(FeedState.ENDED, self._status.problem)  # of a last frame that could not be read
                    return
                except (SourceLost, InputError) as error:
                    self._set(FeedState.LOST, str(error))
                finally:
                    self._source.close()
                self._stopping.wait(self._retry_s)
        except Exception as error:  # a driver's failure must reach the panel, not end as a silent thread
            self._set(FeedState.LOST, f"the source failed ({type(error).__name__}: {error}); start it again.")
        finally:
            if self._stopping.is_set():
                self._set(FeedState.STOPPED)

    def _read_until_lost(self) -> None:
        held = False
        while not self._stopping.is_set():
            if self._holding and self._source.can_wait:
                held = True
                self._stopping.wait(POLL_S)
                continue
            if held:
                held = False
                self._source.go_on()
            try:
                frame = self._source.read()
            except InputError as error:  # one bad frame: say so and go on
                self._set(FeedState.RUNNING, str(error))
                frame = None
            if frame is None:
                self._stopping.wait(POLL_S)
            elif not self._stopping.is_set():
                self._set(FeedState.RUNNING)
                self._deliver(frame)

    def _set(self, state: FeedState, problem: str = "") -> None:
        self._status = FeedStatus(state, problem, self._source.dropped)
