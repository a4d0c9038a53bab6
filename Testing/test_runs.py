"""Runs in processes of their own: states, progress, cancel, crash, kill, and being found again by another process."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import psutil
import pytest

from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.interpreter import LIBRARY_PARENT
from ExpectedAppearancesLib.runs import closing, processes, record, runner
from ExpectedAppearancesLib.runs.environment import environment_of
from ExpectedAppearancesLib.runs.runner import Run
from ExpectedAppearancesLib.runs.state import RunState, controls

DEADLINE_S = 60.0
# A command that has a child of its own, which has one, too; what it does then is its second argument.
CHILD = """
import json, os, signal, subprocess, sys, time
from pathlib import Path

case, what = Path(sys.argv[1]), sys.argv[2]
grand = "import subprocess, sys, time; subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)']);"
grand += "time.sleep(600)"
print("<filter-start><filter-name>x</filter-name></filter-start>", flush=True)
helper = subprocess.Popen([sys.executable, "-c", grand])
(case / f".model.{os.getpid()}.part.onnx").write_bytes(b"half")
if what == "stubborn":
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
if what in ("orderly", "tidying"):
    def stop(*_):
        helper.kill()
        print("exit code 3", flush=True)
        time.sleep(600 if what == "tidying" else 0)
        sys.exit(3)
    signal.signal(signal.SIGTERM, stop)
for i in range(1, 5):
    print(f"<filter-progress>{i / 10}</filter-progress>", flush=True)
    print(f"<filter-comment>step {i} of \\u00fc</filter-comment>", flush=True)
    print("figures " + json.dumps({"step": i, "loss": 1 / i, "seconds_left": 9.0}), flush=True)
(case / "ready").touch()
if what in ("stubborn", "orderly", "tidying", "wait"):
    time.sleep(600)
if what == "crash":
    print("about to crash", flush=True)
    os.abort()
if what == "problems":
    print("x: 2 problems with the input\\n  - a.vtp: bad.\\n  - b.png: worse.", file=sys.stderr, flush=True)
    helper.kill()
    sys.exit(2)
if what == "fail":
    print("Failed: the network is lost\\nDetails are in the log: y.log", file=sys.stderr, flush=True)
    sys.exit(1)
if what == "done":
    manifest = {"stages": {"synthesize": {"done": True, "method": "surface"}}}
    made = case / "appearances" / "surface"
    made.mkdir(parents=True, exist_ok=True)
    (made / "a.png").touch()
    (made / "index.json").write_text(json.dumps({"done": True, "items": [{"image": "a.png"}]}))
    (case / "case.json").write_text(json.dumps(manifest))
helper.kill()
sys.exit(int(what) if what.isdigit() else 0)
"""


@pytest.fixture
def case(tmp_path, monkeypatch):
    """A folder whose runs are CHILD; whatever is left of them is ended after the test."""
    folder = tmp_path / "Fäll ü 1 手術"
    folder.mkdir()
    (folder / "case.json").write_text(json.dumps({"stages": {"synthesize": {"done": False}}}), encoding="utf-8")
    (tmp_path / "child.py").write_text(CHILD, encoding="utf-8")
    monkeypatch.setattr(
        runner,
        "command_of",
        lambda _kind, case, arguments, python: [python, str(tmp_path / "child.py"), str(case), *arguments],
    )
    yield folder
    for path in (folder / "runs").glob("*.json"):
        written = record.read_record(folder, path.stem)
        if written is not None:
            processes.ProcessTree(written.pid, written.created_s, written.mark).kill()


def start(case, what) -> Run:
    return Run.start("synthesize", case, [what])


def wait_until_ready(case, run=None):
    deadline = time.monotonic() + DEADLINE_S
    while not (case / "ready").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert (case / "ready").exists()
    while run is not None and run.poll().fraction < 0.4 and time.monotonic() < deadline:
        time.sleep(0.02)


def members(run) -> list[psutil.Process]:
    return run._tree.members()


def wait_for_three(run) -> list[psutil.Process]:
    deadline = time.monotonic() + DEADLINE_S
    while len(members(run)) < 3 and time.monotonic() < deadline:
        time.sleep(0.02)
    assert len(members(run)) == 3
    return members(run)


# --- one run ---------------------------------------------------------------------------------------------------------


def test_a_run_tells_its_progress_and_ends_with_a_result(case):
    run = start(case, "done")
    assert run.poll().state in (RunState.PREPARING, RunState.RUNNING)
    status = run.wait(DEADLINE_S)
    assert (status.state, status.exit_code, status.problem, status.fraction) == (RunState.DONE, 0, "", 1.0)
    assert status.values == {"step": 4, "loss": 0.25}
    assert status.message == "step 4 of ü"
    assert status.log_path.parent == case / "logs" and "<filter-progress>0.4" in status.log_path.read_text("utf-8")
    assert run.poll() is status
    assert not list(case.rglob("*.part*"))
    assert Run.find(case, "synthesize") is None  # it has been seen to end


def test_progress_is_seen_while_it_runs(case):
    run = start(case, "wait")
    wait_until_ready(case, run)
    status = run.poll()
    assert status.state is RunState.RUNNING and status.fraction == 0.4 and status.seconds_left == 9.0
    assert "pid" not in status.values and status.exit_code is None


def test_polling_costs_little(case):
    run = start(case, "wait")
    wait_until_ready(case, run)
    slowest = 0.0
    for _ in range(30):
        begin = time.thread_time()
        run.poll()
        slowest = max(slowest, time.thread_time() - begin)
    begin = time.thread_time()
    run.cancel()
    assert max(slowest, time.thread_time() - begin) < 0.1


@pytest.mark.parametrize(
    ("what", "state", "code", "words"),
    [
        ("problems", RunState.FAILED, 2, ["a.vtp: bad.", "b.png: worse."]),
        ("fail", RunState.FAILED, 1, ["the network is lost", "output.log"]),
        ("3", RunState.CANCELLED, 3, []),
        ("7", RunState.FAILED, 7, ["exit code 7", "output.log"]),
        ("0", RunState.FAILED, 0, ["result is not whole", "not finished"]),
    ],
)
def test_exit_codes_are_read_and_success_needs_a_whole_result(case, what, state, code, words):
    status = start(case, what).wait(DEADLINE_S)
    assert (status.state, status.exit_code) == (state, code)
    assert all(word in status.problem for word in words)
    assert bool(words) == bool(status.problem)
    if what == "problems":
        assert status.problem == "a.vtp: bad.\nb.png: worse."


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_a_crash_says_how_and_leaves_no_process_and_no_half_file(case):
    run = start(case, "crash")
    status = run.wait(DEADLINE_S)
    assert status.state is RunState.FAILED and status.exit_code == -signal.SIGABRT
    assert f"signal {signal.SIGABRT:d}" in status.problem and "about to crash" in status.problem
    assert str(status.log_path) in status.problem
    assert members(run) == [] and not list(case.rglob("*.part*"))


@pytest.mark.parametrize("what", ["wait", "orderly", "tidying", "stubborn"])
def test_cancel_ends_the_whole_tree_by_the_deadline(case, monkeypatch, what):
    monkeypatch.setattr(runner, "CANCEL_DEADLINE_S", 1.0 if what == "stubborn" else 300.0)
    run = start(case, what)
    wait_until_ready(case, run)
    tree = wait_for_three(run)
    begin = time.monotonic()
    run.cancel()
    assert run.poll().state in (RunState.CANCELLING, RunState.CANCELLED)
    assert controls(RunState.CANCELLING).cancel
    status = run.wait(DEADLINE_S)
    assert status.state is RunState.CANCELLED and status.problem == "" and "goes on from there" in status.message
    assert time.monotonic() - begin < 60
    assert not any(p.is_running() and p.status() != psutil.STATUS_ZOMBIE for p in tree)
    assert not list(case.rglob("*.part*"))
    if what in ("orderly", "tidying"):
        assert status.exit_code == 3
    assert Run.find(case, "synthesize") is None
    assert start(case, "done").wait(DEADLINE_S).state is RunState.DONE  # the next start goes on


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_a_run_that_is_killed_by_the_system_leaves_nothing_behind(case):
    run = start(case, "wait")
    wait_until_ready(case, run)
    tree = wait_for_three(run)
    os.kill(run._record.pid, signal.SIGKILL)
    status = run.wait(DEADLINE_S)
    assert status.state is RunState.FAILED and "memory" in status.problem
    assert not any(p.is_running() and p.status() != psutil.STATUS_ZOMBIE for p in tree)


def test_the_end_of_a_run_is_seen_although_its_drive_is_gone(case, vanish):
    run = start(case, "wait")
    wait_until_ready(case, run)
    run._tree.kill()
    vanish(case.parent)
    assert run.wait(DEADLINE_S).state is RunState.FAILED
    assert Run.find(case, "synthesize") is None


def test_a_second_run_of_the_kind_is_refused_while_one_goes_on(case):
    run = start(case, "wait")
    with pytest.raises(InputError, match=rf"going on .*{run._record.pid}, since 20..-..-.. ..:..\)"):
        start(case, "wait")
    other = Run.start("train", case, ["wait"])
    assert other.poll().state.active
    for one in (run, other):
        one.cancel()
        one.wait(DEADLINE_S)


def test_start_refuses_what_is_no_case_and_what_is_no_python(case, tmp_path):
    with pytest.raises(InputError, match="not a case folder"):
        Run.start("train", tmp_path, [])
    with pytest.raises(InputError, match="no-python: cannot be started"):
        Run.start("train", case, [], python=str(tmp_path / "no-python"))
    assert Run.find(case, "train") is None


# --- found again -----------------------------------------------------------------------------------------------------

OTHER = """
import json, sys
from ExpectedAppearancesLib.runs import runner
from ExpectedAppearancesLib.runs.runner import Run
runner.command_of = lambda _kind, case, arguments, python: [python, sys.argv[2], str(case), *arguments]
case, action = sys.argv[1], sys.argv[3]
if action == "start":
    Run.start("synthesize", case, [sys.argv[4]]).detach()
elif action == "hold":
    run = Run.start("synthesize", case, [sys.argv[4]])
    while True:
        run.wait(60)
else:
    run = Run.find(case, "synthesize")
    if run is not None and action in ("cancel", "ask"):
        run.poll()
        run.cancel()
    status = None if run is None else run.poll() if action in ("look", "ask") else run.wait(60)
    if status is not None:
        print(json.dumps([status.state.value, status.fraction, status.exit_code, status.problem]))
"""


def other_command(case, *arguments) -> list[str]:
    return [sys.executable, "-c", OTHER, str(case), str(case.parent / "child.py"), *arguments]


def elsewhere(case, *arguments):
    """Do it in another process: the Slicer that is started later."""
    environment = environment_of("") | {"PYTHONPATH": str(LIBRARY_PARENT)}
    done = subprocess.run(
        other_command(case, *arguments),
        capture_output=True,
        text=True,
        encoding="utf-8",
        env=environment,
        timeout=DEADLINE_S,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout) if done.stdout.strip() else None


def test_a_later_process_finds_a_run_and_can_cancel_it(case):
    elsewhere(case, "start", "wait")
    wait_until_ready(case)
    state, fraction, code, _ = elsewhere(case, "look")
    assert (state, fraction, code) == ("running", 0.4, None)
    run = Run.find(case, "synthesize")
    tree = wait_for_three(run)
    with pytest.raises(InputError, match="going on"):
        start(case, "wait")
    assert elsewhere(case, "cancel")[0] == "cancelled"
    assert not any(p.is_running() and p.status() != psutil.STATUS_ZOMBIE for p in tree)
    assert elsewhere(case, "look") is None


def test_a_run_goes_on_when_the_program_that_started_it_is_killed(case):
    environment = environment_of("") | {"PYTHONPATH": str(LIBRARY_PARENT)}
    program = subprocess.Popen(other_command(case, "hold", "wait"), env=environment)
    wait_until_ready(case)
    program.kill()
    program.wait()
    run = Run.find(case, "synthesize")
    tree = wait_for_three(run)
    time.sleep(0.5)
    assert run.poll().state is RunState.RUNNING and all(p.is_running() for p in tree)
    run.cancel()
    assert run.wait(DEADLINE_S).state is RunState.CANCELLED


def test_a_run_of_a_case_is_not_taken_for_one_of_its_copy_and_follows_it_when_it_is_moved(case):
    run = start(case, "wait")
    wait_until_ready(case)
    copy = case.with_name("copy")
    shutil.copytree(case, copy)
    assert Run.find(copy, "synthesize") is None
    other = start(copy, "done")  # nothing goes on there
    assert other.wait(DEADLINE_S).state is RunState.DONE
    assert run.poll().state is RunState.RUNNING
    shutil.rmtree(copy)
    case.rename(copy)
    found = Run.find(copy, "synthesize")
    found.cancel()
    assert found.wait(DEADLINE_S).state is RunState.CANCELLED


def test_the_copy_of_a_case_whose_drive_is_gone_is_worked_on(case, vanish):
    """Its record still names the folder on the drive."""
    start(case, "done").wait(DEADLINE_S)
    copy = case.with_name("copy")
    shutil.copytree(case, copy)
    vanish(case)
    assert record.read_record(copy, "synthesize").outcome == "done"


def test_a_later_process_learns_once_that_a_run_has_crashed(case):
    elsewhere(case, "start", "crash")
    state, _, code, problem = elsewhere(case, "wait")
    assert (state, code) == ("failed", None) and "without a word" in problem and "about to crash" in problem
    assert elsewhere(case, "wait") is None


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_a_cancel_whose_program_was_closed_is_carried_out_by_the_next_one(case, monkeypatch):
    monkeypatch.setattr(runner, "CANCEL_DEADLINE_S", 1.0)
    elsewhere(case, "start", "stubborn")
    wait_until_ready(case)
    elsewhere(case, "ask")
    run = Run.find(case, "synthesize")
    assert run.poll().state is RunState.CANCELLING
    assert run.wait(DEADLINE_S).state is RunState.CANCELLED and members(run) == []


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_the_next_start_ends_what_an_unseen_crash_has_left(case):
    elsewhere(case, "start", "wait")
    wait_until_ready(case)
    tree = wait_for_three(Run.find(case, "synthesize"))
    os.kill(record.read_record(case, "synthesize").pid, signal.SIGKILL)
    deadline = time.monotonic() + DEADLINE_S
    while Run.find(case, "synthesize")._tree.running() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert start(case, "done").wait(DEADLINE_S).state is RunState.DONE
    assert not any(p.is_running() and p.status() != psutil.STATUS_ZOMBIE for p in tree)


def test_a_run_that_outlived_its_parent_is_judged_by_what_it_printed(case, tmp_path):
    (tmp_path / "child.py").write_text(CHILD.replace("sys.exit(int(", "print('exit code 0')\nsys.exit(int("), "utf-8")
    elsewhere(case, "start", "done")
    found = Run.find(case, "synthesize").wait(DEADLINE_S)
    assert (found.state, found.exit_code) == (RunState.DONE, 0)


def test_a_process_that_got_the_number_of_an_ended_run_is_not_taken_for_it(case):
    start(case, "done").wait(DEADLINE_S)
    stranger = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    try:
        written = record.read_record(case, "synthesize")
        created_s = psutil.Process(stranger.pid).create_time()
        record.write_record(
            case, replace(written, pid=stranger.pid, created_s=created_s, mark="0" * 32, outcome="", cancelled=True)
        )
        run = Run.find(case, "synthesize")
        assert run is not None and run.wait(5).state is not RunState.RUNNING
        assert stranger.poll() is None  # nor ended in its place
        assert start(case, "done").wait(DEADLINE_S).state is RunState.DONE
        assert stranger.poll() is None
    finally:
        stranger.kill()
        stranger.wait()


@pytest.mark.parametrize("content", ["", "{", "[]", '{"format": "other"}', '{"format": "ExpectedAppearances run"}'])
def test_a_record_that_cannot_be_read_is_no_run(case, content):
    record.record_path(case, "train").parent.mkdir()
    record.record_path(case, "train").write_text(content, encoding="utf-8")
    assert Run.find(case, "train") is None


def test_a_run_of_another_computer_is_not_judged_by_its_number_here(case):
    start(case, "done").wait(DEADLINE_S)
    written = record.read_record(case, "synthesize")
    record.write_record(case, replace(written, host="another", outcome="", pid=os.getpid()))
    assert Run.find(case, "synthesize") is None


# --- closing ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("choice", "goes_on"),
    [(closing.OnClose.END, False), (closing.OnClose.DETACH, True), (closing.OnClose.ASK, True)],
)
def test_closing_ends_or_leaves_runs_as_the_user_chose(case, choice, goes_on):
    run = start(case, "orderly")
    wait_until_ready(case)
    left = closing.close_runs([None, run], choice)
    assert left[run].active == goes_on and run._tree.running() == goes_on
    assert (Run.find(case, "synthesize") is not None) == goes_on


@pytest.mark.skipif(os.name == "nt", reason="its time zone is not that of the environment")
def test_what_goes_on_is_asked_about_in_the_users_words_and_time(monkeypatch, tmp_path):
    monkeypatch.setenv("TZ", "America/New_York")
    time.tzset()
    try:
        run = SimpleNamespace(kind="synthesize", case_folder="/cases/a", started="2026-01-02T03:04:05+00:00")
        assert "- Expected appearances are being made in /cases/a, since 2026-01-01 22:04\n" in closing.question([run])
        holder = {"pid": 7, "host": "elsewhere", "since": run.started, "work": ""}
        assert "(process 7 on elsewhere, since 2026-01-01 22:04)" in record._occupied(tmp_path, "train", holder)
    finally:
        monkeypatch.undo()
        time.tzset()


def test_what_has_ended_is_not_closed(case):
    run = start(case, "done")
    run.wait(DEADLINE_S)
    assert closing.close_runs([run, None], closing.OnClose.END) == {}
