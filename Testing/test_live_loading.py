"""Start reads case and model in a thread: the GUI goes on, may stop or close meanwhile, and hears what is wrong."""

from __future__ import annotations

import shutil
import threading

import numpy as np
import pytest

from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.demo.phantom import make_phantom
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.live import loading
from ExpectedAppearancesLib.live.choice import Choice, SourceKind
from ExpectedAppearancesLib.live.recording import RecordedFrame, export_recording
from ExpectedAppearancesLib.live.trust import Sight
from ExpectedAppearancesLib.registration.predictor import Prediction

slicer = pytest.importorskip("slicer")

from live_cases import SMALL, choice_of, node_with, shown_pixels, wait_for  # noqa: E402
from mrml_views import new_application  # noqa: E402

from ExpectedAppearancesLib.mrml.live_controller import LiveController  # noqa: E402


class Gate:
    """Stands in for the reading of a model: nothing comes through before `open` is set, and `problem` may."""

    def __init__(self, model):
        self.model, self.problem = model, None
        self.open, self.threads = threading.Event(), []

    def __call__(self, _case):
        self.threads.append(threading.current_thread())
        assert self.open.wait(60)
        if self.problem is not None:
            raise self.problem
        return self.model


@pytest.fixture
def gate(monkeypatch, model):
    gate = Gate(model)
    monkeypatch.setattr(loading, "open_model", gate)
    yield gate
    gate.open.set()


@pytest.fixture
def started(gate, phantom, frames):
    """A controller that is loading, its scene, and how many nodes that had before."""
    scene, _logic = new_application()
    node_with(scene, frames[1][0])
    controller, before = LiveController(scene), scene.GetNumberOfNodes()
    controller.start(choice_of(phantom, stale_s=60))
    yield controller, scene, before
    controller.close()


def ended(gate) -> None:
    """Let the reading threads go on, and wait for them."""
    gate.open.set()
    for thread in gate.threads:
        thread.join(60)


def test_the_gui_goes_on_while_the_model_is_read(started, gate, frames):
    controller, scene, before = started
    for _ in range(3):
        status = controller.tick(0.01)
        assert status.verdict.sight is Sight.LOADING and not status.verdict.shows_overlay
        assert controller.loading and controller.running
    assert scene.GetNumberOfNodes() == before  # the thread has no business in the scene
    with pytest.raises(InputError, match="start the session first"):
        controller.start_recording()
    controller.freeze()
    controller.next_frame()
    gate.open.set()
    assert wait_for(controller, lambda s: s.new).result.accepted
    assert not controller.loading and controller.status.problem == ""
    assert gate.threads and threading.main_thread() not in gate.threads
    np.testing.assert_array_equal(shown_pixels(controller.live), frames[1][0])


@pytest.mark.parametrize("leave", [LiveController.stop, LiveController.forget_scene, LiveController.close])
def test_what_is_read_after_the_end_starts_nothing(started, gate, leave):
    controller, scene, before = started
    leave(controller)
    assert not controller.running and controller.status.verdict.sight is Sight.IDLE
    ended(gate)
    for _ in range(3):
        assert controller.tick(0.01).verdict.sight is Sight.IDLE
    assert not controller.running and scene.GetNumberOfNodes() == before


def test_the_last_start_counts(started, gate, phantom, model):
    controller, _scene, _before = started
    controller.start(choice_of(phantom, stale_s=60), single=True, model=model)
    assert wait_for(controller, lambda s: s.new).verdict.sight is Sight.FROZEN
    session = controller._session
    ended(gate)
    assert controller.tick(0.01).verdict.sight is Sight.FROZEN
    assert controller._session is session


@pytest.mark.parametrize("problem", [InputError("model.onnx: is damaged."), OSError("no such drive")])
def test_what_keeps_it_from_starting_is_said_and_the_next_start_works(started, gate, phantom, problem):
    controller, scene, before = started
    gate.problem = problem
    gate.open.set()
    status = wait_for(controller, lambda _s: not controller.loading)
    assert str(problem) in status.problem and status.verdict.sight is Sight.IDLE
    assert not controller.running and scene.GetNumberOfNodes() == before
    assert str(problem) in controller.tick().problem  # it stays until the next start
    gate.problem = None
    controller.start(choice_of(phantom, stale_s=60))
    assert controller.status.problem == ""
    assert wait_for(controller, lambda s: s.new).result.accepted


def test_what_is_wrong_with_the_case_is_said_too(started, phantom, tmp_path):
    controller, _scene, _before = started
    controller.start(choice_of(phantom, case_path=str(tmp_path / "none")))
    assert str(tmp_path / "none") in wait_for(controller, lambda _s: not controller.loading).problem
    controller.start(choice_of(phantom, camera_path=str(tmp_path / "camera.json")))
    assert "camera.json" in wait_for(controller, lambda _s: not controller.loading).problem


def test_poses_of_another_case_are_not_drawn_over_their_frames(started, gate, phantom, frames, tmp_path):
    """They are as sure as that case's own, and this one's vessels would lie anywhere."""
    controller, _scene, _before = started
    gate.open.set()
    for vessels_sha256, problem in (("0" * 64, "of another case"), (phantom.case.vessels_sha256, "")):
        recorded = RecordedFrame(0.0, "f", SMALL, Prediction(frames[0][0], True, 1.0, 0.0), frames[1][0])
        path = export_recording(tmp_path / vessels_sha256, [recorded], vessels_sha256)
        choice = Choice(kind=SourceKind.PATH, path=str(path), case_path=str(phantom.case.folder), stale_s=60)
        controller.start(choice)
        assert problem in wait_for(controller, lambda s: s.new or s.problem).problem
    assert controller.status.result.accepted


def test_a_volume_that_goes_while_the_model_is_read_is_waited_for(started, gate, frames):
    controller, scene, _before = started
    scene.RemoveNode(scene.GetFirstNodeByName("Stream"))
    gate.open.set()
    wait_for(controller, lambda _s: not controller.loading)
    node_with(scene, frames[1][2])
    wait_for(controller, lambda s: s.result is not None and s.result.frame.number > 0)
    np.testing.assert_array_equal(shown_pixels(controller.live), frames[1][2])


def test_a_case_that_was_made_again_in_its_folder_is_read_again(tmp_path, frames):
    """With another calibration, say: the one that was read before would give wrong poses without a word."""
    phantom = make_phantom(tmp_path / "case")
    scene, _logic = new_application()
    node_with(scene, frames[1][0])
    controller = LiveController(scene)
    controller.start(choice_of(phantom, stale_s=60))
    wait_for(controller, lambda s: s.new)
    first = controller.case
    controller.start(choice_of(phantom, stale_s=60))
    wait_for(controller, lambda s: s.new)
    assert controller.case is first
    shutil.rmtree(tmp_path / "case")
    make_phantom(tmp_path / "case", seed=1)
    controller.start(choice_of(phantom, stale_s=60))
    status = wait_for(controller, lambda s: s.new or s.problem)
    vessels_sha256 = Case.open(tmp_path / "case").vessels_sha256
    assert status.problem == "" and status.result.case_key == vessels_sha256 != first.vessels_sha256
    controller.close()
