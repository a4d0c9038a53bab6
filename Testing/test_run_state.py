"""Around a run: what is enabled in each state, what is read from its output, which Python and script it is."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import pytest

from ExpectedAppearancesLib.interpreter import LIBRARY_PARENT, python_for_runs
from ExpectedAppearancesLib.runs.environment import environment_of, script_of
from ExpectedAppearancesLib.runs.output import READ_AT_ONCE, OutputReader
from ExpectedAppearancesLib.runs.state import RunState, controls

# --- states ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("state", "problem", "unfinished", "start", "cancel", "settings", "action"),
    [
        (RunState.IDLE, "", False, "", "Nothing", "", "start"),
        (RunState.IDLE, "", True, "", "Nothing", "", "continue"),
        (RunState.IDLE, "Choose a case.", False, "Choose a case.", "Nothing", "", "start"),
        (RunState.PREPARING, "", False, "going on", "", "going on", "continue"),
        (RunState.RUNNING, "", True, "going on", "", "going on", "continue"),
        (RunState.RUNNING, "Choose a case.", False, "going on", "", "going on", "continue"),
        (RunState.CANCELLING, "", True, "being ended", "being ended", "being ended", "continue"),
        (RunState.FAILED, "", False, "", "Nothing", "", "continue"),
        (RunState.CANCELLED, "", False, "", "Nothing", "", "continue"),
        (RunState.CANCELLED, "No disk.", True, "No disk.", "Nothing", "", "continue"),
        (RunState.DONE, "", False, "", "Nothing", "", "start"),
        (RunState.DONE, "", True, "", "Nothing", "", "continue"),
    ],
)
def test_what_is_enabled_in_each_state(state, problem, unfinished, start, cancel, settings, action):
    found = controls(state, problem, unfinished)
    for text, expected in ((found.start, start), (found.cancel, cancel), (found.settings, settings)):
        assert expected in text and bool(text) == bool(expected)
    assert found.action == action


@pytest.mark.parametrize("state", [RunState.IDLE, RunState.DONE])
def test_what_is_there_is_made_again_also_in_a_case_that_was_opened_anew(state):
    assert controls(state, finished=True).action == "again"
    assert controls(state, unfinished=True, finished=True).action == "continue"
    assert controls(state).action == "start"


def test_every_state_has_a_control_that_is_enabled_or_is_passing():
    for state in RunState:
        found = controls(state)
        assert state is RunState.CANCELLING or "" in (found.start, found.cancel)
        assert state.active == (found.settings != "")


# --- what is printed -------------------------------------------------------------------------------------------------


def test_output_is_read_in_pieces_at_any_cut(tmp_path):
    text = (
        "warning: é\n<filter-progress>0.25</filter-progress>\r\n<filter-comment>a &lt; b</filter-comment>\n"
        'figures {"step": 7}\nfigures {broken\n<filter-progress>1.7</filter-progress>\nexit code 0\n'
    ).encode()
    for cut in range(len(text)):
        path = tmp_path / f"{cut}.log"
        path.write_bytes(text[:cut])
        reader = OutputReader(path)
        reader.read()
        with open(path, "ab") as stream:
            stream.write(text[cut:])
        reader.read()
        assert (reader.fraction, reader.message, reader.figures, reader.exit_code) == (1.0, "a < b", {"step": 7}, 0)
        assert list(reader.last_lines) == ["warning: é", "figures {broken"]


def test_of_a_long_log_only_the_end_is_read(tmp_path):
    path = tmp_path / "long.log"
    path.write_text("<filter-progress>0.1</filter-progress>\n" * 100_000 + 'figures {"step": 5}\n', encoding="utf-8")
    reader = OutputReader(path, from_the_end=True)
    begin = time.thread_time()
    reader.read()
    assert time.thread_time() - begin < 0.1
    assert reader.figures == {"step": 5} and path.stat().st_size > 4 * READ_AT_ONCE


# --- which Python, which script --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["SlicerApp-real", "PythonSlicer"])
def test_inside_slicer_the_interpreter_beside_the_application_is_used(tmp_path, monkeypatch, name):
    suffix = ".exe" if os.name == "nt" else ""
    real = tmp_path / "bin" / f"python-real{suffix}"
    real.parent.mkdir()
    real.touch()
    assert python_for_runs(str(tmp_path / "bin" / f"{name}{suffix}")) == str(real)
    monkeypatch.setenv("SLICER_HOME", str(tmp_path))
    assert python_for_runs(str(tmp_path / f"{name}{suffix}")) == str(real)
    real.rename(tmp_path / "bin" / f"PythonSlicer{suffix}")
    assert Path(python_for_runs(str(tmp_path / f"{name}{suffix}"))).stem == "PythonSlicer"


def test_outside_slicer_it_is_the_same_python():
    assert python_for_runs() == sys.executable


def test_scripts_are_found_in_a_source_tree_and_in_an_installed_extension(tmp_path):
    assert script_of("train").name == "ExpectedAppearancesTraining.py"
    assert script_of("synthesize").is_file()
    assert script_of("render") is None
    scripts = tmp_path / "lib" / "Slicer-5.8" / "cli-modules"
    assert script_of("train", scripts.parent / "qt-scripted-modules") is None
    scripts.mkdir(parents=True)
    (scripts / "ExpectedAppearancesTraining.py").touch()
    assert script_of("train", scripts.parent / "qt-scripted-modules") == scripts / "ExpectedAppearancesTraining.py"


def test_the_library_is_found_whatever_the_path_was(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["/slicer/a", "/slicer/b"]))
    assert environment_of("m")["PYTHONPATH"].split(os.pathsep) == ["/slicer/a", "/slicer/b", str(LIBRARY_PARENT)]
    monkeypatch.delenv("PYTHONPATH")
    assert environment_of("m")["PYTHONPATH"] == str(LIBRARY_PARENT)


def test_a_run_solves_small_systems_on_one_thread_unless_the_user_says_otherwise(monkeypatch):
    from ExpectedAppearancesLib.interpreter import library_environment

    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    assert library_environment()["OPENBLAS_NUM_THREADS"] == "1"
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")
    assert library_environment()["OPENBLAS_NUM_THREADS"] == "3"
