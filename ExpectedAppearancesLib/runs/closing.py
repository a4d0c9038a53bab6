"""What becomes of runs when the scene, the module or 3D Slicer is closed: ended, or left going on, as the user chose.

Leaving the module ends nothing. Closing a scene or Slicer does what the user has set: ask, end or leave going on.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum

from .record import by_the_clock
from .runner import CANCEL_DEADLINE_S, SWEEP_DEADLINE_S, Run
from .state import RunState

WORDS = {
    "render": "Label maps are being drawn",
    "synthesize": "Expected appearances are being made",
    "train": "A model is being trained",
    "study": "A study is going on",
}


class OnClose(Enum):
    ASK = "ask"
    END = "end"
    DETACH = "detach"


def going_on(runs: Iterable[Run | None]) -> list[Run]:
    return [run for run in runs if run is not None and run.poll().state.active]


def question(runs: list[Run]) -> str:
    """What to ask the user about these runs."""
    named = "\n".join(
        f"- {WORDS.get(run.kind, run.kind)} in {run.case_folder}, since {by_the_clock(run.started)}" for run in runs
    )
    return (
        f"Work is going on in the background:\n{named}\n"
        "Let it go on? It is found again when the case is opened. If it is ended, what was finished is kept, and the "
        "next start goes on from there."
    )


def close_runs(runs: Iterable[Run | None], choice: OnClose) -> dict[Run, RunState]:
    """End or detach what is going on; returns the state that each such run was left in.

    With ASK, where nobody can be asked, the runs go on: nothing is lost then. Ending waits until the processes are
    gone, half a minute at most.
    """
    active = going_on(runs)
    # A run that is being cancelled already is not let go before its processes are gone.
    ending = [run for run in active if choice is OnClose.END or run.poll().state is RunState.CANCELLING]
    for run in ending:
        run.cancel()
    for run in active:
        if run not in ending:
            run.detach()
    return {
        run: run.wait(CANCEL_DEADLINE_S + SWEEP_DEADLINE_S).state if run in ending else run.poll().state
        for run in active
    }
