"""One live registration: a case, its model and a source, from frames to what may be shown. No thread of the GUI waits.

The owner calls `tick` from its own thread, many times a second, and draws what that returns; everything else happens
in the session's two threads. A frame, its pose and its overlay travel as one object and are never mixed.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..case.case import Case
from ..errors import ExpectedAppearancesError
from ..geometry.camera import Camera
from .estimator import Estimator
from .feed import Feed, FeedState, FeedStatus
from .frames import FramePreparation, FrameSettings, LiveFrame
from .overlay import Overlay, OverlayMaker
from .sources import Source
from .steady import Steadied, Steadying, can_steady
from .trust import Shown, Sight, Verdict, judge
from .worker import NewestWins, WorkerCounts

if TYPE_CHECKING:
    from ..registration.predictor import Prediction


@dataclass(frozen=True, eq=False)
class LiveResult:
    """One frame with all that belongs to it.

    image_rgb, camera: as prepared, without distortion; None when the frame could not be used, and problem says why.
    overlay: None unless the pose is accepted and in view. done_s: when it was ready (monotonic). steadied: what the
    frames before it make of its pose; None where each frame stands for itself.
    """

    frame: LiveFrame
    case_key: str
    image_rgb: np.ndarray | None = None
    camera: Camera | None = None
    prediction: Prediction | None = None
    overlay: Overlay | None = None
    problem: str = ""
    done_s: float = math.nan
    steadied: Steadied | None = None

    @property
    def camera_from_world(self) -> np.ndarray | None:
        """The pose that is drawn if any is: the filtered one where poses are steadied, else the frame's own."""
        if self.steadied is not None:
            return self.steadied.camera_from_world
        return self.prediction.camera_from_world if self.prediction else None

    @property
    def accepted(self) -> bool:
        return self.overlay is not None

    @property
    def latency_ms(self) -> float:
        """From the frame's arrival to its overlay, waiting included."""
        return (self.done_s - self.frame.taken_s) * 1000

    def shown(self) -> Shown:
        confidence = self.prediction.confidence if self.prediction else 0.0
        view = self.steadied.view if self.steadied else None
        return Shown(self.frame.taken_s, self.case_key, self.accepted, confidence, self.problem, view)


@dataclass(frozen=True)
class Update:
    """What a tick found: a result that was not seen before (or None), and what may be shown now."""

    new: LiveResult | None
    shown: LiveResult | None
    verdict: Verdict
    feed: FeedStatus
    counts: WorkerCounts

    @property
    def dropped(self) -> int:
        """Frames that came and were never shown."""
        return self.feed.dropped + self.counts.dropped + self.counts.unseen


class LiveSession:
    """Registers frames of one case. Start it, feed it (`start`, or `push` for frames from the scene), tick it, stop it.

    camera: of the frames as they come; the case's if None. stale_s: age from which a frame is not trusted. overlays:
    of the case, where they were prepared before. steady: whether poses are filtered over time; not those of single
    steps, of files, and of models without covariance.
    """

    def __init__(
        self,
        case: Case,
        estimator: Estimator | None,
        camera: Camera | None = None,
        settings: FrameSettings | None = None,
        stale_s: float = 0.5,
        clock: Callable[[], float] = time.monotonic,
        overlays: OverlayMaker | None = None,
    ):
        self.case_key = case.vessels_sha256
        self.stale_s, self.steady = stale_s, False
        self._clock, self._estimator = clock, estimator
        self._steadying: Steadying | None = None
        self._preparation = FramePreparation(camera or case.camera, settings)
        self._overlays = overlays or OverlayMaker(case.vessels)
        self._worker: NewestWins[LiveFrame, LiveResult] = NewestWins(self._register)
        self._feed: Feed | None = None
        self._shown: LiveResult | None = None
        self._running = self._frozen = self._single = False
        self._outside = FeedStatus(FeedState.RUNNING)

    @property
    def running(self) -> bool:
        return self._running

    @property
    def frozen(self) -> bool:
        return self._frozen

    def start(self, source: Source | None = None, single: bool = False) -> None:
        """Begin with a source, or without one when frames are pushed. single: freeze at the first frame."""
        self._running, self._single, self._frozen = True, single, False
        # Now and then Python looks through all objects for some that can go: 50 ms in 3D Slicer, on whatever thread.
        # Those that are there already need no look meanwhile.
        gc.freeze()
        if source is not None:
            self._feed = Feed(source, self.push)
            self._feed.start()

    def push(self, frame: LiveFrame) -> None:
        """Give a frame, from any thread; it waits at most for the frame in flight."""
        if self._running and not self._frozen:
            if self._single and self._feed:
                self._feed.hold(True)  # the frame after this one is for the next step
            self._worker.submit(frame)

    def say_source(self, status: FeedStatus) -> None:
        """What is known of a source whose frames are pushed."""
        self._outside = status

    def freeze(self) -> None:
        """Hold the frame that is shown, with its overlay; frames that come meanwhile are not looked at."""
        if self._shown is not None:
            self._frozen = True
            self._hold_source(True)
            self._worker.forget()

    def resume(self) -> None:
        self._worker.forget()  # a frame that came just as the one before was held: it is old by now
        self._frozen = self._single = False
        self._hold_source(False)

    def next_frame(self) -> None:
        """Register one more frame, then hold again; of files and videos it is the very next one, unless they came
        only now."""
        self._worker.forget()
        self._frozen, self._single = False, True
        self._hold_source(False)

    def tick(self, wait_s: float = 0.0) -> Update:
        """Take what is new and judge it. wait_s: up to this long, which lets the session's threads run meanwhile."""
        new = None if self._frozen else self._worker.take(wait_s)
        if new is not None:
            self._shown = new
            if self._single:
                self.freeze()
        feed = self._feed.status if self._feed else self._outside
        failure = self._worker.failure
        verdict = judge(
            self._shown.shown() if self._shown else None,
            self._clock(),
            self.case_key,
            self.stale_s,
            self._running,
            self._frozen,
            feed.state,
            feed.problem,
            f"{type(failure).__name__}: {failure}" if failure else "",
        )
        if feed.state is FeedState.ENDED and verdict.sight is Sight.STALE and not verdict.detail:
            verdict = replace(verdict, detail="The last frame of the source was shown.")
        return Update(new, self._shown, verdict, feed, self._worker.counts)

    def stop(self) -> bool:
        """End both threads; nothing is shown any more. False when a driver hangs (its thread then ends by itself)."""
        self._running = self._frozen = False
        gc.unfreeze()
        ended = self._feed.stop() if self._feed else True
        self._feed, self._shown = None, None
        return self._worker.stop() and ended

    def _hold_source(self, holding: bool) -> None:
        if self._feed:
            self._feed.hold(holding)

    def _register(self, frame: LiveFrame) -> LiveResult:
        """In the worker's thread: everything that costs time."""
        image = camera = prediction = overlay = steadied = None
        problem = ""
        try:
            image, camera = self._preparation.prepare(frame.image_rgb)
            prediction = frame.given
            if prediction is None and self._estimator is not None:
                prediction = self._estimator.predict(image, camera)
            steadied = self._steadied(frame, prediction)
            pose = prediction.camera_from_world if prediction is not None and prediction.accepted else None
            if steadied is not None:
                pose = steadied.camera_from_world
            if pose is not None:
                overlay = self._overlays.make(camera, pose)
        except ExpectedAppearancesError as error:
            problem, prediction, overlay = str(error), None, None
            steadied = self._steadied(frame, None)
        bare = replace(frame, image_rgb=np.empty((0, 0, 3), np.uint8)) if image is not None else frame
        return LiveResult(bare, self.case_key, image, camera, prediction, overlay, problem, self._clock(), steadied)

    def _steadied(self, frame: LiveFrame, prediction: Prediction | None) -> Steadied | None:
        """In the worker's thread, which alone touches the filter."""
        stands_alone = self._single or frame.given is not None or not math.isfinite(frame.taken_s)
        if not self.steady or stands_alone or not can_steady(self._estimator):
            self._steadying = None
            return None
        if self._steadying is None:
            self._steadying = Steadying(self._estimator.encoding.centre_world_mm)
        return self._steadying.update(frame.taken_s, prediction)
