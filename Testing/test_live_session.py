"""The live session without MRML: the newest-frame worker, trust, and what the panel needs to load."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from ExpectedAppearancesLib.live.feed import FeedState
from ExpectedAppearancesLib.live.steady import View
from ExpectedAppearancesLib.live.trust import Controls, Shown, Sight, controls, judge
from ExpectedAppearancesLib.live.worker import NewestWins


def within(seconds, condition):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(0.002)
    raise AssertionError("did not happen in time")


class Slow:
    """Work that goes on for as long as the test wants, and notices two at once."""

    def __init__(self):
        self.go, self.now, self.most, self.seen = threading.Semaphore(0), 0, 0, []

    def __call__(self, task):
        self.now += 1
        self.most = max(self.most, self.now)
        assert self.go.acquire(timeout=10)
        self.seen.append(task)
        self.now -= 1
        return task


def test_newest_wins_older_are_dropped_and_counted_and_one_is_in_flight():
    slow = Slow()
    worker = NewestWins(slow)
    worker.submit(0)
    within(5, lambda: slow.now == 1)
    for task in range(1, 10):
        worker.submit(task)
    assert worker.counts.dropped == 8 and worker.counts.in_flight == 1
    for _ in range(2):
        slow.go.release()
    within(5, lambda: worker.counts.done == 2)
    assert slow.seen == [0, 9] and slow.most == 1
    assert worker.take() == 9 and worker.take() is None
    counts = worker.counts
    assert (counts.submitted, counts.done, counts.dropped, counts.unseen, counts.in_flight) == (10, 2, 8, 1, 0)
    assert worker.stop()


def test_what_was_in_flight_when_it_was_forgotten_is_never_given_out():
    slow = Slow()
    worker = NewestWins(slow)
    worker.submit("old")
    within(5, lambda: slow.now == 1)
    worker.forget()
    slow.go.release()
    within(5, lambda: worker.counts.done == 1)
    assert worker.take() is None
    worker.submit("new")
    slow.go.release()
    assert worker.take(5) == "new"
    assert worker.stop()


def test_stopping_ends_the_thread_and_keeps_no_result():
    slow = Slow()
    worker = NewestWins(slow)
    worker.submit(1)
    within(5, lambda: slow.now == 1)
    assert not worker.stop(0.05)
    slow.go.release()
    assert worker.stop(5)
    assert worker.take() is None
    worker.submit(2)
    assert worker.counts.submitted == 1


def test_a_fault_in_the_work_is_kept_and_the_work_goes_on():
    def process(task):
        if task == 0:
            raise ZeroDivisionError("x")
        return task

    worker = NewestWins(process)
    worker.submit(0)
    within(5, lambda: worker.failure)
    worker.submit(1)
    assert worker.take(5) == 1
    assert worker.stop()


NOW, STALE = 100.0, 0.5


def shown(age=0.1, accepted=True, key="this", problem="", view=None):
    return Shown(NOW - age, key, accepted, 0.9, problem, view)


@pytest.mark.parametrize(
    "sight, arguments",
    [
        (Sight.FOLLOWING, {"shown": shown()}),
        (Sight.FOLLOWING, {"shown": shown(age=STALE)}),
        (Sight.STALE, {"shown": shown(age=STALE + 0.01)}),
        (Sight.STALE, {"shown": shown(age=float("nan"))}),
        (Sight.REFUSED, {"shown": shown(accepted=False)}),
        (Sight.FOLLOWING, {"shown": shown(view=View.FOLLOWING)}),
        (Sight.FOUND, {"shown": shown(view=View.FOUND)}),
        (Sight.REFUSED, {"shown": shown(accepted=False, view=View.DOUBTED)}),
        (Sight.REFUSED, {"shown": shown(accepted=False, view=View.FOUND)}),
        (Sight.VIEW_LOST, {"shown": shown(accepted=False, view=View.LOST)}),
        (Sight.STALE, {"shown": shown(age=2, view=View.FOUND)}),
        (Sight.FROZEN, {"shown": shown(view=View.FOUND), "frozen": True}),
        (Sight.OTHER_CASE, {"shown": shown(key="other")}),
        (Sight.OTHER_CASE, {"shown": shown(key="other"), "frozen": True}),
        (Sight.UNUSABLE, {"shown": shown(problem="blank", accepted=False)}),
        (Sight.UNUSABLE, {"shown": shown(problem="blank"), "frozen": True}),
        (Sight.WAITING, {"shown": None}),
        (Sight.LOST, {"shown": None, "feed": FeedState.LOST}),
        (Sight.LOST, {"shown": shown(age=2), "feed": FeedState.LOST}),
        (Sight.FOLLOWING, {"shown": shown(age=0.1), "feed": FeedState.LOST}),
        (Sight.STALE, {"shown": shown(age=2), "feed": FeedState.ENDED}),
        (Sight.FROZEN, {"shown": shown(age=500), "frozen": True}),
        (Sight.REFUSED, {"shown": shown(age=500, accepted=False), "frozen": True}),
        (Sight.IDLE, {"shown": shown(), "running": False}),
        (Sight.FAILED, {"shown": shown(), "failure": "ValueError: x"}),
        (Sight.FAILED, {"shown": shown(), "failure": "x", "frozen": True}),
    ],
)
def test_trust_as_a_table(sight, arguments):
    verdict = judge(**({"now_s": NOW, "case_key": "this", "stale_s": STALE, "running": True} | arguments))
    assert verdict.sight is sight
    assert verdict.shows_overlay == (sight in (Sight.FOLLOWING, Sight.FOUND, Sight.FROZEN))


def test_controls_as_a_table():
    def can(**values):
        usual = dict.fromkeys(("ready", "running", "frozen", "has_frame", "aligning", "recording"), False)
        return controls(**(usual | values))

    assert can() == Controls(True, False, False, False, False, False, False)
    assert can(ready=True) == Controls(True, True, False, False, True, False, False)
    assert can(ready=True, running=True) == Controls(False, False, True, False, True, True, False)
    live = {"ready": True, "running": True, "has_frame": True}
    assert can(**live) == Controls(False, False, True, True, True, True, False)
    assert can(**live, frozen=True).align and not can(**live).align
    assert not can(**live, frozen=True, aligning=True).freeze
    assert can(ready=True, running=True, frozen=True).freeze  # a single step found no picture: let it go on again
    assert not can(**live, recording=True).single


def test_the_panel_loads_without_what_it_offers_to_install():
    code = (
        "import sys\n"
        "for name in ('cv2', 'onnxruntime', 'torch', 'scipy', 'matplotlib', 'skimage'): sys.modules[name] = None\n"
        "import ExpectedAppearancesLib.mrml.live_controller, ExpectedAppearancesLib.live.choice\n"
    )
    root = str(Path(__file__).resolve().parents[1])
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_device_is_said_that_the_model_runs_on_in_fact(phantom, monkeypatch):
    from ExpectedAppearancesLib.live.estimator import PROVIDER_NAMES, open_model
    from ExpectedAppearancesLib.registration.predictor import Predictor

    opened = open_model(phantom.case)
    assert opened.device == PROVIDER_NAMES[opened.estimator._session.get_providers()[0]]
    for provider, device in (("CUDAExecutionProvider", "GPU (CUDA)"), ("CPUExecutionProvider", "CPU")):
        monkeypatch.setattr(Predictor, "provider", provider)
        assert open_model(phantom.case).device == device
