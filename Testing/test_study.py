"""The study: figures against hand computation, folds that are not trained twice, kills, cancelling."""

from __future__ import annotations

import functools
import itertools
import json
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cases import camera, wait_until, write_inputs

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.appearances import store
from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.cli import main
from ExpectedAppearancesLib.errors import CancelledError, ExpectedAppearancesError, InputError
from ExpectedAppearancesLib.evaluation import study, study_folds, study_inputs
from ExpectedAppearancesLib.evaluation.study_report import write_study_report
from ExpectedAppearancesLib.evaluation.verdict import figures_of_study
from ExpectedAppearancesLib.geometry.camera import write_camera
from ExpectedAppearancesLib.geometry.pose import look_at, pose_from_rotation
from ExpectedAppearancesLib.interpreter import library_environment
from ExpectedAppearancesLib.registration.poses_file import read_poses, write_poses
from ExpectedAppearancesLib.registration.predictor import Prediction, Predictor

SHIFT_MM = {"a": 1.0, "b": 2.0, "c": 4.0}
QUICK = study.StudySettings(protocols=("strict",), steps=5)

# A training that takes no time: notes how it was called, then leaves what `train` leaves.
STAND_IN = """
import json, os, pathlib, sys, time
words = sys.argv[1:]
folder = pathlib.Path(words[words.index("--model-folder") + 1])
here = pathlib.Path(__file__).parent
with open(here / "calls.txt", "a") as stream:
    stream.write(json.dumps(words) + "\\n")
(here / "pid").write_text(str(os.getpid()))
print(" 50 %  step 1, loss 0.5 (3 s left)", file=sys.stderr, flush=True)
while (here / "wait").exists() and folder.name in (here / "wait").read_text():
    time.sleep(0.05)
    print(" 60 %  step 2", file=sys.stderr, flush=True)
if (here / "fail").exists():
    print("train: 1 problem with the input", "  - a.png: damaged", sep="\\n", file=sys.stderr)
    sys.exit(int((here / "fail").read_text()))
folder.mkdir(parents=True, exist_ok=True)
(folder / "model.onnx").write_text("model of " + folder.name)
figures = {"steps": 5, "seconds": 1.0, "add_mm_mean": 2.0}
(folder / "checkpoint.safetensors").write_text("")
(folder / "training.json").write_text(json.dumps({"validation": figures}))
"""


class ShiftedPredictor:
    """Answers the true pose moved along x by its style's distance; the first pixel of a frame is its number."""

    known: Path
    styles = ()  # that it was trained on

    def __init__(self, folder, _threads=2):
        self.folder = Path(folder)
        self.meta = {"preset": "quick", "styles": self.styles}
        self.frames = read_poses(self.known)[1]

    def predict(self, image_rgb, _camera):
        frame = self.frames[int(image_rgb[0, 0, 0]) % len(self.frames)]
        pose = pose_from_rotation(np.eye(3), (SHIFT_MM[frame.style], 0, 0)) @ frame.camera_from_world
        return Prediction(pose, frame.style != "c", 0.5, 7.0)


def make_case(folder: Path, styles: str = "abc") -> tuple[Path, Path]:
    """(case folder, poses.json with three frames of each style)."""
    paths = write_inputs(folder)
    case = Case.create(folder / "case", paths["vessels.vtp"], paths["cortex.vtp"], paths["camera.json"])
    items = []
    for style in styles:
        files.write_png(store.folder_of(case, "surface") / f"{style}.png", np.full((8, 8, 3), 90, np.uint8))
        item = {"image": f"{style}.png", "labels": "o.png", "style": style, "seed": 0, "gram_distance": 0.0}
        items.append(item | {"camera_from_world": np.eye(4).tolist()})
    store.write_index(case, "surface", camera(), {}, items, done=True)
    frames = []
    for i, style in enumerate(styles * 3):
        image = np.full((96, 96, 3), 90, np.uint8)
        image[0, 0] = i
        files.write_png(folder / "frames" / f"{i}.png", image)
        pose = look_at(np.array([4.0 * (i // len(styles)), 5.0, 80.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
        frames.append({"image": folder / "frames" / f"{i}.png", "camera_from_world": pose, "style": style})
    write_poses(folder / "frames" / "poses.json", camera(), frames)
    return case.folder, folder / "frames" / "poses.json"


@pytest.fixture
def studied(tmp_path, monkeypatch):
    """Case folder, poses, and the folder of the stand-in training."""
    case_folder, poses = make_case(tmp_path)
    trainer = tmp_path / "trainer"
    trainer.mkdir()
    (trainer / "train.py").write_text(STAND_IN)
    monkeypatch.setattr(study_folds, "COMMAND", (sys.executable, str(trainer / "train.py")))
    monkeypatch.setattr(ShiftedPredictor, "known", poses, raising=False)
    monkeypatch.setattr("ExpectedAppearancesLib.registration.predictor.Predictor", ShiftedPredictor)
    return SimpleNamespace(case=case_folder, poses=poses, trainer=trainer, out=tmp_path / "out")


@pytest.fixture
def no_pictures(monkeypatch):
    """Pictures are most of a study's time here, and some tests look at none."""
    monkeypatch.setattr(study, "_write_overlays", lambda *_: None)
    monkeypatch.setattr("ExpectedAppearancesLib.evaluation.study_report.write_study_report", lambda *_: None)


def calls(studied) -> list[list[str]]:
    path = studied.trainer / "calls.txt"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def run(studied, settings=QUICK):
    return study.run_study([(studied.case, studied.poses)], studied.out, settings)[0]


def test_figures_of_both_protocols_are_those_computed_by_hand(studied):
    before = (studied.case / "case.json").read_bytes()
    result = run(studied, replace(QUICK, protocols=("strict", "loto")))
    assert result == study.read_study(studied.case) == json.loads(study.study_path(studied.case).read_text())
    for protocol in ("strict", "loto"):
        figures = result["protocols"][protocol]
        assert {s: m["add_mm"]["mean"] for s, m in figures["per_style"].items()} == pytest.approx(SHIFT_MM)
        assert figures["all"]["add_mm"]["mean"] == pytest.approx(7 / 3)
        assert figures["all"]["accuracy"] == pytest.approx({"3mm-3deg": 2 / 3, "5mm-5deg": 1.0})
        assert (figures["all"]["frames"], figures["all"]["refused"]) == (9, 3)
        assert figures["all"]["accepted_only"]["add_mm"]["mean"] == pytest.approx(1.5)
        curve = result["thresholds"][protocol]
        assert curve["add_auc_20mm"] == pytest.approx(1 - 7 / 60)
        shares = dict(zip(curve["limits"], curve["add"]))
        assert shares == {n: pytest.approx(sum(s < n for s in (1, 2, 4)) / 3) for n in np.arange(81) / 4}
    assert len(figures_of_study(result)) == 2 * (1 + 3)  # what the planning panel shows
    made = {(words[words.index("--exclude") + 1], "--poses" in words) for words in calls(studied)}
    assert made == {(style, repeats) for style in "abc" for repeats in (False, True)}
    assert all(words[0] == "train" and words[words.index("--steps") + 1] == "5" for words in calls(studied))
    assert not list(studied.case.rglob("checkpoint.safetensors"))
    assert (studied.case / "case.json").read_bytes() == before and not (studied.case / "model").exists()


def test_report_is_one_file_with_its_pictures(studied):
    run(studied, replace(QUICK, protocols=("strict", "loto"), robustness=True, robustness_frames=3))
    html = (studied.out / "report.html").read_text(encoding="utf-8")
    assert html.count("data:image/") == 6 and not re.search(r'src="(?!data:)', html)
    assert "2.33" in html and "66.7" in html and "<details>" in html and "brain shift" in html
    assert "unseen poses): trained for 5 steps." in html  # those of another length may stand beside them
    robustness = study.read_study(studied.case)["robustness"]
    assert robustness["undisturbed"]["add_mm"]["mean"] == pytest.approx(7 / 3)
    for name in ("curves.png", "textures.png"):
        assert files.read_image_rgb(studied.out / name).std() > 5


def test_robustness_is_told_of_the_model_it_was_measured_with(studied, monkeypatch):
    """With textures that it was trained on, and no longer once the case's model is another one."""
    monkeypatch.setattr(study, "_write_overlays", lambda *_: None)
    few = {"robustness": True, "robustness_frames": 1, "protocols": ()}
    files.write_bytes(studied.case / "model" / "model.onnx", b"first")
    assert run(studied, replace(QUICK, **few))["robustness"]["model"] == "the case's own model (quick)"
    monkeypatch.setattr(ShiftedPredictor, "styles", ["a", "b", "z"])
    run(studied, replace(QUICK, **few))
    assert "robustness" in run(studied)
    assert "(quick), which was trained on 2 of their 3 textures" in (studied.out / "report.html").read_text("utf-8")
    files.write_bytes(studied.case / "model" / "model.onnx", b"trained again")
    assert "robustness" not in run(studied)
    assert "own model" not in (studied.out / "report.html").read_text("utf-8")


def test_cases_that_are_called_alike_keep_apart_in_one_report(studied, tmp_path, monkeypatch):
    monkeypatch.setattr(study, "_write_overlays", lambda *_: None)
    other, poses = make_case(tmp_path / "other")
    pairs = [(studied.case, studied.poses), (other, poses)]
    results = study.run_study(pairs, studied.out, replace(QUICK, styles=("a", "b")))
    assert [set(r["protocols"]["strict"]["per_style"]) for r in results] == [{"a", "b"}] * 2
    assert set(json.loads((studied.out / "study.json").read_text())) == {f"{tmp_path.name}/case", "other/case"}
    assert "other/case, quick, strict" in (studied.out / "report.html").read_text(encoding="utf-8")
    assert len(calls(studied)) == 4 and study.read_study(other) == results[1]


def test_a_finished_fold_is_trained_again_only_when_what_it_depends_on_changed(studied, no_pictures):
    both = replace(QUICK, protocols=("strict", "loto"))
    run(studied, both)
    run(studied, both)
    assert len(calls(studied)) == 6
    camera_of, frames = read_poses(studied.poses)
    write_poses(studied.poses, camera_of, [f.to_dict() | {"note": "moved"} for f in frames])
    run(studied, both)  # other poses: those of the paper's form are
    assert len(calls(studied)) == 9 and all("--poses" in words for words in calls(studied)[6:])
    (studied.case / "study" / "folds" / "quick-strict-b" / "model.onnx").write_text("cut")
    run(studied, both)
    assert len(calls(studied)) == 10 and calls(studied)[9][calls(studied)[9].index("--exclude") + 1] == "b"
    run(studied, replace(both, steps=6))
    assert len(calls(studied)) == 16


def test_folds_of_an_older_version_are_trained_anew(studied, no_pictures, monkeypatch):
    """A study that goes on after an update ended, after its other trainings, with a model that cannot be read."""
    monkeypatch.setattr(study, "MODEL_VERSION", study.MODEL_VERSION - 1)
    run(studied, replace(QUICK, styles=("a",)))
    monkeypatch.undo()
    jobs = study._jobs(study_inputs.open_studied(studied.case, studied.poses, QUICK), QUICK)
    assert not any(map(study_folds.is_trained, jobs))


def test_folds_are_trained_anew_where_the_craniotomy_was_moved(studied, no_pictures):
    """Their training drew its poses around it; appearances and ranges stay as they are."""
    for x_mm, trained in ((0.0, 3), (8.0, 6), (8.0, 6)):
        craniotomy = {"centre_world_mm": [x_mm, 0.0, 0.0], "outward_axis": [0.0, 0.0, 1.0], "up": [0.0, 1.0, 0.0]}
        Case.open(studied.case).record("render", ranges={"tilt_max_deg": 50.0}, craniotomy=craniotomy)
        run(studied)
        assert len(calls(studied)) == trained


def test_frames_are_registered_anew_when_the_camera_beside_their_poses_was_corrected(studied, no_pictures, monkeypatch):
    """As intrinsics are that were wrong at first; the poses file itself, which names their file, stays the same."""
    told = []
    usual = ShiftedPredictor.predict
    monkeypatch.setattr(ShiftedPredictor, "predict", lambda *a: told.append(a[2].fx) or usual(*a))
    camera_path = studied.poses.parent / "camera.json"
    studied.poses.write_text(json.dumps(json.loads(studied.poses.read_text()) | {"camera": camera_path.name}))
    for fx in (180.0, 190.0, 190.0):
        write_camera(camera_path, replace(camera(), fx=fx))
        run(studied)
    assert told == [180.0] * 9 + [190.0] * 9 and len(calls(studied)) == 3


def test_frames_that_were_made_anew_under_their_names_are_registered_anew(studied, no_pictures, monkeypatch):
    """The report gave the figures of images that were not there any more. Models are not trained on them, and stay."""
    told = []
    usual = ShiftedPredictor.predict
    monkeypatch.setattr(ShiftedPredictor, "predict", lambda *a: told.append(a[1][5, 5, 0]) or usual(*a))
    both = replace(QUICK, protocols=("strict", "loto"))
    run(studied, both)
    image = files.read_image_rgb(studied.poses.parent / "3.png")
    image[5, 5] = 91
    files.write_png(studied.poses.parent / "3.png", image)
    assert set(run(studied)["presets"]["quick"]) == {"strict"}  # the other protocol's figures are of the old one
    assert told.count(91) == 1 and len(calls(studied)) == 6
    run(studied, both)
    assert told.count(91) == 2 and len(calls(studied)) == 6


def test_later_parts_are_added_to_the_study_and_other_inputs_begin_a_new_one(studied, no_pictures):
    run(studied)
    run(studied, replace(QUICK, presets=("paper",)))
    result = run(studied, replace(QUICK, protocols=("loto",), presets=("quick",)))
    assert set(result["presets"]) == {"quick", "paper"} and set(result["presets"]["quick"]) == {"strict", "loto"}
    assert result["preset"] == "quick" and set(result["protocols"]) == {"strict", "loto"}
    camera_of, frames = read_poses(studied.poses)
    write_poses(studied.poses, camera_of, [f.to_dict() for f in frames[:6]])
    assert set(run(studied)["presets"]) == {"quick"}


def test_a_study_that_is_killed_goes_on(studied, tmp_path):
    """Killed while the second fold is trained: the first is kept, and the training does not outlive the study long."""
    (studied.trainer / "wait").write_text("quick-strict-b")
    driver = tmp_path / "driver.py"
    driver.write_text(
        "import sys; from pathlib import Path\n"
        "from ExpectedAppearancesLib.evaluation import study, study_folds\n"
        f"study_folds.COMMAND = (sys.executable, {str(studied.trainer / 'train.py')!r})\n"
        f"settings = study.StudySettings(protocols=('strict',), steps=5)\n"
        f"study.run_study([({str(studied.case)!r}, {str(studied.poses)!r})], Path({str(studied.out)!r}), settings)\n"
    )
    process = subprocess.Popen([sys.executable, str(driver)], env=library_environment())
    wait_until(lambda: len(calls(studied)) == 2)
    child = int((studied.trainer / "pid").read_text())
    process.send_signal(getattr(signal, "SIGKILL", signal.SIGTERM))
    process.wait(30)
    wait_until(lambda: not alive(child))
    assert not study.study_path(studied.case).exists()
    (studied.trainer / "wait").unlink()
    result = run(studied)
    assert [words[words.index("--exclude") + 1] for words in calls(studied)] == ["a", "b", "b", "c"]
    assert result["protocols"]["strict"]["all"]["frames"] == 9


def alive(process_id: int) -> bool:
    try:
        os.kill(process_id, 0)
    except OSError:
        return False
    path = Path(f"/proc/{process_id}/stat")
    return not (path.exists() and path.read_text().rpartition(")")[2].split()[0] == "Z")


def some_job(studied) -> study_folds.FoldJob:
    one = study_inputs.open_studied(studied.case, studied.poses, QUICK)
    return study._jobs(one, QUICK)[0]


def test_a_stopped_fold_leaves_no_process_and_says_what_it_did(studied):
    (studied.trainer / "wait").write_text("quick-strict-a")
    job, heard = some_job(studied), []
    title = "quick model without a, unseen poses"
    with pytest.raises(CancelledError):
        study_folds.train_fold(
            job, lambda fraction, text: heard.append((fraction, text)), lambda: (0.6, f"{title}: step 2") in heard
        )
    assert (0.5, f"{title}: step 1, loss 0.5") in heard
    assert not alive(int((studied.trainer / "pid").read_text())) and not study_folds.is_trained(job)


@pytest.mark.parametrize(("code", "kind"), [(2, InputError), (1, ExpectedAppearancesError), (3, CancelledError)])
def test_a_fold_that_fails_says_what_its_training_said(studied, code, kind):
    (studied.trainer / "fail").write_text(str(code))
    with pytest.raises(kind, match=r"quick-strict-a[\s\S]*a\.png: damaged"):
        study_folds.train_fold(some_job(studied))


def test_texture_subsets_are_nested_and_never_hold_what_is_tested():
    textures = [f"t{i:02d}" for i in range(20)]
    left_out, subsets = study.texture_subsets(textures, textures[:5], 0)
    assert set(left_out) <= set(textures[:5]) and len(left_out) == 3
    assert [len(s) for s in subsets] == list(range(3, 13))
    assert all(set(a) < set(b) and not set(b) & set(left_out) for a, b in itertools.pairwise(subsets))
    assert [len(s) for s in study.texture_subsets(textures[:8], textures[:8], 0)[1]] == [3, 4, 5]


def test_number_of_textures_trains_on_exactly_that_many(tmp_path, studied, monkeypatch):
    folder, poses = make_case(tmp_path / "seven", "abcdefg")
    monkeypatch.setattr(ShiftedPredictor, "known", poses)
    monkeypatch.setitem(SHIFT_MM, "d", 4.0)
    for style in "efg":
        monkeypatch.setitem(SHIFT_MM, style, 4.0)
    result = study.run_study([(folder, poses)], studied.out, replace(QUICK, protocols=(), textures_study=True))[0]
    rows, left_out = result["textures"]["rows"], result["textures"]["left_out"]
    assert [row["textures"] for row in rows] == [3, 4]
    expected = np.mean([SHIFT_MM[style] for style in left_out])
    for row, words in zip(rows, calls(studied)):
        begin = words.index("--exclude") + 1
        excluded = words[begin : begin + 7 - row["textures"]]
        assert set(excluded) == set("abcdefg") - set(row["trained_on"]) and set(left_out) <= set(excluded)
        assert "--no-inner-texture" in words
        assert row["metrics"]["add_mm"]["mean"] == pytest.approx(expected) and row["metrics"]["frames"] == 9
    html = (studied.out / "report.html").read_text(encoding="utf-8")
    assert "Number of textures" in html and "they were trained for 5 steps." in html
    # On a busy computer time ends trainings, each at another step.
    rows[1]["training"]["steps"] = 4
    write_study_report(studied.out, [(folder, result)])
    html = (studied.out / "report.html").read_text(encoding="utf-8")
    assert "they were trained for 4 to 5 steps, so models differ in more" in html


def test_poses_that_training_sees_are_not_called_unseen(studied, monkeypatch):
    """The paper's preset makes every pose with every texture: frames drawn of one are at poses of the others."""
    case = Case.open(studied.case)
    index = store.read_index(case, "surface")
    for style in "abc":
        files.write_png(store.folder_of(case, "image") / f"{style}.png", np.full((8, 8, 3), 90, np.uint8))
    write_index = functools.partial(store.write_index, case, "image", camera(), {}, done=True)
    write_index(index["items"])
    monkeypatch.setattr(study_inputs, "drawn_frames", lambda *_: studied.poses)
    unasked = [(studied.case, None)]
    for settings in (QUICK, replace(QUICK, protocols=(), textures_study=True)):
        with pytest.raises(InputError, match="loto alone"):
            study.run_study(unasked, studied.out, replace(settings, method="image"))
    assert not calls(studied)
    study_inputs.check_study(unasked, studied.out, replace(QUICK, protocols=("loto",), method="image"), lambda *_: None)
    poses = [pose_from_rotation(np.eye(3), (i, 0, 80)).tolist() for i in range(3)]
    write_index([item | {"camera_from_world": pose} for item, pose in zip(index["items"], poses)])
    study_inputs.check_study(unasked, studied.out, replace(QUICK, method="image"), lambda *_: None)
    # And poses that no training sees are not called seen: no other texture's appearance is at a frame's pose.
    with pytest.raises(InputError, match="strict alone"):
        study.run_study(unasked, studied.out, replace(QUICK, protocols=("loto",), method="image"))


def test_all_problems_at_once_and_nothing_trained(studied, tmp_path, capsys):
    argv = ["study", str(studied.case), "--poses", str(studied.poses), "--out", str(studied.out)]
    wrong = [
        "--protocols",
        "lotto",
        "--preset",
        "fast",
        "--steps",
        "0",
        "--seed",
        "-2",
        "--styles",
        "z",
        "--executor",
        "ray://x",
    ]
    assert main([*argv, *wrong, "--textures-study"]) == 2
    text = capsys.readouterr().err
    assert all(
        word in text for word in ("'lotto'", "'fast'", "--steps: 0", "--seed: -2", "'z'", "ray://x", "at least 6")
    )
    assert main([*argv[:3], str(studied.poses), str(studied.poses), *argv[4:]]) == 2
    assert "2 files for 1 case" in capsys.readouterr().err
    assert not calls(studied) and not studied.out.exists()
    camera_of, frames = read_poses(studied.poses)
    write_poses(studied.poses, camera_of, [f.to_dict() | {"style": "elsewhere"} for f in frames])
    with pytest.raises(InputError, match="called like a texture"):
        run(studied)


def test_frames_that_cannot_be_registered_are_told_before_anything_is_trained(studied):
    (studied.poses.parent / "2.png").write_bytes(b"cut")
    files.write_png(studied.poses.parent / "7.png", np.zeros((96, 128, 3), np.uint8))
    with pytest.raises(InputError) as caught:
        run(studied)
    assert [name in text for name, text in zip(("2.png", "7.png"), caught.value.problems)] == [True, True]
    assert not calls(studied)
    pairs, of_another = [(studied.case, studied.poses)], replace(QUICK, styles=("a",))
    assert study_inputs.check_study(pairs, studied.out, of_another, lambda *_: None)  # it registers neither


def test_a_model_that_cannot_be_tested_for_robustness_is_told_before_anything_is_trained(studied, monkeypatch):
    monkeypatch.setattr("ExpectedAppearancesLib.registration.predictor.Predictor", Predictor)
    files.write_json(studied.case / "model" / "model.json", {"format_version": 1})
    files.write_bytes(studied.case / "model" / "model.onnx", b"")
    with pytest.raises(InputError, match="older version"):
        run(studied, replace(QUICK, robustness=True))
    assert not calls(studied) and not (studied.case / "study" / "folds").exists()


def test_a_study_of_another_format_is_not_read(studied):
    assert study.read_study(studied.case) is None
    files.write_json(study.study_path(studied.case), {"format": "else"})
    with pytest.raises(InputError, match="run `study` again"):
        study.read_study(studied.case)
