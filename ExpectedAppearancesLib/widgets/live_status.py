"""The top of the live panel: one coloured field that says whether to trust, and the four numbers behind it."""

from __future__ import annotations

import time

from slicer.i18n import tr as _

from ..live.status import Status
from . import live_texts
from .refreshing import set_percent, set_text

NUMBERS_S = 0.15  # the numbers are read, not watched: each new text lays out the panel


class StatusSection:
    def __init__(self, ui):
        self._ui = ui
        self._said: tuple | None = None
        self._numbers_due_s = 0.0
        for name in ("confidence", "latency", "age", "dropped"):
            getattr(ui, f"{name}Label").setStyleSheet("font-size: 15pt; font-weight: bold;")

    def show(self, status: Status) -> None:
        """Cheap enough for every tick: widgets are touched only where their text changes."""
        sight, ui = status.verdict.sight, self._ui
        said = (sight, live_texts.headline(status), live_texts.detail(status))
        if said != self._said:
            self._said = said
            colour = live_texts.css(live_texts.COLOURS[sight])
            ui.statusFrame.setStyleSheet(
                f"#statusFrame {{ background: {colour}; border-radius: 6px; }} QLabel {{ color: white; }}"
            )
            ui.headlineLabel.setStyleSheet("font-size: 17pt; font-weight: bold;")
            ui.headlineLabel.text = said[1]
            ui.detailLabel.text = said[2]
        elif time.monotonic() < self._numbers_due_s:
            return
        self._numbers_due_s = time.monotonic() + NUMBERS_S
        confidence = status.confidence
        set_text(ui.confidenceLabel, "–" if confidence is None else f"{round(100 * confidence)} %")
        set_percent(ui.confidenceBar, 0 if confidence is None else round(100 * confidence))
        latency_ms = status.latency_ms
        set_text(ui.latencyLabel, "–" if latency_ms is None else f"{latency_ms:.0f} ms")
        set_text(ui.ageLabel, live_texts.age(status.age_s))
        set_text(ui.droppedLabel, str(status.dropped))
        set_text(ui.modelLabel, self._origin(status))

    @staticmethod
    def _origin(status: Status) -> str:
        """Where the poses come from."""
        if status.device:
            return _("The model runs on: {device}").format(device=status.device)
        return _("The poses were made before; no model runs.") if status.result is not None else ""
