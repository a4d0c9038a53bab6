"""Small things that every section of the planning panel needs: reasons, timers, children."""

from __future__ import annotations

import html
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import qt

from ..interpreter import python_for_runs
from ..planning.steps import Step, StepState
from ..runs.environment import WITHOUT_WINDOW, environment_of
from ..runs.worker import Worker
from .drawing import DrawnInTurn
from .refreshing import set_text

# Readable on light and on dark themes.
COLOURS = {
    StepState.MISSING: "#8a8a8a",
    StepState.READY: "#2f7fd1",
    StepState.RUNNING: "#2f7fd1",
    StepState.STALE: "#d08a1d",
    StepState.DONE: "#3c9a4e",
}
SYMBOLS = {
    StepState.MISSING: "○",
    StepState.READY: "▶",
    StepState.RUNNING: "…",
    StepState.STALE: "!",
    StepState.DONE: "✓",
}
STEP_BUDGET_S = 0.015
POLL_ANSWER_MS = 15

_drawing = DrawnInTurn()


def allow(button, reason: str, otherwise: str) -> None:
    """Enable a button, or disable it and let its tool tip say why."""
    if button.enabled == bool(reason):
        button.enabled = not reason
    text = reason or otherwise
    if button.toolTip not in (text, f"<p>{text}</p>"):  # Slicer makes a paragraph of it, so that long ones are wrapped
        button.toolTip = text


def show_status(label, step: Step) -> None:
    text = html.escape(step.text).replace("\n", "<br>")
    text = f'<span style="color:{COLOURS[step.state]}"><b>{SYMBOLS[step.state]}</b></span> {text}'
    set_text(label, text)


def single_shot(milliseconds: int, action: Callable[[], None]):
    """A timer that calls `action` once, `milliseconds` after its last start()."""
    timer = qt.QTimer()
    timer.setSingleShot(True)
    timer.setInterval(milliseconds)
    timer.connect("timeout()", action)
    return timer


class Stepper:
    """Works a generator off in pieces of some 15 ms between the events of the GUI, without a thread: MRML has one."""

    def __init__(self) -> None:
        self._steps: Iterator | None = None
        self._timer = single_shot(1, self._work)

    def start(self, steps: Iterator) -> None:
        """Work on `steps`, in place of what was worked on before."""
        self.stop()
        self._steps = steps
        self._timer.start()

    def stop(self) -> None:
        """Give up what is not done yet; its `finally` is run."""
        steps, self._steps = self._steps, None
        self._timer.stop()
        if steps is not None and not getattr(steps, "gi_running", False):  # else a step itself has asked for the stop
            getattr(steps, "close", lambda: None)()

    def finish(self) -> None:
        """Do what is left at once."""
        while self._steps is not None:
            self._work()
        self._timer.stop()

    @property
    def working(self) -> bool:
        return self._steps is not None

    def _work(self) -> None:
        with _drawing:
            self._step()
        if self._steps is not None:
            self._timer.start()

    def _step(self) -> None:
        steps, end = self._steps, time.monotonic() + STEP_BUDGET_S
        while steps is not None and steps is self._steps and time.monotonic() < end:
            try:
                next(steps)
            except StopIteration:
                if steps is self._steps:
                    self._steps = None
                return
            except Exception:
                self._steps = None
                raise


class Asking:
    """Asks a Worker; `on_answer(question, answer)` is called from the GUI's event loop."""

    def __init__(self, task: str, on_answer: Callable[[dict, dict], None], urgent: bool = False):
        self._worker, self._on_answer = Worker(task, urgent), on_answer
        self._timer = qt.QTimer()
        self._timer.setInterval(POLL_ANSWER_MS)
        self._timer.connect("timeout()", self._look)

    @property
    def waiting(self) -> bool:
        return self._worker.waiting

    def ask(self, question: dict) -> None:
        """In place of what was asked before and is not answered yet."""
        self._worker.ask(question)
        self._timer.start()

    def forget(self) -> None:
        """No answer is wanted any more."""
        self._timer.stop()
        self._worker.forget()

    def stop(self) -> None:
        """Forget, and end the process."""
        self._timer.stop()
        self._worker.stop()

    def _look(self) -> None:
        answered = self._worker.poll()
        if not self._worker.waiting:
            self._timer.stop()
        if answered is not None:
            self._on_answer(*answered)


class Child:
    """A short helper process; `on_done(exit_code, output)` is called from the GUI's event loop when it has ended."""

    def __init__(self, command: list[str], on_done: Callable[[int, str], None], environment: dict | None = None):
        self._on_done = on_done
        self._folder = tempfile.TemporaryDirectory(prefix="expected-appearances-")
        self._output = Path(self._folder.name) / "output.txt"
        with open(self._output, "wb") as stream:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=subprocess.STDOUT,
                env=environment,
                **WITHOUT_WINDOW,
            )
        self._timer = qt.QTimer()
        self._timer.setInterval(50)
        self._timer.connect("timeout()", self._look)
        self._timer.start()

    @property
    def running(self) -> bool:
        return self._process is not None

    def stop(self) -> None:
        """End it without a word to on_done."""
        self._timer.stop()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None
            self._folder.cleanup()

    def _look(self) -> None:
        code = self._process.poll() if self._process else None
        if code is None:
            return
        self._timer.stop()
        self._process = None
        output = self._output.read_text(encoding="utf-8", errors="replace")
        self._folder.cleanup()
        self._on_done(code, output)


def library_command(*arguments: str) -> tuple[list[str], dict]:
    """Command line and environment of `python -m ARGUMENTS` with the Python that runs are started with."""
    return [python_for_runs(), "-m", *arguments], environment_of("helper")


def problems_in(output: str) -> list[str]:
    """The problems that a command of the headless program listed; its last lines where it listed none."""
    lines = [line for line in output.splitlines() if line.strip()]
    listed = [line[4:].strip() for line in lines if line.startswith("  - ")]
    return listed or lines[-3:] or ["It ended without a word."]
