"""What a session reads before its first frame, in a thread of its own: it takes longer than a GUI may wait."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ..case.case import Case
from ..errors import ExpectedAppearancesError
from ..registration.poses_file import check_vessels
from .choice import Choice, OpenedSource, open_source
from .estimator import OpenedModel, open_model
from .overlay import OverlayMaker
from .steady import check_can_steady


@dataclass(frozen=True)
class Loaded:
    """model: None where the poses come from a file."""

    source: OpenedSource
    case: Case
    overlays: OverlayMaker
    model: OpenedModel | None


def load(
    choice: Choice, case: Case | None = None, overlays: OverlayMaker | None = None, model: OpenedModel | None = None
) -> Loaded:
    """Read what was chosen, but for what is given. Raises InputError with what is wrong."""
    opened = Case.open(choice.case_path)
    source = open_source(choice, opened.camera)
    if not choice.needs_model:
        check_vessels(Path(choice.path), opened.vessels_sha256)
    if case is None or overlays is None or _inputs(opened) != _inputs(case):  # made again in the same folder
        case = opened
        case.vessels, case.cortex  # noqa: B018 - read now, so that what is wrong with them is said now
        overlays = OverlayMaker(case.vessels)
    if not choice.needs_model:
        model = None
    elif model is None:
        model = open_model(case)
    if choice.steady:
        check_can_steady(model.estimator if model else None, case.model_folder)
    return Loaded(source, case, overlays, model)


def _inputs(case: Case) -> tuple:
    return case.space, case.manifest["inputs"]


class Loading:
    """Runs `read` in a thread. Whoever loses interest just forgets this object: the thread ends by itself."""

    def __init__(self, read: Callable[[], Loaded]):
        self._read, self._done = read, threading.Event()
        self._loaded: Loaded | None = None
        self.problem = ""
        threading.Thread(target=self._run, name="ExpectedAppearances loading", daemon=True).start()

    def done(self, wait_s: float = 0.0) -> bool:
        """Whether it has ended, well or with a `problem`. wait_s: up to this long, in which the thread can run."""
        return self._done.wait(wait_s)

    def take(self) -> Loaded | None:
        """What was read; None where there was a problem."""
        return self._loaded

    def _run(self) -> None:
        try:
            self._loaded = self._read()
        except ExpectedAppearancesError as error:
            self.problem = str(error)
        except BaseException as error:
            logging.getLogger(__name__).exception("A session could not be started")
            self.problem = f"{type(error).__name__}: {error}"
        finally:
            self._done.set()
