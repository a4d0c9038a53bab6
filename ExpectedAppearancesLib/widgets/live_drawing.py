"""Views that are drawn once all that belongs together is there, and not all of them in one call."""

from __future__ import annotations

import contextlib

import qt
import slicer


class DrawnInTurn:
    """Context, also within itself, in which no view is drawn. After it the slice views are drawn at once, and each 3D
    view in an event of its own: together they hold the GUI up, without a graphics card for 70 ms a frame."""

    def __init__(self):
        self._depth = 0
        self._waiting: list = []
        self._timer = qt.QTimer()
        self._timer.setSingleShot(True)
        self._timer.connect("timeout()", self._draw_next)

    def __enter__(self) -> None:
        self._depth += 1
        slicer.app.pauseRender()

    def __exit__(self, *_error) -> None:
        self._depth -= 1
        if self._depth == 0:
            for view in _three_d_views():
                if view not in self._waiting:
                    view.pauseRender()
                    self._waiting.append(view)
            if self._waiting:
                self._timer.start()
        slicer.app.resumeRender()

    def finish(self) -> None:
        """Draw what still waits for its turn: a view that is left paused is never drawn again."""
        self._timer.stop()
        while self._waiting:
            self._draw_next()

    def _draw_next(self) -> None:
        if self._waiting:
            with contextlib.suppress(ValueError):  # the view is gone
                self._waiting.pop(0).resumeRender()
        if self._waiting:
            self._timer.start()


def _three_d_views() -> list:
    manager = slicer.app.layoutManager()
    return [manager.threeDWidget(i).threeDView() for i in range(manager.threeDViewCount)] if manager else []
