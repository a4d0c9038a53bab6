"""Start, progress, time left and cancel of one kind of run, and what becomes of it when things are closed."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import qt
from slicer.i18n import tr as _

from ..errors import ExpectedAppearancesError
from ..runs.record import refuse_if_occupied
from ..runs.runner import Run
from ..runs.state import RunState, RunStatus, controls
from .planning_qt import allow
from .refreshing import set_percent, set_text

POLL_MS = 500
START_TEXTS = {"start": "Start", "continue": "Continue", "again": "Make again"}
# Why nothing else can be started while a run of this kind goes on: all of them work on the same files.
GOING_ON = {
    "render": "Label maps are being drawn; wait until they are ready, or cancel that first.",
    "synthesize": "Expected appearances are being made; wait until they are ready, or cancel that first.",
    "train": "The model is being trained; wait until it is ready, or cancel that first.",
    "study": "A study is going on; wait until it is ready, or cancel it first.",
}


class RunWatch:
    """The run of one kind in the case that is open: polled, and found again when the case is opened again."""

    def __init__(self, kind: str, on_change: Callable[[RunStatus], None]):
        self.kind = kind
        self.status = RunStatus(RunState.IDLE)
        self.run: Run | None = None
        self._on_change = on_change
        self._timer = qt.QTimer()
        self._timer.setInterval(POLL_MS)
        self._timer.connect("timeout()", self.poll)

    @property
    def active(self) -> bool:
        return self.run is not None and self.status.state.active

    def follow(self, case_folder: str) -> None:
        """Watch what goes on in this case, '' for none; a run of the case before is let go."""
        self._timer.stop()
        self.run, self.status = None, RunStatus(RunState.IDLE)
        if case_folder:
            self.run = Run.find(case_folder, self.kind)
        if self.run is not None:
            self._watch()

    def start(self, case_folder: str, arguments: list[str], environment: dict[str, str] | None = None) -> None:
        """Raises ExpectedAppearancesError when it cannot be started. environment: added for the run alone."""
        self.run = Run.start(self.kind, case_folder, arguments, environment=environment)
        logging.info("Expected Appearances: %s started, log %s", self.kind, self.run.log_path)
        self._watch()

    def cancel(self) -> None:
        if self.run is not None:
            self.run.cancel()
            self.poll()

    def forget(self) -> None:
        """Stop watching; the run itself is left as it is."""
        self._timer.stop()
        self.run = None

    def poll(self) -> None:
        if self.run is None:
            return
        self.status = self.run.poll()
        if not self.status.state.active:
            self._timer.stop()
        self._on_change(self.status)

    def _watch(self) -> None:
        self._timer.start()
        self.poll()


class RunControls:
    """Start and cancel button, progress bar and line of text, kept up to date with a RunWatch."""

    def __init__(
        self,
        watch: RunWatch,
        start_button,
        cancel_button,
        bar,
        label,
        start_hint: str,
        texts: dict[str, str] = START_TEXTS,
    ):
        self.watch = watch
        self._start, self._cancel, self._bar, self._label = start_button, cancel_button, bar, label
        self._start_hint, self._texts = start_hint, texts

    def refresh(self, problem: str, unfinished: bool, finished: bool, said: str) -> None:
        """problem, unfinished, finished: see `controls`. said: what the section's status line says."""
        status = self.watch.status
        state = controls(status.state, problem, unfinished, finished)
        allow(self._start, state.start, self._start_hint)
        allow(self._cancel, state.cancel, _("End the run. What is finished is kept."))
        set_text(self._start, _(self._texts[state.action]))
        self._bar.visible = self.watch.active
        set_percent(self._bar, round(100 * status.fraction))
        set_text(self._label, _line(status) or (problem if problem != said else ""))
        self._label.visible = bool(self._label.text)


def _line(status: RunStatus) -> str:
    """What the run is doing, in a line or two."""
    if status.problem:
        return status.problem
    if status.state is RunState.PREPARING:
        return _("Starting…")
    if status.state is RunState.CANCELLING:
        return _("Being ended…")
    # The message ends with the time left. What is done, the section says.
    return "" if status.state in (RunState.IDLE, RunState.DONE) else status.message


def in_the_way(panel, kind: str) -> str:
    """Why a run of this kind cannot begin because of another one, '' if none is going on."""
    return next((_(text) for other, text in GOING_ON.items() if other != kind and panel.runs[other].active), "")


def started(panel, watch: RunWatch, arguments: list[str], environment: dict[str, str] | None = None) -> bool:
    """Start a run of the open case, or tell the user why it could not be."""
    import slicer

    try:
        # Also those of another Slicer or a shell, which the panel does not watch.
        refuse_if_occupied(Path(panel.parameters.casePath), [kind for kind in GOING_ON if kind != watch.kind])
        watch.start(panel.parameters.casePath, arguments, environment)
    except ExpectedAppearancesError as error:
        slicer.util.errorDisplay(str(error), windowTitle=_("Not started"))
        return False
    panel.refresh_soon()
    return True
