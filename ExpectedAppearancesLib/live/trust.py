"""Whether what is shown may be trusted: a pure function of what the session knows, and the one place that decides.

The overlay is shown in two cases only: the newest frame was registered and accepted, or the user froze such a frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from .feed import FeedState
from .steady import View


class Sight(Enum):
    """What the user is told, from nothing to trust."""

    IDLE = "idle"  # not started
    LOADING = "loading"  # case and model are being read
    WAITING = "waiting"  # started, no frame yet
    LOST = "lost"  # the source vanished
    UNUSABLE = "unusable"  # the frame is no picture, or does not fit the camera
    OTHER_CASE = "other case"  # registered to another patient's model
    FAILED = "failed"  # the registration itself ended with an error
    STALE = "stale"  # too old
    REFUSED = "refused"  # a pose that must not be believed, or none
    VIEW_LOST = "view lost"  # so for a while, where poses are steadied
    FROZEN = "frozen"  # accepted, but held by the user
    FOLLOWING = "following"  # accepted and new
    FOUND = "found again"  # the same, just after the view was lost


SHOWS_OVERLAY = frozenset({Sight.FOLLOWING, Sight.FOUND, Sight.FROZEN})


@dataclass(frozen=True)
class Shown:
    """The frame on the screen: when it was taken, and what registration said about it. view: None where poses are not
    steadied."""

    taken_s: float
    case_key: str
    accepted: bool
    confidence: float
    problem: str = ""
    view: View | None = None


@dataclass(frozen=True)
class Verdict:
    """sight; age_s: of the frame on the screen (NaN: none); detail: the problem in words, '' if there is none."""

    sight: Sight
    age_s: float = math.nan
    detail: str = ""

    @property
    def shows_overlay(self) -> bool:
        return self.sight in SHOWS_OVERLAY


def judge(
    shown: Shown | None,
    now_s: float,
    case_key: str,
    stale_s: float,
    running: bool,
    frozen: bool = False,
    feed: FeedState = FeedState.RUNNING,
    feed_problem: str = "",
    failure: str = "",
) -> Verdict:
    """What may be shown now. The strongest reason against showing wins; doubt never shows.

    shown: the frame on the screen. case_key: of the case that is open. stale_s: age from which a frame is too old.
    """
    age_s = math.nan if shown is None else now_s - shown.taken_s
    age_s = 0.0 if age_s < 0 else age_s  # NaN stays NaN: what has no time is not new
    if failure:
        return Verdict(Sight.FAILED, age_s, failure)
    if shown is not None and shown.case_key != case_key:
        return Verdict(Sight.OTHER_CASE, age_s)
    if not running:
        return Verdict(Sight.IDLE, age_s)
    if frozen and shown is not None:
        if shown.problem:
            return Verdict(Sight.UNUSABLE, age_s, shown.problem)
        return Verdict(Sight.FROZEN if shown.accepted else Sight.REFUSED, age_s)
    too_old = shown is None or not age_s <= stale_s
    if too_old and feed is FeedState.LOST:
        return Verdict(Sight.LOST, age_s, feed_problem)
    if shown is None:
        return Verdict(Sight.WAITING, age_s, feed_problem)
    if too_old:
        return Verdict(Sight.STALE, age_s, feed_problem)
    if shown.problem:
        return Verdict(Sight.UNUSABLE, age_s, shown.problem)
    if not shown.accepted:
        return Verdict(Sight.VIEW_LOST if shown.view is View.LOST else Sight.REFUSED, age_s)
    return Verdict(Sight.FOUND if shown.view is View.FOUND else Sight.FOLLOWING, age_s)


@dataclass(frozen=True)
class Controls:
    """Which controls of the panel can be used."""

    choose: bool
    start: bool
    stop: bool
    freeze: bool
    single: bool
    record: bool
    align: bool


def controls(ready: bool, running: bool, frozen: bool, has_frame: bool, aligning: bool, recording: bool) -> Controls:
    """From what the session does to what the user can do. ready: case, model and source are chosen and fit."""
    return Controls(
        choose=not running,
        start=ready and not running,
        stop=running,
        freeze=running and (has_frame or frozen) and not aligning,
        single=ready and not aligning and not recording,
        record=running and not aligning,
        align=running and frozen and has_frame,
    )
