"""Progress as lines of text with the time left, readable in a terminal, a log and a pipe alike."""

from __future__ import annotations

import logging
import sys
import time

INTERVAL_S = 0.5


class Progress:
    """`progress(fraction, message)` prints at most two lines a second; `finish()` the last if held back."""

    def __init__(self, stream=None, clock=time.monotonic):
        self._stream = stream
        self._clock = clock
        self._printed_s = -INTERVAL_S
        self._held_back: str | None = None
        self._begin: tuple[float, float] | None = None  # time and fraction that the rate is measured from

    def __call__(self, fraction: float, message: str) -> None:
        fraction = min(max(float(fraction), 0.0), 1.0)
        now_s = self._clock()
        if self._begin is None or fraction < self._begin[1]:
            self._begin = (now_s, fraction)  # a resumed run begins beyond 0, a new stage falls back
        line = f"{100 * fraction:3.0f} %  {message}{self._time_left(now_s, fraction)}"
        if now_s - self._printed_s >= INTERVAL_S or fraction == 1.0:
            self._print(line, now_s)
        else:
            self._held_back = line

    def finish(self) -> None:
        if self._held_back is not None:
            self._print(self._held_back, self._clock())

    def _time_left(self, now_s: float, fraction: float) -> str:
        begin_s, begin_fraction = self._begin
        if fraction >= 1.0 or fraction <= begin_fraction or now_s - begin_s < 1.0:
            return ""
        return f" ({duration((now_s - begin_s) * (1.0 - fraction) / (fraction - begin_fraction))} left)"

    def _print(self, line: str, now_s: float) -> None:
        self._printed_s, self._held_back = now_s, None
        logging.getLogger("progress").info(line.strip())
        print(line, file=self._stream or sys.stderr, flush=True)


def duration(seconds: float) -> str:
    """'45 s', '3 min 20 s', '2 h 05 min'."""
    seconds = round(seconds)
    if seconds < 60:
        return f"{seconds} s"
    if seconds < 3600:
        return f"{seconds // 60} min {seconds % 60:02d} s"
    return f"{seconds // 3600} h {seconds % 3600 // 60:02d} min"
