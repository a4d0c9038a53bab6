"""What a run is doing, and what a panel may offer meanwhile. Nothing here starts, reads or draws anything."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path


class RunState(Enum):
    IDLE = "idle"
    PREPARING = "preparing"  # started, has not said yet how far it is
    RUNNING = "running"
    CANCELLING = "cancelling"
    FAILED = "failed"
    CANCELLED = "cancelled"
    DONE = "done"

    @property
    def active(self) -> bool:
        """A process is there."""
        return self in (RunState.PREPARING, RunState.RUNNING, RunState.CANCELLING)


@dataclass(frozen=True)
class RunStatus:
    """fraction: 0..1. exit_code: None while it runs, negative for a signal, None also when nobody could know it.
    problem: in the user's words, '' if none. values: the newest figures that the run has told, such as step, loss,
    validation_add_mm (train) or image, the newest one's path, and images (synthesize)."""

    state: RunState
    fraction: float = 0.0
    message: str = ""
    seconds_left: float | None = None
    exit_code: int | None = None
    problem: str = ""
    log_path: Path | None = None
    values: dict = field(default_factory=dict)


@dataclass(frozen=True)
class Controls:
    """For each control why it is disabled, '' where it is enabled; `action` is what starting means."""

    start: str
    cancel: str
    settings: str
    action: str  # "start", "continue" (a beginning is kept) or "again" (a finished result is there)


NOTHING_RUNS = "Nothing is running."
GOES_ON = "A run is going on; cancel it first."
BEING_ENDED = "The run is being ended; wait a moment."


def controls(state: RunState, problem: str = "", unfinished: bool = False, finished: bool = False) -> Controls:
    """State -> what is enabled.

    problem: why no run can begin ('' if nothing is in the way). unfinished: the case holds the beginning of a result;
    finished: it holds all of it.
    """
    if state is RunState.CANCELLING:
        return Controls(BEING_ENDED, BEING_ENDED, BEING_ENDED, "continue")
    if state.active:
        return Controls(GOES_ON, "", GOES_ON, "continue")
    if unfinished or state in (RunState.FAILED, RunState.CANCELLED):
        action = "continue"
    else:
        action = "again" if finished else "start"
    return Controls(problem, NOTHING_RUNS, "", action)
