"""The command-line modules: what Slicer's panel passes is what the command takes, and Slicer's protocol is spoken."""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path

import pytest
from cases import write_inputs

from ExpectedAppearancesLib import __version__, files
from ExpectedAppearancesLib.appearances import store
from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.cli import command_line_module
from ExpectedAppearancesLib.cli.command_line_module import SlicerProgress, command_arguments, parser_of
from ExpectedAppearancesLib.masks.stage import render_case
from ExpectedAppearancesLib.model import presets
from ExpectedAppearancesLib.runs.environment import MODULES, script_of
from ExpectedAppearancesLib.runs.record import exclusive
from ExpectedAppearancesLib.runs.results import result_problem
from ExpectedAppearancesLib.runs.runner import Run
from ExpectedAppearancesLib.runs.state import RunState

ROOT = Path(__file__).resolve().parents[1]
HEAD = ("category", "title", "description", "version", "documentation-url", "license", "contributor")
EXCLUDED = "crimson,dusk,ivory,mauve,rosewood,slate,sunset,clay"  # of the textures that ship; two are left
RIVALS = {"probseg", "binseg"}  # presets that are trained to be compared with, not to be used
SCALARS = {"integer": int, "double": float}
TINY = replace(
    presets.PRESETS["quick"], size_px=64, steps=20, batch=4, fresh=4, validation_views=4, validate_every=10, width=0.4
)


def description(command: str) -> ElementTree.Element:
    return ElementTree.parse(script_of(command).with_suffix(".xml")).getroot()


def parameters(command: str) -> dict[str, ElementTree.Element]:
    groups = description(command).findall("parameters")
    found = [p for group in groups for p in group if p.tag not in ("label", "description")]
    assert len({p.findtext("name") for p in found}) == len(found)
    return {p.findtext("name"): p for p in found}


def actions(command: str) -> dict[str, argparse.Action]:
    """What the panel offers: all but the options in groups of their own, which serve studies."""
    usual = [a for group in parser_of(command)._action_groups[:2] for a in group._group_actions]
    return {a.dest: a for a in usual if not isinstance(a, argparse._HelpAction)}


def as_slicer_passes(command: str, chosen: dict[str, str], widgets: bool = True) -> list[str]:
    """The arguments that Slicer makes of a module's parameters: options in their order, then those with an index.

    A number or a choice is passed always, a text, file or folder when it is not empty; the panel's folder button
    makes "." of no choice (widgets).
    """
    options, indexed = [], {}
    for name, parameter in parameters(command).items():
        value = chosen.get(name, parameter.findtext("default") or "")
        if widgets and parameter.tag == "directory" and not value:
            value = "."
        if parameter.find("index") is not None:
            indexed[int(parameter.findtext("index"))] = value
        elif value or parameter.tag in SCALARS or parameter.tag.endswith("-enumeration"):
            options += ["--" + parameter.findtext("longflag"), value]
    return options + [indexed[i] for i in sorted(indexed)]


# --- descriptions ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", MODULES)
def test_description_has_what_slicers_parser_wants(command):
    root = description(command)
    assert root.tag == "executable"
    assert all((root.findtext(name) or "").strip() for name in HEAD)
    assert root.findtext("version") == __version__ and root.findtext("category").startswith("IGT")
    for group in root.findall("parameters"):
        assert group.findtext("label") and group.findtext("description")
        assert group.get("advanced") in (None, "true")
    for name, parameter in parameters(command).items():
        # The parser refuses names with other characters, and an index beside a flag.
        assert re.fullmatch(r"[A-Za-z_]\w*", name)
        assert parameter.findtext("label") and parameter.findtext("description"), name
        assert (parameter.find("index") is None) != (parameter.find("longflag") is None)
        if parameter.find("longflag") is not None:
            assert re.fullmatch(r"[A-Za-z_]\w*", parameter.findtext("longflag"))
        allowed = {"name", "longflag", "index", "label", "description", "channel", "default", "constraints", "element"}
        assert {child.tag for child in parameter} <= allowed
        if parameter.tag in SCALARS:
            lowest, highest, step = (SCALARS[parameter.tag](e.text) for e in parameter.find("constraints"))
            assert lowest <= SCALARS[parameter.tag](parameter.findtext("default")) <= highest and step > 0
        if parameter.tag in ("file", "directory"):
            assert parameter.findtext("channel") == "input"


@pytest.mark.parametrize("command", MODULES)
def test_description_and_command_agree(command):
    described, taken = parameters(command), actions(command)
    assert described.keys() == taken.keys()
    for name, action in taken.items():
        parameter = described[name]
        if not action.option_strings:
            assert (parameter.tag, parameter.findtext("index")) == ("directory", "0")
            continue
        assert action.option_strings == ["--" + parameter.findtext("longflag").replace("_", "-")], name
        elements, default = [e.text for e in parameter.findall("element")], parameter.findtext("default") or ""
        if action.choices:
            assert parameter.tag == "string-enumeration", name
            assert default in elements
            offered = [choice for choice in action.choices if choice not in RIVALS]
            assert elements == (["auto"] if action.default is None else []) + offered, name
            assert default == (action.default or "auto"), name
        elif action.nargs == 0:
            assert (parameter.tag, default) == ("boolean", "false"), name
        elif action.type in (int, float):
            assert SCALARS.get(parameter.tag) is action.type, name
            assert action.type(default) == (action.default or 0), name
        elif action.nargs == "+":
            assert (parameter.tag, default) == ("string-vector", ""), name
        else:
            assert parameter.tag in ("file", "directory", "string"), name
            assert default == (action.default or ""), name


@pytest.mark.parametrize("command", MODULES)
def test_numbers_say_their_unit_where_they_have_one(command):
    units = {"size": "px", "minutes": "min"}
    for name, parameter in parameters(command).items():
        if name in units:
            assert f"({units[name]}" in parameter.findtext("label")
        if parameter.tag in SCALARS and actions(command)[name].default is None:
            assert "0: " in parameter.findtext("label")


@pytest.mark.parametrize("command", MODULES)
@pytest.mark.parametrize("widgets", [True, False])
def test_an_untouched_panel_runs_the_command_with_its_defaults(command, widgets):
    passed = command_arguments(command, as_slicer_passes(command, {"case": "/a case"}, widgets))
    parser = parser_of(command)
    assert parser.parse_args(passed) == parser.parse_args(["/a case"])


def test_what_is_chosen_in_the_panel_reaches_the_command():
    chosen = {"case": "/ü 1", "textures": "/t", "exclude": "a, b", "size": "64", "method": "image", "weights": "/w.pth"}
    args = parser_of("synthesize").parse_args(command_arguments("synthesize", as_slicer_passes("synthesize", chosen)))
    assert (args.case, args.textures, args.exclude, args.size) == ("/ü 1", Path("/t"), ["a", "b"], 64)
    assert (args.method, args.weights, args.seeds) == ("image", "/w.pth", 1)
    chosen = {"case": "/c", "minutes": "2.5", "seed": "0", "appearances": "image", "device": "cpu"}
    args = parser_of("train").parse_args(command_arguments("train", as_slicer_passes("train", chosen)))
    assert (args.minutes, args.seed, args.steps, args.appearances, args.device) == (2.5, 0, None, "image", "cpu")


@pytest.mark.parametrize(
    "arguments",
    [
        ["/c", "--exclude", "a", "b", "--size", "64"],
        ["--size=64", "--exclude", "'a', 'b'", "--method", "surface", "/c"],
        ["--exclude=a,b", "/c", "--size", "64"],
    ],
)
def test_lists_are_taken_from_a_shell_and_from_slicer(arguments):
    args = parser_of("synthesize").parse_args(command_arguments("synthesize", arguments))
    assert (args.case, args.exclude, args.size) == ("/c", ["a", "b"], 64)


def test_a_command_that_is_no_module_of_slicer_gets_its_options_as_they_are():
    arguments = ["/c", "--poses", "5", "--seed", "0", "--bogus", "0", "-1.5", "auto"]
    assert command_arguments("render", arguments) == arguments


def test_what_is_wrong_still_reaches_the_command():
    assert command_arguments("train", ["/c", "--steps", "-3", "--bogus"]) == ["/c", "--bogus", "--steps", "-3"]
    assert command_arguments("synthesize", ["/c", "--seeds", "0"]) == ["/c", "--seeds", "0"]  # no default stands for it


# --- the scripts -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rendered(tmp_path_factory) -> Case:
    folder = tmp_path_factory.mktemp("Fälle 1")
    paths = write_inputs(folder)
    case = Case.create(folder / "Fäll ü 手術", paths["vessels.vtp"], paths["cortex.vtp"], paths["camera.json"])
    render_case(case, lambda *_: None, poses=3)
    return case


def shell(command: str, *arguments, **environment) -> subprocess.CompletedProcess:
    """Run the script as a user does, with nothing on the path and not in the repository."""
    clean = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONUTF8")}
    return subprocess.run(
        [sys.executable, str(script_of(command)), *map(str, arguments)],
        capture_output=True,
        text=True,
        encoding="utf-8",
        env=clean | {"PYTHONUTF8": "1", "OMP_NUM_THREADS": "1"} | environment,
        cwd=Path(sys.executable).anchor,
        timeout=300,
    )


def figures(text: str) -> list[dict]:
    return [json.loads(line[len("figures ") :]) for line in text.splitlines() if line.startswith("figures ")]


def test_synthesis_from_a_shell_and_through_the_runner(rendered):
    chosen = {"case": str(rendered.folder), "exclude": EXCLUDED, "size": "64", "iterations": "2"}
    done = shell("synthesize", *as_slicer_passes("synthesize", chosen))
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("<filter-start><filter-name>synthesize</filter-name>")
    assert lines[-2:] == ["<filter-end><filter-name>synthesize</filter-name></filter-end>", "exit code 0"]
    fractions = [float(value) for value in re.findall(r"<filter-progress>([\d.]+)</filter-progress>", done.stdout)]
    assert fractions == sorted(fractions) and fractions[-1] == 1.0
    assert "<filter-comment>appearance 1 of 2, texture apricot" in done.stdout
    last = [f for f in figures(done.stdout) if "image" in f][-1]
    assert last["images"] == 2 and Path(last["image"]).name == "blush-0.png" and Path(last["image"]).is_file()
    assert len(store.read_appearances(rendered)[1]) == 2

    # The same once more, in a process of its own: what is finished is not made again.
    stamps = {path: path.stat().st_mtime_ns for path in store.folder_of(rendered, "surface").glob("*-0.png")}
    arguments = ["--exclude", *EXCLUDED.split(","), "--size", "64", "--iterations", "2"]
    status = Run.start("synthesize", rendered.folder, arguments).wait(300)
    assert (status.state, status.problem) == (RunState.DONE, "")
    assert status.values["images"] == 2
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps

    next(iter(stamps)).unlink()
    assert "missing" in result_problem("synthesize", rendered.folder)


def test_bad_input_is_listed_and_ends_with_2(rendered, tmp_path):
    # As on a Windows whose code page lacks the letters of the path.
    narrow = {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = shell("synthesize", rendered.folder, "--size", "7", "--textures", tmp_path / "none", **narrow)
    assert str(rendered.folder) in done.stdout
    assert done.returncode == 2 and done.stdout.splitlines()[-1] == "exit code 2"
    assert "2 problems" in done.stderr and "--size: 7" in done.stderr
    status = Run.start("synthesize", rendered.folder, ["--size", "7", "--batch", "-1"]).wait(120)
    assert status.state is RunState.FAILED and status.problem.count("\n") == 1 and "--batch" in status.problem
    assert shell("train", tmp_path).returncode == 2
    assert shell("train", "--preset", "bogus", tmp_path).returncode == 2


def test_only_one_run_of_a_kind_works_on_a_case(rendered):
    with exclusive(rendered.folder, "train"):
        done = shell("train", rendered.folder)
    assert done.returncode == 2 and "a training is going on in it" in done.stderr


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_terminated_by_slicer_or_killed_it_can_be_resumed(rendered):
    """SIGTERM ends it with 3; SIGKILL, which Slicer's Cancel sends, ends it at once; the next start goes on."""
    arguments = [str(rendered.folder), "--size", "48", "--iterations", "8", "--preset", "paper"]
    command = [sys.executable, str(script_of("synthesize")), *arguments]
    folder = store.folder_of(rendered, "image")
    kept: set[str] = set()
    for number in (signal.SIGTERM, signal.SIGKILL):
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        for line in process.stdout:
            told = figures(line)
            if told and told[0].get("images", 0) > len(kept):
                break
        process.send_signal(number)
        process.communicate(timeout=120)
        assert process.returncode == (3 if number == signal.SIGTERM else -signal.SIGKILL)
        index = files.read_json(folder / "index.json", "index")
        made = {path.name for path in folder.glob("*.png") if not path.name.endswith(".labels.png")}
        assert not index["done"] and kept < made
        assert all(files.read_image_rgb(folder / name).shape == (48, 48, 3) for name in made)
        kept = made


def test_training_tells_its_losses(rendered, monkeypatch, capsys):
    """In this process, to have a preset that takes seconds."""
    made = ["--size", "48", "--iterations", "1", "--exclude", EXCLUDED]
    assert command_line_module.main("synthesize", [str(rendered.folder), *made]) == 0
    assert figures(capsys.readouterr().out)[-1]["images"] == 2
    monkeypatch.setitem(presets.PRESETS, "quick", TINY)
    monkeypatch.setattr(SlicerProgress, "_interval_s", lambda *_: 0.0)  # a fast machine may pass both within one
    code = command_line_module.main("train", as_slicer_passes("train", {"case": str(rendered.folder), "device": "cpu"}))
    told = [f for f in figures(capsys.readouterr().out) if "step" in f]
    assert code == 0
    assert [f["step"] for f in told] == [10, 20]
    assert all(isinstance(f["loss"], float) for f in told) and told[1]["validation_add_mm"] > 0
    assert result_problem("train", rendered.folder, thorough=True) == ""
    model = rendered.model_folder / "model.onnx"
    model.write_bytes(model.read_bytes()[:-9])
    assert "damaged" in result_problem("train", rendered.folder, thorough=True)
    model.unlink()
    assert "missing" in result_problem("train", rendered.folder)


def test_a_long_run_reports_less_often(capsys):
    now_s = 0.0
    progress = SlicerProgress("train", None)
    progress._clock = lambda: now_s
    progress._created_s = 0.0
    for now_s in range(0, 12 * 3600, 2):
        progress(now_s / 1e6, f"step {now_s}, loss -0.5")
    text = capsys.readouterr().out
    assert 5_000 < text.count("<filter-progress>") < 12_000 and len(text) < 3e6
    assert figures(text)[-1]["loss"] == -0.5


def test_scripts_find_the_library_of_an_installed_extension(tmp_path):
    """lib/Slicer-5.8/{cli-modules,qt-scripted-modules}: as Slicer's macros install them."""
    root = tmp_path / "Erweiterung ü" / "lib" / "Slicer-5.8"
    (root / "cli-modules").mkdir(parents=True)
    (root / "qt-scripted-modules" / "ExpectedAppearancesLib" / "cli").mkdir(parents=True)
    for name in ("ExpectedAppearancesLib", "ExpectedAppearancesLib/cli"):
        (root / "qt-scripted-modules" / name / "__init__.py").touch()
    (root / "qt-scripted-modules" / "ExpectedAppearancesLib" / "cli" / "command_line_module.py").write_text(
        "def main(command):\n    print(command, __file__)\n    return 0\n", encoding="utf-8"
    )
    for command in MODULES:
        script = root / "cli-modules" / script_of(command).name
        script.write_bytes(script_of(command).read_bytes())
        assert script.read_text(encoding="utf-8").startswith("#!/usr/bin/env python-real\n")
        done = subprocess.run(
            # -S: without the packages of this environment, in which the library may be installed.
            [sys.executable, "-S", str(script)],
            capture_output=True,
            text=True,
            encoding="utf-8",
            env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"PYTHONUTF8": "1"},
        )
        assert done.returncode == 0, done.stderr
        assert done.stdout.split(" ", 1) == [
            command,
            str(root / "qt-scripted-modules" / "ExpectedAppearancesLib" / "cli" / "command_line_module.py") + "\n",
        ]


@pytest.mark.skipif(not hasattr(os, "sched_setscheduler"), reason="Linux only")
@pytest.mark.parametrize(("gained", "policy"), [(0, "SCHED_OTHER"), (19, "SCHED_IDLE")])
def test_a_run_gives_way_to_the_slicer_that_started_it(gained, policy):
    code = (
        f"import os; before = os.nice({gained})\n"
        "from ExpectedAppearancesLib.cli.command_line_module import give_way; give_way()\n"
        f"assert os.sched_getscheduler(0) == os.{policy}\n"
        "assert os.nice(0) == max(before, 10), (before, os.nice(0))"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
