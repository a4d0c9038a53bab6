"""Cancelling that waits for a good place, and the lock that lets one process work on a case at a time."""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
import time
from dataclasses import replace

import pytest

from ExpectedAppearancesLib.cancelling import cancelling_waits
from ExpectedAppearancesLib.cli import main, termination_cancels
from ExpectedAppearancesLib.errors import CancelledError, InputError
from ExpectedAppearancesLib.interpreter import library_environment
from ExpectedAppearancesLib.runs import record
from ExpectedAppearancesLib.runs.record import (
    LOOK_EVERY_S,
    RunRecord,
    exclusive,
    obey_record,
    runs_folder,
    write_record,
)

HOLD = """
import sys, time
from ExpectedAppearancesLib.runs.record import exclusive
with exclusive(sys.argv[1], "train", work=sys.argv[2]):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.mark.parametrize(
    ("number", "error"), [(signal.SIGTERM, CancelledError), (signal.SIGINT, KeyboardInterrupt)], ids=["TERM", "INT"]
)
def test_a_signal_waits_until_it_is_asked_for(number, error):
    with termination_cancels():
        before = signal.getsignal(number)
        done = []
        with pytest.raises(error), cancelling_waits() as stop:
            assert not stop.asked
            signal.raise_signal(number)
            done.append(stop.asked)
            stop.carry_out()
            done.append("beyond")
        assert done == [True] and signal.getsignal(number) is before
        with pytest.raises(error), cancelling_waits():
            signal.raise_signal(number)
            done.append("to the end of the block")
        with pytest.raises(error), cancelling_waits():
            signal.raise_signal(number)
            signal.raise_signal(number)  # the second time it cannot wait
            done.append("beyond")
    assert done == [True, "to the end of the block"]


def test_what_fails_before_the_signal_is_carried_out_is_told():
    with termination_cancels(), pytest.raises(ValueError, match="first"), cancelling_waits():
        signal.raise_signal(signal.SIGTERM)
        raise ValueError("first")


def test_a_run_obeys_its_record_where_no_signal_reaches_it(tmp_path):
    """As on Windows; the record of another run is none of its business."""
    written = RunRecord("train", 1, 0.0, "mine", platform.node(), "", [], "", "x.log")
    write_record(tmp_path, written)
    with termination_cancels(), pytest.raises(CancelledError), cancelling_waits() as stop:
        thread = obey_record(tmp_path, "train", "mine")
        write_record(tmp_path, replace(written, mark="other", cancelled=True))
        thread.join(3 * LOOK_EVERY_S)
        assert thread.is_alive() and not stop.asked
        write_record(tmp_path, replace(written, cancelled=True))
        thread.join(60)
        assert stop.asked and not thread.is_alive()


@pytest.fixture
def holder(tmp_path):
    """A process that holds the lock of trainings on tmp_path."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path), "same"],
        env=library_environment(),
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def test_who_holds_the_lock_is_named_and_a_killed_one_holds_nothing(tmp_path, holder):
    with pytest.raises(InputError) as error, exclusive(tmp_path, "train"):
        pass
    assert f"a training is going on in it (process {holder.pid}, since 20" in str(error.value)
    assert "cancel it" in str(error.value)
    with exclusive(tmp_path, "synthesize"):
        pass  # another kind of work
    holder.kill()
    holder.wait()
    own = rf"process {os.getpid()}\b"  # though the dead one was still written there
    with exclusive(tmp_path, "train"), pytest.raises(InputError, match=own), exclusive(tmp_path, "train"):
        pass
    assert not list(runs_folder(tmp_path).glob("*.json"))


def test_who_looks_whether_a_case_is_free_is_not_taken_for_one_who_works_on_it(tmp_path, holder, monkeypatch):
    """A training that begins at that moment waits for the lock, unless somebody is named as its holder."""
    monkeypatch.setattr(record, "_write_holder", lambda *_: pytest.fail("named as the holder"))
    with pytest.raises(InputError, match=rf"a training is going on in it \(process {holder.pid}"):
        record.refuse_if_occupied(tmp_path)
    holder.kill()
    holder.wait()
    record.refuse_if_occupied(tmp_path)


def test_only_the_same_work_is_shared(tmp_path, holder):
    with exclusive(tmp_path, "train", work="same"):
        assert str(holder.pid) in next(runs_folder(tmp_path).glob("*.json")).read_text()
    assert list(runs_folder(tmp_path).glob("*.json"))  # still the holder's
    with pytest.raises(InputError, match="is going on"), exclusive(tmp_path, "train", work="other"):
        pass


def test_a_lock_is_waited_for_when_told_to(tmp_path, holder):
    begin = time.monotonic()
    with pytest.raises(InputError), exclusive(tmp_path, "train", 0.5):
        pass
    assert time.monotonic() - begin >= 0.5


@pytest.mark.parametrize("command", ["render", "synthesize", "train", "study"])
def test_the_commands_that_write_refuse_a_case_that_is_worked_on(tmp_path, capsys, command):
    """As a user types them, without the panel or Slicer's own."""
    from cases import write_inputs

    from ExpectedAppearancesLib.case.case import Case

    paths = write_inputs(tmp_path)
    case = Case.create(tmp_path / "case", paths["vessels.vtp"], paths["cortex.vtp"], paths["camera.json"])
    with exclusive(case.folder, command):
        assert main([command, str(case.folder)]) == 2
    assert f"going on in it (process {os.getpid()}" in capsys.readouterr().err
    made = {path.name for path in case.folder.iterdir()} - {path.name for path in paths.values()}
    assert made == {"case.json", "runs", "logs"}
