"""What the live panel says, and in which colour. Green means one thing only: this may be trusted."""

from __future__ import annotations

import functools
import math

from slicer.i18n import tr as _

from ..live.status import Status
from ..live.trust import Sight

GREEN, AMBER, RED, GREY = (0.05, 0.50, 0.20), (0.72, 0.45, 0.0), (0.75, 0.08, 0.10), (0.35, 0.37, 0.40)
COLOURS = dict.fromkeys(Sight, RED) | {
    Sight.FOLLOWING: GREEN,
    Sight.FOUND: GREEN,
    Sight.FROZEN: AMBER,
    Sight.IDLE: GREY,
    Sight.LOADING: GREY,
    Sight.WAITING: GREY,
}


# Translated once: asking for a translation takes longer than a tick may.
@functools.cache
def _headlines() -> dict[Sight, str]:
    return {
        Sight.IDLE: _("NOT LIVE"),
        Sight.LOADING: _("LOADING THE CASE"),
        Sight.WAITING: _("WAITING FOR A PICTURE"),
        Sight.LOST: _("NO PICTURE: source lost"),
        Sight.UNUSABLE: _("NO PICTURE: frame unusable"),
        Sight.OTHER_CASE: _("NO OVERLAY: another patient's case"),
        Sight.FAILED: _("NO OVERLAY: registration failed"),
        Sight.STALE: _("NO OVERLAY: frame too old"),
        Sight.REFUSED: _("NO OVERLAY: pose refused"),
        Sight.VIEW_LOST: _("NO OVERLAY: view lost"),
        Sight.FROZEN: _("FROZEN: not live"),
        Sight.FOLLOWING: _("FOLLOWING"),
        Sight.FOUND: _("FOLLOWING: found again"),
    }


@functools.cache
def _details() -> dict[Sight, str]:
    return {
        Sight.IDLE: _("Choose a case and a source, then press Start."),
        Sight.LOADING: _("The case and its model are being read."),
        Sight.WAITING: _("Started; no frame has come yet."),
        Sight.LOST: _("The source gives no frames; it is tried again every second."),
        Sight.OTHER_CASE: _("These frames were registered to the vessels of another case. Open that case."),
        Sight.STALE: _("No new frame has come in time. The picture on the screen is not the present."),
        Sight.REFUSED: _("The vessels were not found with enough confidence. Clear the view, or focus again."),
        Sight.VIEW_LOST: _("No overlay until three frames within a second agree on where the vessels are."),
        Sight.FROZEN: _("The overlay belongs to this frame. Press Freeze again to go on."),
        Sight.FOLLOWING: _("The overlay belongs to the newest frame. Not for clinical use."),
        Sight.FOUND: _("The view was lost and is found again. Compare the overlay with what you see."),
    }


def headline(status: Status) -> str:
    """A few words that can be read across the room; also drawn over the frame."""
    return _headlines()[status.verdict.sight]


def detail(status: Status) -> str:
    """What to do about it, or what it means; one or two lines."""
    verdict = status.verdict
    if verdict.sight is Sight.FAILED:
        return _("{error}. Stop and start again; if it returns, send Slicer's log.").format(error=verdict.detail)
    if verdict.detail:
        return verdict.detail
    recorded = status.result is not None and status.result.image_rgb is None
    if recorded and verdict.sight is Sight.FROZEN:
        return _("A recorded frame, with the pose that it had.")
    if recorded and verdict.sight is Sight.REFUSED:
        return _("A recorded frame, not live: its pose was refused.")
    if verdict.sight is Sight.REFUSED and _disagrees(status.result):
        return _("This frame's pose does not fit those before it, so it is not shown.")
    return _details().get(verdict.sight, "")


def _disagrees(result) -> bool:
    """Whether the pose was good enough by itself, and left out where poses are steadied."""
    return result is not None and result.steadied is not None and bool(result.prediction) and result.prediction.accepted


def banner(status: Status) -> str:
    """Over the frame: the headline, with the number that stands behind it."""
    text = headline(status)
    if status.verdict.sight in (Sight.FOLLOWING, Sight.FOUND) and status.confidence is not None:
        return _("{headline}  {percent} %").format(headline=text, percent=round(100 * status.confidence))
    if status.verdict.sight is Sight.STALE and 1 <= status.verdict.age_s < math.inf:
        # In whole seconds: the views are drawn again with each new text.
        return _("{headline} ({age})").format(headline=text, age=age(math.floor(status.verdict.age_s)))
    return text


def age(seconds: float) -> str:
    """A duration: ms below a second, then s, then minutes."""
    if not math.isfinite(seconds):
        return "–"
    if seconds < 1:
        return _("{ms} ms").format(ms=round(seconds * 1000))
    if seconds < 120:
        return _("{s} s").format(s=seconds if isinstance(seconds, int) else f"{seconds:.1f}")
    return _("{min} min").format(min=round(seconds / 60))


def css(rgb: tuple[float, float, float]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*(round(255 * value) for value in rgb))
