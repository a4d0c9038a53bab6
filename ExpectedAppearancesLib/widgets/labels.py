"""Texts on widgets that are refreshed many times a second."""

from __future__ import annotations


def set_text(widget, text: str) -> None:
    """Set it only where it differs: a widget repaints, and lays out its panel, whether the text is new or not."""
    if widget.text != text:
        widget.text = text
