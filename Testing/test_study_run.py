"""A study as the planning panel starts it: a run in a process of its own, cancelled, resumed, and its figures shown."""

from __future__ import annotations

import os
import re
import time
from types import SimpleNamespace

import numpy as np
import pytest
from cases import write_inputs
from test_study import STAND_IN, calls

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.appearances import store
from ExpectedAppearancesLib.appearances.overview import overview_view
from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.cli import main
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.evaluation import study_frames
from ExpectedAppearancesLib.evaluation.verdict import Limits
from ExpectedAppearancesLib.masks.renderer import MaskRenderer
from ExpectedAppearancesLib.masks.stage import craniotomy_of, parenchyma_of, render_case
from ExpectedAppearancesLib.planning.recorded import CaseReader
from ExpectedAppearancesLib.planning.steps import Study
from ExpectedAppearancesLib.registration.poses_file import read_poses
from ExpectedAppearancesLib.runs import runner
from ExpectedAppearancesLib.runs.results import result_problem
from ExpectedAppearancesLib.runs.runner import Run
from ExpectedAppearancesLib.runs.state import RunState

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals")
COLOURS = {"a": (225, 170, 160), "b": (120, 190, 90)}
# The command of the runner, with a training that takes no time and a model that always answers the same pose.
DRIVER = """
import re
import sys
import numpy as np
from ExpectedAppearancesLib.evaluation import study_folds
from ExpectedAppearancesLib.registration import predictor
from ExpectedAppearancesLib.cli import command_line_module

class Answering:
    def __init__(self, folder):
        self.meta = {"preset": "quick"}
    def predict(self, image, camera):
        pose = np.eye(4)
        pose[2, 3] = 80
        return predictor.Prediction(pose, True, 0.5, 1.0)

predictor.Predictor = Answering
study_folds.COMMAND = (sys.executable, sys.argv[1])
if __name__ == "__main__":
    sys.exit(command_line_module.main(sys.argv[2], sys.argv[3:]))
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Case:
    """A case with appearances in plain colours, one for each texture."""
    folder = tmp_path_factory.mktemp("study Fälle")
    paths = write_inputs(folder)
    case = Case.create(folder / "case", paths["vessels.vtp"], paths["cortex.vtp"], paths["camera.json"])
    render_case(case, lambda *_: None, poses=2)
    craniotomy = craniotomy_of(case)
    camera, pose = overview_view(craniotomy, parenchyma_of(case, craniotomy), 96)
    with MaskRenderer(case.vessels, case.cortex, camera) as renderer:
        labels = renderer.render(pose)
    where, items = store.folder_of(case, "surface"), []
    files.write_png(where / "overview.labels.png", labels)
    for style, colour in COLOURS.items():
        image = np.uint8([(0, 0, 0), colour, (60, 30, 200)])[labels]
        files.write_png(where / f"{style}-0.png", image)
        item = {"image": f"{style}-0.png", "labels": "overview.labels.png", "style": style, "seed": 0}
        items.append(item | {"gram_distance": 0.0, "camera_from_world": pose.tolist()})
    store.write_index(case, "surface", camera, {}, items, done=True)
    return case


@pytest.fixture
def studied(made, tmp_path, monkeypatch):
    trainer = tmp_path / "trainer"
    trainer.mkdir()
    (trainer / "train.py").write_text(STAND_IN)
    (trainer / "driver.py").write_text(DRIVER)

    def command(kind, case, arguments, python):
        return [python, str(trainer / "driver.py"), str(trainer / "train.py"), kind, str(case), *arguments]

    monkeypatch.setattr(runner, "command_of", command)
    return SimpleNamespace(case=made, trainer=trainer)


def until(run: Run, condition):
    end = time.monotonic() + 300
    while not condition(status := run.poll()):
        assert status.state.active and time.monotonic() < end, status
        time.sleep(0.05)
    return status


def test_a_study_runs_is_cancelled_resumed_and_fills_the_table(studied):
    folder, options = studied.case.folder, ["--frames", "3", "--preset", "quick", "--minutes", "1"]
    reader = CaseReader()
    assert reader.recorded(str(folder), "surface", Limits()).study is Study.NONE
    (studied.trainer / "wait").write_text("quick-strict-b")
    run = Run.start("study", folder, options)
    status = until(run, lambda s: re.search(r"^2 of \d: quick model without b, unseen poses: ", s.message))
    assert status.state is RunState.RUNNING and 0 < status.fraction < 0.85
    with pytest.raises(InputError, match="going on"):
        Run.start("study", folder, options)
    run.cancel()
    assert run.wait(120).state is RunState.CANCELLED
    recorded = reader.recorded(str(folder), "surface", Limits())
    assert recorded.study is Study.STOPPED and recorded.verdict is None
    assert "not found" in result_problem("study", folder)

    (studied.trainer / "wait").unlink()
    run = Run.start("study", folder, options)
    status = run.wait(300)
    assert status.state is RunState.DONE, status.problem
    names = [words[words.index("--exclude") + 1] for words in calls(studied)]
    assert names == ["a", "b", "b", "a", "b"]  # of the first run a, and b until it was cancelled
    recorded = reader.recorded(str(folder), "surface", Limits())
    assert recorded.study is Study.DONE and recorded.validation == "known" and recorded.verdict[0] is False
    rows = reader.figures(studied.case)[0]
    assert [(row.protocol, row.style) for row in rows] == [(p, s) for p in ("strict", "loto") for s in ("", "a", "b")]
    assert all(row.add_mm_mean > 0 for row in rows)
    assert (folder / "study" / "report" / "report.html").is_file()
    assert list((folder / "logs").glob("*-study.log"))


def test_drawn_frames_show_their_texture_at_the_pose_they_say(made):
    heard = []
    path = study_frames.drawn_frames(made, None, 4, 0, lambda fraction, text: heard.append((fraction, text)))
    camera, frames = read_poses(path)
    assert [frame.style for frame in frames] == ["a"] * 4 + ["b"] * 4
    assert heard[0] == (0.0, "drawing test frames of a") and heard[-1][0] == 7 / 8
    poses = np.array([frame.camera_from_world for frame in frames])
    np.testing.assert_array_equal(poses[:4], poses[4:])
    green = []  # against red, of the tissue between the vessels
    with MaskRenderer(made.vessels, made.cortex, camera) as renderer:
        for frame in frames:
            bare = files.read_image_rgb(frame.image)[renderer.render(frame.camera_from_world) == 1].astype(float)
            green.append(bare[:, 1].mean() / bare[:, 0].mean())
    # Light and lens are those of the frame's number, the colour is the texture's.
    assert all(second > 1.3 * first for first, second in zip(green[:4], green[4:])), green
    before = path.stat().st_mtime_ns
    assert study_frames.drawn_frames(made, "surface", 4, 0).stat().st_mtime_ns == before
    first = files.read_image_rgb(frames[0].image)
    study_frames.drawn_frames(made, None, 4, 1)
    assert (files.read_image_rgb(frames[0].image) != first).any()


def test_the_report_of_several_cases_needs_a_folder(made, capsys):
    assert main(["study", str(made.folder), str(made.folder)]) == 2
    assert "--out: missing" in capsys.readouterr().err
    assert main(["study", str(made.folder), "--frames", "0"]) == 2
    assert "--frames: 0" in capsys.readouterr().err
