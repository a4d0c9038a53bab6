"""The state of each planning step as a table, the verdict, and what is read from a case folder for them."""

from __future__ import annotations

import copy
import json
import os
from dataclasses import replace

import cases
import numpy as np
import pytest

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.appearances import store
from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.evaluation import metrics
from ExpectedAppearancesLib.evaluation.verdict import Limits, figures_of_model, figures_of_study, verdict
from ExpectedAppearancesLib.model.presets import PRESETS
from ExpectedAppearancesLib.planning.recorded import CaseReader, training_state
from ExpectedAppearancesLib.planning.steps import (
    STEPS,
    Chosen,
    Recorded,
    StepState,
    Study,
    changes_of_poses,
    next_step,
    plan_steps,
)

MISSING, READY, RUNNING, STALE, DONE = StepState
CRANIOTOMY = {"centre_world_mm": [1.0, 2.0, 3.0], "outward_axis": [0.0, 0.0, 1.0], "up": [0.0, 1.0, 0.0]}
ROUNDED = CRANIOTOMY | {"outward_axis": [1e-10, 0.0, 1.0]}
RANGES = {
    "tilt_max_deg": 50.0,
    "roll_max_deg": 45.0,
    "working_distance_mm": [80.0, 140.0],
    "lateral_offset_mm": 5.0,
    "in_view_min": 0.6,
}
POSES = {"poses": 100, "seed": 0, "ranges": RANGES, "craniotomy": CRANIOTOMY}
MODEL = {
    "plausible_view": {
        "centre_world_mm": [1.0, 2.0, 3.0],
        "outward_axis": [0.0, 0.0, 1.0],
        "tilt_max_deg": 50.0,
        "distance_mm": [80.0, 140.0],
    }
}
SIX = {f"t{i}": f"sha{i}" for i in range(6)}


def index(done=True, **settings):
    items = [{"style": name, "texture_sha256": sha} for name, sha in SIX.items()]
    return {"done": done, "settings": {"size_px": 384, "iterations": 50} | settings, "items": items}


def finished() -> tuple[Chosen, Recorded]:
    """A case in which everything is done."""
    camera = cases.camera()
    stages = {
        "render": copy.deepcopy(POSES) | {"done": True},
        "synthesize": {"done": True, "updated": "2026-01-01"},
        "train": {"done": True, "updated": "2026-01-02", "preset": {"name": "quick"}, "appearances_sha256": "a"},
    }
    chosen = Chosen(
        "/case",
        True,
        (),
        camera,
        "",
        copy.deepcopy(POSES),
        "",
        dict(SIX),
        "",
        {"size_px": 384, "iterations": 50},
        "quick",
    )
    recorded = Recorded("", {"stages": stages}, camera, index(), False, MODEL, "a", 0, "known", (True, ()))
    return chosen, recorded


def with_stage(recorded: Recorded, name: str, **values) -> Recorded:
    stages = copy.deepcopy(recorded.manifest["stages"])
    stages[name] = stages.get(name, {}) | values
    return replace(recorded, manifest={"stages": stages})


def without(recorded: Recorded, *names: str) -> Recorded:
    stages = {key: value for key, value in recorded.manifest["stages"].items() if key not in names}
    return replace(recorded, manifest={"stages": stages})


def test_a_finished_case_is_done():
    steps = plan_steps(*finished())
    assert {name: step.state for name, step in steps.items()} == dict.fromkeys(STEPS, DONE), steps
    assert next_step(steps) == "validation"


def test_an_empty_panel_says_what_to_do_first():
    steps = plan_steps(Chosen(camera_problem="Choose a calibration file."), Recorded())
    assert next_step(steps) == "case"
    assert "vessel model" in steps["case"].text
    assert {steps[name].state for name in STEPS if name != "textures"} == {MISSING}
    assert all(step.text for step in steps.values())


MOVED = CRANIOTOMY | {"centre_world_mm": [1.0, 2.0, 4.0]}
STEEPER = {**POSES, "ranges": RANGES | {"tilt_max_deg": 60.0}}


@pytest.mark.parametrize(
    ("change", "step", "state", "words"),
    [
        # Case
        (lambda c, r: (replace(c, changed=("vessel model",)), r), "case", STALE, "vessel model"),
        (lambda c, r: (replace(c, changed=("cortex model",)), r), "case", STALE, "cortex model"),
        (lambda c, r: (replace(c, camera=cases.camera(128)), r), "case", STALE, "microscope"),
        (lambda c, r: (replace(c, folder=""), Recorded()), "case", MISSING, "folder"),
        (lambda c, r: (c, Recorded()), "case", READY, "save"),
        (lambda c, r: (replace(c, camera=None), Recorded()), "case", MISSING, "microscope"),
        (lambda c, r: (c, Recorded(problem="vessels.vtp: gone")), "case", MISSING, "vessels.vtp"),
        # Microscope
        (lambda c, r: (replace(c, camera=cases.camera(128)), r), "microscope", STALE, "Save"),
        (lambda c, r: (replace(c, camera=None, camera_problem="x.json: bad"), r), "microscope", MISSING, "x.json"),
        (lambda c, r: (c, Recorded()), "microscope", READY, "Given"),
        # Poses
        (lambda c, r: (replace(c, poses=STEEPER), r), "poses", STALE, "the tilt"),
        (lambda c, r: (replace(c, poses=POSES | {"poses": 50}), r), "poses", STALE, "number of poses"),
        (lambda c, r: (replace(c, poses=POSES | {"craniotomy": MOVED}), r), "poses", STALE, "craniotomy"),
        (lambda c, r: (replace(c, poses=None, poses_problem="no view"), r), "poses", MISSING, "no view"),
        (lambda c, r: (c, with_stage(r, "render", done=False)), "poses", READY, "stopped"),
        (lambda c, r: (c, without(r, "render")), "poses", READY, "draw"),
        (lambda c, r: (replace(c, running=frozenset({"render"})), r), "poses", RUNNING, "drawn"),
        # Textures
        (lambda c, r: (replace(c, textures={}), r), "textures", MISSING, "no textures"),
        (lambda c, r: (replace(c, textures_problem="a.png: bad"), r), "textures", MISSING, "a.png"),
        (lambda c, r: (replace(c, textures={"a": "", "b": ""}), r), "textures", DONE, "Only 2"),
        # Appearances
        (lambda c, r: (replace(c, textures=SIX | {"new": "x"}), r), "appearances", STALE, "new was added"),
        (lambda c, r: (replace(c, textures=SIX | {"t1": "other"}), r), "appearances", STALE, "t1 was changed"),
        (lambda c, r: (replace(c, textures=SIX | {"t1": ""}), r), "appearances", DONE, "6"),
        (lambda c, r: (replace(c, textures={}, textures_problem="gone"), r), "appearances", DONE, "6"),
        (lambda c, r: (replace(c, synthesis={"size_px": 256}), r), "appearances", STALE, "size"),
        (lambda c, r: (c, replace(r, overview_changed=True)), "appearances", STALE, "craniotomy"),
        (lambda c, r: (c, replace(r, poses_changed=True)), "appearances", STALE, "the poses"),
        (lambda c, r: (c, replace(r, index=None)), "appearances", READY, "start"),
        (lambda c, r: (c, replace(r, index=index(done=False))), "appearances", READY, "goes on"),
        (lambda c, r: (c, without(r, "render")), "appearances", MISSING, "label maps"),
        (lambda c, r: (replace(c, running=frozenset({"synthesize"})), r), "appearances", RUNNING, "made"),
        # Training
        (lambda c, r: (c, replace(r, appearances_sha256="b")), "training", STALE, "expected appearances"),
        (lambda c, r: (replace(c, preset="best"), r), "training", STALE, "quick"),
        (lambda c, r: (c, with_stage(r, "train", done=False)), "training", READY, "start"),
        (lambda c, r: (c, with_stage(replace(r, steps_trained=70), "train", done=False)), "training", READY, "step 70"),
        (lambda c, r: (c, replace(r, model=None)), "training", MISSING, "gone"),
        (lambda c, r: (c, replace(r, index=index(done=False))), "training", MISSING, "appearances first"),
        (lambda c, r: (replace(c, running=frozenset({"train"})), r), "training", RUNNING, "trained"),
        (lambda c, r: (replace(c, running=frozenset({"study"})), r), "validation", RUNNING, "without it"),
        (lambda c, r: (replace(c, scan_unsaved=True), r), "case", DONE, "without the MRI"),
        # Validation
        (lambda c, r: (c, replace(r, verdict=(False, ("a", "b")))), "validation", MISSING, "2 limits"),
        (lambda c, r: (c, replace(r, validation="stale")), "validation", STALE, "older"),
        (lambda c, r: (c, replace(r, verdict=None, model=None)), "validation", MISSING, "or start a study"),
        (
            lambda c, r: (c, replace(r, verdict=None, model=None, index=None)),
            "validation",
            MISSING,
            "Train the model first",
        ),
        (lambda c, r: (c, replace(r, verdict=None, study=Study.STOPPED)), "validation", READY, "was stopped"),
        (lambda c, r: (replace(c, waiting="Being made."), r), "case", RUNNING, "Being made."),
        (lambda c, r: (replace(c, waiting="Being made."), r), "poses", DONE, "drawn"),
    ],
)
def test_each_step_says_what_it_lacks(change, step, state, words):
    found = plan_steps(*change(*finished()))[step]
    assert (found.state, words in found.text) == (state, True), found


def test_what_rests_on_an_outdated_step_is_outdated():
    chosen, recorded = finished()
    steps = plan_steps(replace(chosen, poses=STEEPER), recorded)
    assert {name: steps[name].state for name in ("appearances", "training", "validation")} == dict.fromkeys(
        ("appearances", "training", "validation"), STALE
    )
    assert "the poses" in steps["appearances"].text
    assert steps["textures"].state is DONE
    # Rendered anew with other poses, the model is still the old one.
    recorded = with_stage(recorded, "render", **STEEPER)
    assert "the poses" in plan_steps(replace(chosen, poses=STEEPER), recorded)["training"].text


def test_a_step_that_waits_for_one_before_it_does_not_ask_to_be_started():
    """Its button is off: a sign that says that all is there would send the planner to it."""
    chosen, recorded = finished()
    untrained, unmade = without(recorded, "train"), replace(without(recorded, "train"), index=None)
    for change, record, step, words in (
        ({"changed": ("vessel model",)}, without(unmade, "render"), "poses", "the case"),
        ({"poses": STEEPER}, unmade, "appearances", "the poses"),
        ({"textures_problem": "a.png: no labels"}, unmade, "appearances", "textures"),
        ({"synthesis": {"size_px": 256}}, untrained, "training", "the expected appearances"),
    ):
        found = plan_steps(replace(chosen, **change), record)[step]
        assert (found.state, words in found.text) == (MISSING, True), found


def test_a_stopped_training_begins_anew_with_other_settings_and_says_so():
    chosen, recorded = finished()
    recorded = with_stage(replace(recorded, steps_trained=70), "train", done=False)
    recorded.manifest["stages"]["train"]["preset"] = {"name": "best", "minutes": 90.0}
    for preset, minutes, words in (
        ("best", 90.0, "Continue goes on from there"),
        ("best", 120.0, "the time (was 90 min); so it begins anew"),
        ("quick", 26.0, "the preset (was best); so it begins anew"),
    ):
        step = plan_steps(replace(chosen, preset=preset, minutes=minutes), recorded)["training"]
        assert step.state is READY and words in step.text


@pytest.mark.parametrize(
    ("preset", "changed", "seed", "words"),
    [
        ("quick", {}, 0, "Continue goes on from there"),
        ("quick", {}, 3, "the seed; so it begins anew"),
        ("quick", {"steps": 5000}, 0, "the number of steps; so it begins anew"),
        ("paper", {"steps": 5000}, 0, "Continue goes on from there"),
    ],
)
def test_a_training_that_was_started_outside_the_panel_says_that_it_begins_anew(preset, changed, seed, words):
    """The command-line module and the command have options that the panel does not give."""
    chosen, recorded = finished()
    recorded = with_stage(replace(recorded, steps_trained=70), "train", done=False, seed=seed)
    recorded.manifest["stages"]["train"]["preset"] = PRESETS[preset].to_dict() | changed
    step = plan_steps(replace(chosen, preset=preset), recorded)["training"]
    assert step.state is READY and words in step.text


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda recorded: recorded, "Continue goes on from there"),
        (lambda recorded: replace(recorded, appearances_sha256="b"), "the expected appearances; so it begins anew"),
        (lambda recorded: with_stage(recorded, "render", craniotomy=MOVED), "the poses; so it begins anew"),
        (lambda recorded: with_stage(recorded, "render", ranges=STEEPER["ranges"]), "the poses; so it begins anew"),
    ],
)
def test_a_stopped_training_begins_anew_where_what_it_draws_was_made_again(change, words):
    chosen, recorded = finished()
    poses = {"ranges": RANGES, "craniotomy": CRANIOTOMY}
    recorded = change(with_stage(replace(recorded, steps_trained=70), "train", done=False, poses=poses))
    render = recorded.manifest["stages"]["render"]
    chosen = replace(chosen, poses={key: render[key] for key in POSES})
    step = plan_steps(chosen, recorded)["training"]
    assert step.state is READY and words in step.text


@pytest.mark.parametrize("changed", [{"roll_max_deg": 180.0}, {"lateral_offset_mm": 15.0}, {"in_view_min": 0.2}])
def test_a_model_that_was_trained_on_narrower_views_is_outdated(changed):
    """Also where they are narrower in what no pose is refused for."""
    chosen, recorded = finished()
    recorded = with_stage(recorded, "train", poses={"ranges": RANGES, "craniotomy": CRANIOTOMY})
    assert plan_steps(chosen, recorded)["training"].state is DONE
    wider = with_stage(recorded, "render", ranges=RANGES | changed, poses=50, seed=3)
    chosen = replace(chosen, poses={key: wider.manifest["stages"]["render"][key] for key in POSES})
    step = plan_steps(chosen, wider)["training"]
    assert step.state is STALE and "the poses" in step.text


def test_a_stopped_study_begins_anew_with_other_settings_and_says_so(case):
    reader, folder = CaseReader(), str(case.folder)
    chosen = replace(finished()[0], preset="quick", minutes=26.0)
    command = ["python", "-m", "study", folder, "--protocols", "strict", "--preset", "quick", "--minutes"]
    for minutes, words in (("26", "goes on where it was"), ("90.5", "the time (was 90.5 min); so it begins anew")):
        record = {"outcome": "cancelled", "command": [*command, minutes, "--device", "cpu"]}
        files.write_json(case.folder / "runs" / "study.json", record)
        step = plan_steps(chosen, reader.recorded(folder, "surface", Limits()))["validation"]
        assert step.state is READY and words in step.text


def test_older_cases_are_judged_by_time():
    chosen, recorded = finished()
    recorded = with_stage(recorded, "train", appearances_sha256=None)
    assert plan_steps(chosen, recorded)["training"].state is DONE
    recorded = with_stage(recorded, "synthesize", updated="2026-01-03")
    assert plan_steps(chosen, recorded)["training"].state is STALE


def test_rounding_in_a_field_is_no_change():
    rounded = copy.deepcopy(POSES)
    rounded["ranges"]["working_distance_mm"] = [80.04, 139.96]
    assert changes_of_poses(rounded, POSES) == []
    rounded["ranges"]["working_distance_mm"] = [80.2, 140.0]
    assert changes_of_poses(rounded, POSES) == ["the working distance"]


def summary(add_mm: float, share: float) -> dict:
    errors = metrics.FrameErrors(*(np.full(10, add_mm) for _ in range(5)), np.arange(10) < 10 * share)
    return metrics.summary(errors) | {"accepted_only": metrics.summary(errors.select(errors.accepted))}


def study() -> dict:
    loto = {"per_style": {"a": summary(1.0, 1.0)}, "all": summary(1.0, 1.0)}
    strict = {"per_style": {"a": summary(2.0, 0.9), "b": summary(4.0, 0.0)}, "all": summary(2.5, 0.8)}
    return {"format": "ExpectedAppearances study", "protocols": {"loto": loto, "strict": strict}}


def test_verdict_rests_on_the_strict_test():
    rows = figures_of_study(study()) + figures_of_model({"validation": {"add_mm_mean": 9.0}})
    assert [(row.protocol, row.style) for row in rows[:3]] == [("strict", ""), ("strict", "a"), ("strict", "b")]
    assert rows[0].accepted == pytest.approx(0.8) and rows[2].accepted_add_mm is rows[2].accepted_right is None
    assert verdict(rows, Limits(3.0, 1.0, 0.8)) == (True, ())
    ready, reasons = verdict(rows, Limits(2.0, 1.0, 0.9))
    assert not ready
    assert ["2.50 mm" in reasons[0], "80 % of views accepted" in reasons[1]] == [True, True]


def test_verdict_is_about_what_is_shown():
    """A view that is refused harms nobody, however far off; test views are hard, and many are refused."""
    errors = metrics.FrameErrors(*(np.where(np.arange(10) < 6, 1.0, 30.0) for _ in range(5)), np.arange(10) < 6)
    of_all = metrics.summary(errors) | {"accepted_only": metrics.summary(errors.select(errors.accepted))}
    rows = figures_of_study(study() | {"protocols": {"strict": {"per_style": {}, "all": of_all}}})
    assert rows[0].add_mm_mean > 10 and verdict(rows, Limits()) == (True, ())
    all_shown = metrics.FrameErrors(*vars(errors).values())
    object.__setattr__(all_shown, "accepted", np.ones(10, bool))
    of_all = metrics.summary(all_shown) | {"accepted_only": metrics.summary(all_shown)}
    rows = figures_of_study(study() | {"protocols": {"strict": {"per_style": {}, "all": of_all}}})
    reasons = verdict(rows, Limits())[1]
    assert len(reasons) == 2 and "12.60 mm" in reasons[0] and "60 % of accepted views" in reasons[1]


def test_verdict_on_the_models_own_validation():
    values = {"add_mm_mean": 5.2, "accepted_add_mm_mean": 1.0, "accepted_add_below_3mm": 0.98, "accepted_of_true": 0.1}
    rows = figures_of_model({"validation": values})
    assert verdict(rows, Limits()) == (False, ("10 % of views accepted, at least 20 % wanted",))
    assert verdict(figures_of_model({"validation": values | {"accepted_of_true": 0.4}}), Limits()) == (True, ())
    assert verdict([], Limits()) is None
    nothing_shown = {"accepted_of_true": 0.0, "accepted_add_mm_mean": None, "accepted_add_below_3mm": None}
    for limits in (Limits(), Limits(accepted_min=0.0)):  # and not two unknown figures beside it
        assert verdict(figures_of_model({"validation": values | nothing_shown}), limits) == (
            False,
            ("no view is accepted",),
        )
    del values["accepted_add_mm_mean"]  # as of a model of an older version
    assert "train again" in verdict(figures_of_model({"validation": values}), Limits())[1][0]
    unknown = figures_of_model({"validation": {"add_mm_mean": None, "steps": 3}})
    assert len(verdict(unknown, Limits())[1]) == 3  # what was not measured is not met


def test_a_damaged_study_is_refused():
    with pytest.raises(InputError, match="not the figures of a study"):
        figures_of_study({"format": "other"})
    broken = study()
    del broken["protocols"]["strict"]["all"]["add_mm"]
    with pytest.raises(InputError, match="add_mm"):
        figures_of_study(broken)


@pytest.fixture
def case(tmp_path):
    inputs = cases.write_inputs(tmp_path)
    return Case.create(tmp_path / "case", inputs["vessels.vtp"], inputs["cortex.vtp"], inputs["camera.json"])


def test_reader_sees_what_changes_and_reads_meshes_once(case):
    reader = CaseReader()
    folder = str(case.folder)
    assert reader.case("") == (None, "")
    assert reader.case(folder + "x") == (None, "")
    first = reader.case(folder)[0]
    vessels = first.vessels
    case.record("train", done=True, appearances_sha256="a")
    second = reader.case(folder)[0]
    assert second.manifest["stages"]["train"]["done"]
    assert second.vessels is vessels
    files.write_json(
        case.model_folder / "model.json", {"validation": {"accepted_add_mm_mean": 1.0, "accepted_add_below_3mm": 1.0}}
    )
    recorded = reader.recorded(folder, "surface", Limits())
    assert recorded.model
    assert recorded.verdict == (False, ("an unknown share of views accepted, at least 20 % wanted",))
    files.write_json(case.folder / "study" / "study.json", study() | {"inputs": {"appearances_sha256": "b"}})
    assert reader.recorded(folder, "surface", Limits()).validation == "stale"
    (case.folder / "vessels.vtp").write_text("other")
    files.write_json(case.folder / "case.json", json.loads((case.folder / "case.json").read_text()) | {"created": ""})
    assert "SHA-256" in reader.recorded(folder, "surface", Limits()).problem


def test_a_study_of_another_preset_than_the_models_is_outdated(case):
    reader, folder = CaseReader(), str(case.folder)
    files.write_json(case.folder / "study" / "study.json", study() | {"preset": "best"})
    for model, validation in (({"preset": "best"}, "known"), ({"preset": "quick"}, "stale"), ({}, "known")):
        files.write_json(case.model_folder / "model.json", model)
        assert reader.recorded(folder, "surface", Limits()).validation == validation


def test_a_study_of_the_other_methods_appearances_is_outdated(case):
    """One image for each pose was tried, and studied, beside a model of the surface: its verdict stood for that one."""
    reader, folder = CaseReader(), str(case.folder)
    for method in ("surface", "image"):
        store.write_index(case, method, case.camera, {"of": method}, [], done=True)
    surface, image = (files.sha256(store.folder_of(case, m) / "index.json") for m in ("surface", "image"))
    files.write_json(case.folder / "study" / "study.json", study() | {"inputs": {"appearances_sha256": image}})
    assert reader.recorded(folder, "surface", Limits()).validation == "known"  # nothing is trained yet
    files.write_json(case.model_folder / "model.json", {"preset": "quick"})
    # The model is of the one, of the other, and of appearances that are not there any more, which its own step tells.
    for of_model, validation in ((surface, "stale"), (image, "known"), ("older", "known")):
        case.record("train", done=True, appearances_sha256=of_model)
        assert reader.recorded(folder, "surface", Limits()).validation == validation


def test_a_study_of_other_poses_is_outdated(case):
    """Its verdict stood for a model that was trained since on a wider range, around another place."""
    reader, folder = CaseReader(), str(case.folder)
    case.record("render", ranges=RANGES, craniotomy=CRANIOTOMY)
    for ranges, craniotomy, validation in (
        (RANGES, CRANIOTOMY, "known"),
        (STEEPER["ranges"], CRANIOTOMY, "stale"),
        (RANGES, MOVED, "stale"),
        (RANGES, ROUNDED, "known"),  # drawn again, in more poses
        (RANGES, None, "known"),  # of an older version, which did not say
        (STEEPER["ranges"], None, "stale"),
    ):
        inputs = {"ranges": ranges, "craniotomy": craniotomy}
        files.write_json(case.folder / "study" / "study.json", study() | {"inputs": inputs})
        assert reader.recorded(folder, "surface", Limits()).validation == validation


def test_a_case_whose_drive_is_gone_is_told_and_not_taken_for_one_to_be_saved(tmp_path):
    """A scene that was saved elsewhere: its models are there, its case is not."""
    elsewhere = "/cases/a" if os.name == "nt" else r"C:\cases\a"
    for folder in (str(tmp_path / "drive" / "case"), elsewhere):
        recorded = CaseReader().recorded(folder, "surface", Limits())
        for has_vessels in (True, False):
            step = plan_steps(replace(finished()[0], has_vessels=has_vessels), recorded)["case"]
            assert step.state is MISSING and "Connect its drive" in step.text


def test_a_case_that_is_moved_while_it_is_open_is_told(case):
    reader, folder = CaseReader(), case.folder
    assert reader.case(str(folder))[0]
    folder.rename(folder.with_name("elsewhere"))
    assert "open the case where it is now" in reader.case(str(folder), saved=True)[1]
    assert reader.case(str(folder)) == (None, "")  # New, of the same name
    folder.with_name("elsewhere").rename(folder)
    assert reader.case(str(folder))[0]


def test_a_case_is_whole_again_when_its_file_is_restored(case):
    reader, folder = CaseReader(), str(case.folder)
    vessels = case.folder / "vessels.vtp"
    vessels.rename(case.folder / "elsewhere.vtp")
    assert "restore it" in reader.case(folder)[1]
    (case.folder / "elsewhere.vtp").rename(vessels)
    assert reader.case(folder)[1] == ""


def test_appearances_of_each_pose_are_outdated_when_the_poses_are_others(case):
    reader = CaseReader()
    files.write_json(case.poses_path, {"frames": [1]})
    for settings in ({}, {"poses_sha256": files.sha256(case.poses_path)}):  # older versions did not say
        store.write_index(case, "image", case.camera, settings, [], done=True)
        assert not reader.recorded(str(case.folder), "image", Limits()).poses_changed
    files.write_json(case.poses_path, {"frames": [1, 2]})
    assert reader.recorded(str(case.folder), "image", Limits()).poses_changed


def test_training_state_is_read_without_torch(tmp_path):
    torch = pytest.importorskip("torch")
    from safetensors.torch import save_file

    state = {"step": 70, "curve": [{"step": 60, "loss": -1.0, "validation_add_mm": 2.0}]}
    path = tmp_path / "checkpoint.safetensors"
    save_file({"a": torch.zeros(3)}, str(path), metadata={"state": json.dumps(state)})
    assert training_state(path) == state
    path.write_bytes(path.read_bytes()[:20])
    assert training_state(path) == {}
    assert training_state(tmp_path / "absent") == {}
