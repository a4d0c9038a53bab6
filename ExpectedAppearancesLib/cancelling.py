"""Cancelling at a place where everything is consistent, rather than wherever a signal happens to arrive."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator

SIGNALS = ("SIGTERM", "SIGBREAK", "SIGINT")


class Cancelling:
    """asked: a signal has come. `carry_out` then does what the signal would have done."""

    def __init__(self) -> None:
        self.asked = False
        self._number = 0
        self._usual: dict[int, object] = {}

    def carry_out(self) -> None:
        """Raise what the usual handler raises (CancelledError, KeyboardInterrupt), or end the process without one."""
        handler = self._usual.get(self._number)
        if callable(handler):
            handler(self._number, None)
            return
        signal.signal(self._number, signal.SIG_DFL)
        os.kill(os.getpid(), self._number)

    def _take(self, number: int, _frame) -> None:
        self._number = number
        if self.asked:  # the second time it cannot wait
            self.carry_out()
        self.asked = True


@contextlib.contextmanager
def cancelling_waits() -> Iterator[Cancelling]:
    """Within the block, a signal that would cancel is only noted: ask `asked` where it suits, and `carry_out`.

    A second signal is obeyed at once; one that was not carried out is, at the end of the block. Outside the main
    thread, where nothing can be set, signals stay as they are.
    """
    cancelling = Cancelling()
    for name in SIGNALS:
        with contextlib.suppress(AttributeError, ValueError):
            number = getattr(signal, name)
            if signal.getsignal(number) is not signal.SIG_IGN:
                cancelling._usual[number] = signal.signal(number, cancelling._take)
    try:
        yield cancelling
    finally:
        for number, handler in cancelling._usual.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)
    if cancelling.asked:
        cancelling.carry_out()
