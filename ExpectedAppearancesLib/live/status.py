"""What a panel shows of a live session."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .session import LiveResult
from .trust import Sight, Verdict


@dataclass(frozen=True)
class Status:
    """What the panel shows. result: of the frame on the screen. device: what the model runs on, '' without one.

    problem: why the session that was asked for last could not be started, '' if it could.
    """

    verdict: Verdict
    result: LiveResult | None = None
    dropped: int = 0
    device: str = ""
    new: bool = False
    problem: str = ""

    @property
    def confidence(self) -> float | None:
        """Of the pose on the screen; None where there is none, where it is of the past, or its file did not say."""
        past = self.verdict.sight in (Sight.STALE, Sight.LOST)
        known = not past and self.result is not None and self.result.prediction is not None
        return self.result.prediction.confidence if known and np.isfinite(self.result.prediction.confidence) else None

    @property
    def latency_ms(self) -> float | None:
        if self.result is None or self.result.image_rgb is None or not np.isfinite(self.result.latency_ms):
            return None
        return self.result.latency_ms

    @property
    def age_s(self) -> float:
        """Of the picture on the screen; NaN where the newest frame gave none, and an earlier one is still there."""
        has_none = self.result is not None and self.result.image_rgb is None
        return math.nan if has_none else self.verdict.age_s


IDLE = Status(Verdict(Sight.IDLE))
