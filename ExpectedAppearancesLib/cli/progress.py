"""Progress as lines of text with the time left, readable in a terminal, a log and a pipe alike."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import time

INTERVAL_S = 0.5


class Progress:
    """`progress(fraction, message)` prints at most two lines a second; `finish()` the last if held back."""

    def __init__(self, stream=None, clock=time.monotonic):
        self._stream = stream
        self._clock = clock
        self._created_s = clock()
        self._printed_s: float | None = None
        self._held_back: tuple[float, str, float | None] | None = None
        self._begin: tuple[float, float] | None = None  # time and fraction that the rate is measured from

    def __call__(self, fraction: float, message: str) -> None:
        fraction = min(max(float(fraction), 0.0), 1.0)
        now_s = self._clock()
        if self._begin is None or fraction < self._begin[1]:
            self._begin = (now_s, fraction)  # a resumed run begins beyond 0, a new stage falls back
        report = fraction, message, self._seconds_left(now_s, fraction)
        interval_s = self._interval_s(now_s - self._created_s)
        if self._printed_s is None or now_s - self._printed_s >= interval_s or fraction == 1.0:
            self._print(report, now_s)
        else:
            self._held_back = report

    def finish(self) -> None:
        if self._held_back is not None:
            self._print(self._held_back, self._clock())

    def _interval_s(self, _elapsed_s: float) -> float:
        return INTERVAL_S

    def _seconds_left(self, now_s: float, fraction: float) -> float | None:
        begin_s, begin_fraction = self._begin
        if fraction >= 1.0 or fraction <= begin_fraction or now_s - begin_s < 1.0:
            return None
        return (now_s - begin_s) * (1.0 - fraction) / (fraction - begin_fraction)

    def _print(self, report: tuple[float, str, float | None], now_s: float) -> None:
        self._printed_s, self._held_back = now_s, None
        logging.getLogger("progress").info(self._line(*report).strip())
        self._show(*report)

    def _line(self, fraction: float, message: str, seconds_left: float | None) -> str:
        left = "" if seconds_left is None else f" ({duration(seconds_left)} left)"
        return f"{100 * fraction:3.0f} %  {message}{left}"

    def _show(self, fraction: float, message: str, seconds_left: float | None) -> None:
        tell(self._line(fraction, message, seconds_left) + "\n", self._stream or sys.stderr)


def tell(text: str, stream) -> None:
    """Write at once. Who reads may be gone (`| head`, or the `tee` that Ctrl+C ended, too), or a disk be full: what is
    under way must not end in the middle for that."""
    try:
        print(text, end="", file=stream, flush=True)
    except OSError:
        with contextlib.suppress(OSError):  # what is still to be written is thrown away, also when Python ends
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, stream.fileno())
            os.close(nowhere)


def duration(seconds: float) -> str:
    """'45 s', '3 min 20 s', '2 h 05 min'."""
    seconds = round(seconds)
    if seconds < 60:
        return f"{seconds} s"
    if seconds < 3600:
        return f"{seconds // 60} min {seconds % 60:02d} s"
    return f"{seconds // 3600} h {seconds % 3600 // 60:02d} min"
