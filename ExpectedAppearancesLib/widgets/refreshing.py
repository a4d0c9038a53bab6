"""Widgets that are refreshed many times a second: texts, progress, and changes that nobody is told of."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator


def set_text(widget, text: str) -> None:
    """Set it only where it differs: a widget repaints, and lays out its panel, whether the text is new or not."""
    if widget.text != text:
        widget.text = text


def set_percent(bar, percent: int) -> None:
    """Let a progress bar be painted with what else changes.

    Left to itself QProgressBar paints whenever its value changes, before the setter returns, and with it Qt shows the
    whole window, 3D views and all: 40 ms in the midst of a refresh.
    """
    if bar.value != percent:
        bar.updatesEnabled = False
        bar.value = percent
        bar.updatesEnabled = True


@contextlib.contextmanager
def quiet(*widgets) -> Iterator[None]:
    """Within the block the widgets tell nobody that they changed."""
    before = [widget.blockSignals(True) for widget in widgets]
    try:
        yield
    finally:
        for widget, blocked in zip(widgets, before):
            widget.blockSignals(blocked)
