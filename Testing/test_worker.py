"""The process that answers a panel's questions: the newest counts, and one that dies is said to have."""

from __future__ import annotations

import subprocess
import time

import cases
import numpy as np
import pytest

from ExpectedAppearancesLib.geometry.camera import Camera
from ExpectedAppearancesLib.masks import asked
from ExpectedAppearancesLib.masks.renderer import MaskRenderer
from ExpectedAppearancesLib.poses.craniotomy import disc_under_vessels
from ExpectedAppearancesLib.runs import worker as workers
from ExpectedAppearancesLib.runs.worker import Worker

CAMERA = Camera(64, 48, 120.0, 120.0, 31.5, 23.5)
AXIS = np.array([0.0, 0.0, 1.0])


def pose(distance_mm: float) -> np.ndarray:
    """From above, looking down."""
    result = np.diag([1.0, -1.0, -1.0, 1.0])
    result[2, 3] = distance_mm
    return result


@pytest.fixture
def worker():
    made = Worker("label maps")
    yield made
    made.stop()


@pytest.fixture
def folder(tmp_path):
    asked.write_meshes(tmp_path, cases.vessels(), cases.dome())
    return tmp_path


def questions(folder, count: int) -> list[dict]:
    return [asked.question(folder, CAMERA, AXIS, pose(60.0 + 5 * i)) | {"number": i} for i in range(count)]


def next_answer(worker) -> tuple[dict, dict]:
    end = time.monotonic() + 300
    while not (found := worker.poll()):
        assert time.monotonic() < end, "no answer"
        time.sleep(0.01)
    return found


def test_label_map_from_the_process_is_that_of_the_renderer(worker, folder, tmp_path_factory):
    worker.ask(questions(folder, 1)[0])
    labels = asked.label_map(next_answer(worker)[1]["answer"])
    with MaskRenderer(cases.vessels(), cases.dome(), CAMERA) as renderer:
        np.testing.assert_array_equal(labels, renderer.render(pose(60.0)))
    assert set(np.unique(labels)) >= {1, 2}
    # Other meshes, without a cortex, in another folder: nothing of the first is kept.
    bare = tmp_path_factory.mktemp("bare")
    asked.write_meshes(bare, cases.vessels(), None)
    worker.ask(questions(bare, 1)[0])
    labels = asked.label_map(next_answer(worker)[1]["answer"])
    with MaskRenderer(cases.vessels(), disc_under_vessels(cases.vessels(), AXIS), CAMERA) as renderer:
        np.testing.assert_array_equal(labels, renderer.render(pose(60.0)))


def test_only_the_newest_of_the_questions_that_wait_is_answered(worker, folder):
    first, dropped, newest = questions(folder, 3)
    for question in (first, dropped, newest):
        worker.ask(question)
    assert next_answer(worker)[0] is first
    assert worker.waiting
    question, answer = next_answer(worker)
    assert question is newest and "answer" in answer
    assert not worker.waiting and worker.poll() is None


def test_an_urgent_question_ends_the_work_on_an_older_one(folder):
    worker = Worker("label maps", urgent=True)
    older, newer = questions(folder, 2)
    try:
        worker.ask(older)
        process = worker._process
        worker.ask(newer)
        assert process.poll() is not None
        assert next_answer(worker)[0] is newer and not worker.waiting
    finally:
        worker.stop()


def test_a_process_that_ended_is_told_and_replaced(worker, folder):
    first, second, third = questions(folder, 3)
    worker.ask(first)
    worker._process.kill()
    question, answer = next_answer(worker)
    assert question is first and "label maps" in answer["failed"]
    worker.ask(second)
    assert next_answer(worker)[0] is second
    worker._process.kill()  # while nothing was asked
    worker._process.wait()
    worker.ask(third)
    question, answer = next_answer(worker)
    assert question is third and "answer" in answer


def test_a_process_that_cannot_be_started_is_told_too(worker, folder, monkeypatch):
    monkeypatch.setattr(workers, "python_for_runs", lambda: str(folder / "no python"))
    first, second = questions(folder, 2)
    worker.ask(first)
    assert worker.waiting
    assert set(next_answer(worker)[1]) == {"failed"}
    monkeypatch.undo()
    worker.ask(second)
    assert "answer" in next_answer(worker)[1]


def test_what_is_forgotten_is_never_answered(worker, folder):
    first, second = questions(folder, 2)
    worker.ask(first)
    worker.forget()
    assert not worker.waiting and worker.poll() is None
    worker.ask(second)
    assert next_answer(worker)[0] is second
    process = worker._process
    worker.forget()  # nothing is at work: the process stays for the next question
    assert process.poll() is None
    worker.stop()
    assert process.poll() is not None


def test_files_that_are_gone_are_a_problem_not_an_end(worker, folder, tmp_path):
    worker.ask(asked.question(tmp_path / "gone", CAMERA, AXIS, pose(60.0)))
    assert set(next_answer(worker)[1]) == {"problem"}
    process = worker._process
    worker.ask(questions(folder, 1)[0])
    assert "answer" in next_answer(worker)[1] and worker._process is process


def test_the_process_ends_with_who_asks(worker, folder):
    """Its input ends also where Slicer is killed."""
    worker.ask(questions(folder, 1)[0])
    next_answer(worker)
    worker._process.stdin.close()
    try:
        assert worker._process.wait(60) == 0
    except subprocess.TimeoutExpired:
        pytest.fail("it goes on without anybody who asks")


def test_every_task_is_there():
    import importlib

    for module, function in workers.TASKS.values():
        assert callable(getattr(importlib.import_module(module), function))
