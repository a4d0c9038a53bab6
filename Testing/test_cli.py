"""The headless program as a user meets it: exit codes, messages, logs, and what it imports."""

from __future__ import annotations

import errno
import json
import logging
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from ExpectedAppearancesLib import cli
from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.case.meshes import Mesh, write_vtp
from ExpectedAppearancesLib.cli import logs as cli_logs
from ExpectedAppearancesLib.cli.logs import log_file
from ExpectedAppearancesLib.cli.progress import Progress, duration
from ExpectedAppearancesLib.errors import CancelledError, ExpectedAppearancesError, InputError
from ExpectedAppearancesLib.geometry.camera import Camera, write_camera
from ExpectedAppearancesLib.runs import system_findings

ROOT = Path(__file__).parents[1]
HEAVY = ("torch", "vtk", "vtkmodules", "cv2", "onnxruntime", "onnx", "scipy", "skimage", "matplotlib", "numpy")


@pytest.fixture(autouse=True)
def state_folder(tmp_path_factory, monkeypatch) -> Path:
    """Logs of runs without a case go here, not into the home of whoever runs the tests."""
    folder = tmp_path_factory.mktemp("state")
    monkeypatch.setattr("ExpectedAppearancesLib.cli.logs.state_folder", lambda: folder)
    return folder


@pytest.fixture
def inputs(tmp_path) -> dict[str, str]:
    rng = np.random.default_rng(0)
    folder = tmp_path / "inputs"
    for name in ("vessels", "cortex"):
        write_vtp(folder / f"{name}.vtp", Mesh(rng.uniform(-20, 20, (30, 3)), np.arange(30).reshape(10, 3)))
    write_camera(folder / "camera.json", Camera(320, 240, 500.0, 430.0, 120.0, 140.0))
    return {name: str(folder / name) for name in ("vessels.vtp", "cortex.vtp", "camera.json")}


def new_arguments(case, inputs, **replaced) -> list[str]:
    values = {"vessels": inputs["vessels.vtp"], "cortex": inputs["cortex.vtp"], "camera": inputs["camera.json"]}
    return [
        "new",
        str(case),
        *(word for key, value in (values | replaced).items() for word in (f"--{key}", str(value))),
    ]


def stand_in_command(monkeypatch, run) -> None:
    """Make `render CASE` call `run(args, progress)`."""
    module = SimpleNamespace(add_arguments=lambda parser: parser.add_argument("case", type=Path), run=run)
    monkeypatch.setattr(cli.importlib, "import_module", lambda _name, _package: module)


def fail_with(error):
    def run(_args, _progress):
        raise error

    return run


# --- the program -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["bogus"]])
def test_top_level_imports_nothing_heavy(arguments):
    source = (
        "import sys; from ExpectedAppearancesLib.cli import main; code = main(sys.argv[1:]);"
        f"print('LOADED', code, [m for m in {HEAVY} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", source, *arguments], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.splitlines()[-1] == f"LOADED {2 if arguments == ['bogus'] else 0} []", done.stderr
    if arguments == ["--help"]:
        assert all(name in done.stdout for name in cli.COMMANDS)


def test_only_the_chosen_command_is_imported():
    source = (
        "import sys; from ExpectedAppearancesLib.cli import main; main(['check', '--help']);"
        "print([m for m in sys.modules if m.startswith('ExpectedAppearancesLib.cli.')])"
    )
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.splitlines()[-1] == "['ExpectedAppearancesLib.cli.check']", done.stderr


@pytest.mark.parametrize("name", list(cli.COMMANDS))
def test_every_command_exists_and_explains_its_options(name, capsys):
    assert cli.main([name, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"expected-appearances {name}" in text and len(text.split("options:")[0].split()) > 15


def test_help_of_no_command_loads_torch_or_vtk():
    source = (
        "import sys; from ExpectedAppearancesLib.cli import COMMANDS, main;"
        "print('LOADED', [name for name in COMMANDS if main([name, '--help'])],"
        "[m for m in ('torch', 'vtk', 'onnxruntime', 'skimage', 'matplotlib') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.splitlines()[-1] == "LOADED [] []", done.stderr


def test_the_module_can_be_spawned_again():
    """Worker processes import __main__ anew under another name; it must not start the program."""
    source = "import runpy; runpy.run_module('ExpectedAppearancesLib.__main__', run_name='__mp_main__')"
    done = subprocess.run([sys.executable, "-c", source, "bogus"], capture_output=True, text=True, cwd=ROOT)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (
            InputError(["a.vtp: bad.", "b.png: worse."]),
            2,
            "2 problems with the input\n  - a.vtp: bad.\n  - b.png: worse.",
        ),
        (CancelledError("stopped"), 3, "Cancelled. stopped"),
        (KeyboardInterrupt(), 3, "Cancelled."),
        (ExpectedAppearancesError("network lost"), 1, "Failed: network lost"),
        (ZeroDivisionError("oh"), 1, "Failed: ZeroDivisionError: oh"),
        (MemoryError(), 1, "MemoryError"),
        (ModuleNotFoundError("No module named 'torch'", name="torch.nn"), 1, "package 'torch' is not installed"),
        (OSError(errno.ENOSPC, "No space left on device", "x/y.pt"), 2, "x/y.pt: No space left on device; free some"),
        (PermissionError(errno.EACCES, "Permission denied", "x/y.pt"), 2, "x/y.pt: Permission denied"),
        (OSError(errno.EIO, "Input/output error"), 1, "Input/output error"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else None,
)
def test_exit_codes_messages_and_log(tmp_path, monkeypatch, capsys, state_folder, error, code, words):
    stand_in_command(monkeypatch, fail_with(error))
    assert cli.main(["render", str(tmp_path / "none")]) == code
    text = capsys.readouterr().err
    (log,) = state_folder.glob("*-render.log")
    assert words in text and "Traceback" not in text
    assert (str(log) in text) == (code == 1)
    content = log.read_text(encoding="utf-8")
    assert "Traceback" in content and type(error).__name__ in content and f"exit code {code}" in content
    assert not (tmp_path / "none").exists()


def test_a_run_returns_its_own_code_and_leaves_logging_as_it_was(tmp_path, monkeypatch):
    before = (list(logging.getLogger().handlers), logging.getLogger().level)
    stand_in_command(monkeypatch, lambda _args, _progress: 1)
    assert cli.main(["render", str(tmp_path)]) == 1
    assert (list(logging.getLogger().handlers), logging.getLogger().level) == before


def test_the_log_is_in_the_case(tmp_path, monkeypatch, inputs):
    Case.create(tmp_path / "case", inputs["vessels.vtp"], None, inputs["camera.json"])
    stand_in_command(monkeypatch, lambda _args, progress: progress(1.0, "drawn ünd done"))
    assert cli.main(["render", str(tmp_path / "case")]) == 0
    assert cli.main(["render", str(tmp_path / "case")]) == 0  # within the same second: a second file
    logs = sorted((tmp_path / "case" / "logs").glob("*-render*.log"))
    assert len(logs) == 2 and all("drawn ünd done" in log.read_text(encoding="utf-8") for log in logs)


def test_logs_fall_back_to_where_they_can_be_written(tmp_path, state_folder):
    (tmp_path / "case.json").write_text("{}", encoding="utf-8")
    (tmp_path / "logs").write_text("a file where the folder should be", encoding="utf-8")
    with log_file("train", tmp_path) as path:
        logging.getLogger("anything").warning("kept")
    assert path.parent == state_folder and "kept" in path.read_text(encoding="utf-8")


def test_a_command_needs_no_place_for_its_log(tmp_path, monkeypatch, capsys):
    """A service's user without a home, a case that one may not look into, and disks that are all full."""
    places = (
        (cli_logs, "state_folder", RuntimeError("Could not determine home directory.")),
        (tempfile, "gettempdir", FileNotFoundError("No usable temporary directory found")),
        (Path, "is_file", PermissionError(errno.EACCES, "Permission denied")),
    )
    stand_in_command(monkeypatch, lambda _args, _progress: print("done"))
    for owner, name, error in places:
        with monkeypatch.context() as patch:
            patch.setattr(owner, name, Mock(side_effect=error))
            assert cli.main(["render", str(tmp_path)]) == 0
    assert capsys.readouterr().out.split() == ["done"] * 3


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_reader_that_has_gone_ends_no_command(tmp_path, inputs, unbuffered):
    """As after `| head`, or a `| tee` that was ended while the training went on."""
    reading, writing = os.pipe()
    os.close(reading)
    command = [sys.executable, "-m", "ExpectedAppearancesLib", *new_arguments(tmp_path / "case", inputs)]
    environment = os.environ | {"PYTHONUNBUFFERED": unbuffered, "XDG_STATE_HOME": str(tmp_path)}
    done = subprocess.run(command, stdout=writing, stderr=writing, cwd=ROOT, env=environment, check=False)
    os.close(writing)
    assert done.returncode == 0
    (log,) = (tmp_path / "expected-appearances" / "logs").glob("*.log")
    assert "exit code 0" in log.read_text(encoding="utf-8")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no disk here is always full")
def test_a_log_on_a_full_disk_takes_nothing_from_the_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        "ExpectedAppearancesLib.cli.logs._first_writable", lambda *_: (tmp_path, logging.FileHandler("/dev/full"))
    )
    stand_in_command(monkeypatch, lambda _args, progress: progress(1.0, "drawn"))
    assert cli.main(["render", str(tmp_path)]) == 0
    assert capsys.readouterr().err == "100 %  drawn\n"


@pytest.mark.skipif(os.name == "nt", reason="Windows ends processes without a signal")
def test_termination_cancels_and_the_usual_handler_returns(tmp_path, monkeypatch, capsys):
    def run(_args, _progress):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5)
        raise AssertionError("went on after SIGTERM")

    before = signal.getsignal(signal.SIGTERM)
    stand_in_command(monkeypatch, run)
    assert cli.main(["render", str(tmp_path)]) == 3
    assert "Cancelled" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGTERM) is before


def test_runs_outside_the_main_thread(tmp_path, monkeypatch):
    """Signals can only be handled in the main thread; a caller's worker thread must still get its code."""
    stand_in_command(monkeypatch, lambda _args, _progress: None)
    codes = []
    thread = threading.Thread(target=lambda: codes.append(cli.main(["render", str(tmp_path)])))
    thread.start()
    thread.join(10)
    assert codes == [0]


# --- progress ----------------------------------------------------------------------------------------------------


def test_progress_prints_at_most_two_lines_a_second_and_always_the_last(capsys):
    now_s = 0.0
    progress = Progress(clock=lambda: now_s)
    for step in range(1, 100):
        now_s = step * 0.1  # 10 calls a second, 100 s in all would be 1 % each 0.1 s
        progress(step / 100, f"step {step}")
    progress.finish()
    lines = capsys.readouterr().err.splitlines()
    assert 18 <= len(lines) <= 22
    assert lines[0].startswith("  1 %  step 1") and "step 99" in lines[-1]
    assert "(5 s left)" in next(line for line in lines if "step 51" in line)  # 49 steps of 0.1 s


def test_time_left_of_a_resumed_run_counts_only_what_this_run_did(capsys):
    now_s = 0.0
    progress = Progress(clock=lambda: now_s)
    progress(0.8, "resumed")
    now_s = 100.0
    progress(0.9, "half of the rest")
    assert "(1 min 40 s left)" in capsys.readouterr().err


def test_durations():
    assert [duration(s) for s in (0.4, 59.6, 200, 7500)] == ["0 s", "1 min 00 s", "3 min 20 s", "2 h 05 min"]


# --- new -----------------------------------------------------------------------------------------------------------


def test_new_makes_a_case(tmp_path, inputs, capsys):
    assert cli.main([*new_arguments(tmp_path / "Fall 1", inputs), "--space", "RAS"]) == 0
    assert Case.open(tmp_path / "Fall 1").space == "RAS"
    assert "30 vertices" in capsys.readouterr().out


def test_new_from_field_of_view(tmp_path, inputs):
    view = ["--field-of-view-mm", "60", "--working-distance-mm", "300", "--image-size", "640x480"]
    assert cli.main(["new", str(tmp_path / "case"), "--vessels", inputs["vessels.vtp"], *view]) == 0
    camera = Case.open(tmp_path / "case").camera
    assert (camera.width, camera.height, camera.fx, camera.cx) == (640, 480, 3200.0, 319.5)


def test_new_lists_every_problem_and_writes_nothing(tmp_path, inputs, capsys):
    write_vtp(Path(inputs["cortex.vtp"]), Mesh(np.eye(3) * 0.01, np.array([[0, 1, 2]])))
    Path(inputs["camera.json"]).write_text('{"width": 320, ', encoding="utf-8")
    before = sorted(tmp_path.rglob("*"))
    assert cli.main(new_arguments(tmp_path / "case", inputs, vessels=tmp_path / "none.stl")) == 2
    text = capsys.readouterr().err
    assert "3 problems" in text
    assert all(words in text for words in ("none.stl: vessel mesh not found", "metres", "camera.json: camera cannot"))
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ([], "give --camera FILE"),
        (["--field-of-view-mm", "60"], "--working-distance-mm, --image-size"),
        (["--field-of-view-mm", "0", "--working-distance-mm", "300", "--image-size", "640x480"], "must be above 0"),
        (["--field-of-view-mm", "nan", "--working-distance-mm", "300", "--image-size", "640x480"], "not a number"),
        (["--camera", "camera.json", "--image-size", "640x480"], "already gives the field of view"),
    ],
)
def test_new_with_a_camera_that_is_not_one_reports_the_meshes_too(tmp_path, capsys, extra, words):
    assert cli.main(["new", str(tmp_path / "case"), "--vessels", str(tmp_path / "none.vtp"), *extra]) == 2
    text = capsys.readouterr().err
    assert words in text and "none.vtp: vessel mesh not found" in text
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("size", ["640", "640x", "axb", "0x480", "640x-480"])
def test_new_refuses_image_sizes_that_are_none(tmp_path, capsys, size):
    assert cli.main(["new", str(tmp_path / "c"), "--vessels", "v.vtp", "--image-size", size]) == 2
    assert "is not a size such as" in capsys.readouterr().err


def test_new_leaves_an_existing_case_as_it_was(tmp_path, inputs):
    assert cli.main(new_arguments(tmp_path / "case", inputs)) == 0
    before = {path: path.read_bytes() for path in (tmp_path / "case").rglob("*")}
    assert cli.main(new_arguments(tmp_path / "case", inputs)) == 2
    assert {path: path.read_bytes() for path in (tmp_path / "case").rglob("*")} == before


# --- check ---------------------------------------------------------------------------------------------------------


def test_check_reports_this_machine(monkeypatch, capsys):
    monkeypatch.setattr(system_findings, "_devices", lambda: [{"name": "Some GPU", "memory_gb": 16.0}])
    code = cli.main(["check", "--json"])
    report = json.loads(capsys.readouterr().out)
    assert code == (1 if report["problems"] else 0)
    assert report["packages"]["numpy"] == np.__version__
    assert report["weights_mb"]["vgg16_imagenet_to_conv5_1_fp16.safetensors"] > 10
    assert report["disk_free_gb"] > 0 and report["cpu"]["cores"] >= 1
    monkeypatch.setattr(system_findings, "make_report", lambda: report)
    cli.main(["check"])
    text = capsys.readouterr().out
    assert "GPU: Some GPU, 16.0 GB" in text and f"Package numpy: {np.__version__}" in text


def test_check_survives_broken_graphics_and_missing_packages(monkeypatch, capsys):
    def version(name):
        if name in ("onnxruntime", "onnxruntime-gpu", "onnxruntime-directml", "torch", "slicer-core"):
            raise system_findings.metadata.PackageNotFoundError(name)
        return "1.0"

    monkeypatch.setattr(system_findings.metadata, "version", version)
    monkeypatch.setattr(system_findings, "RENDER_SPHERE", "import os; os.abort()")
    monkeypatch.setattr(system_findings, "WEIGHTS_FOLDER", Path("none"))
    assert cli.main(["check"]) == 1
    text = capsys.readouterr().out
    assert "Package torch: not installed" in text and "Package slicer-core: not installed" in text
    problems = [line for line in text.splitlines() if line.startswith("PROBLEM")]
    assert len(problems) == 4
    assert "onnxruntime is not installed, register cannot work; run: pip install onnxruntime" in text
    assert "apt-get install libegl1 libgl1-mesa-dri libosmesa6" in text
