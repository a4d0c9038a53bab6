"""Views that are drawn once all that belongs together is there, and not all of them in one call."""

from __future__ import annotations

import contextlib

import qt
import slicer


class DrawnInTurn:
    """Context, also within itself, in which no view is drawn. After it each view is, in an event of its own.

    A busy Slicer draws a view within the call that changes a node; a few such changes, or a few views, and the GUI is
    held up: without a graphics card for 70 ms a frame.
    """

    def __init__(self):
        self._depth = 0
        self._waiting: list = []

    def __enter__(self) -> None:
        self._depth += 1
        slicer.app.pauseRender()

    def __exit__(self, *_error) -> None:
        self._depth -= 1
        if self._depth == 0:
            begins = not self._waiting
            for view in _visible_views():
                if view not in self._waiting:
                    view.pauseRender()
                    self._waiting.append(view)
            if begins and self._waiting:
                qt.QTimer.singleShot(0, self._draw_next)
        slicer.app.resumeRender()

    def _draw_next(self) -> None:
        try:
            with contextlib.suppress(ValueError):  # the view is gone
                self._waiting.pop(0).resumeRender()
        finally:
            if self._waiting:
                qt.QTimer.singleShot(0, self._draw_next)


def _visible_views() -> list:
    """Slice views first: they show the frame."""
    manager = slicer.app.layoutManager()
    if manager is None:
        return []
    views = [manager.sliceWidget(name).sliceView() for name in manager.sliceViewNames()]
    views += [manager.threeDWidget(i).threeDView() for i in range(manager.threeDViewCount)]
    return [view for view in views if view.visible]
