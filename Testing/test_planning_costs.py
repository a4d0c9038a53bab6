"""What the planning panel does at every change must cost little: what is worked out once, in pieces, and loaded."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.appearances import store
from ExpectedAppearancesLib.appearances.overview import overview_view
from ExpectedAppearancesLib.planning import recorded
from ExpectedAppearancesLib.planning.steps import StepState

pytest.importorskip("slicer")
import vtk
from planning_scene import save

from ExpectedAppearancesLib.mrml import mri, planning, planning_session


@pytest.fixture
def counted(monkeypatch):
    """How often each thing that costs was done since the last look."""
    done = Counter()

    def count(module, name):
        usual = getattr(module, name)

        def noted(*arguments, **named):
            done[name] += 1
            return usual(*arguments, **named)

        noted.__name__ = name
        monkeypatch.setattr(module, name, noted)

    for module, name in (
        (files, "sha256"),
        (files, "read_json"),
        (recorded, "overview_changed"),
        (recorded, "training_state"),
        (recorded, "newest_image"),
        (planning, "world_mesh"),
        (planning, "same_mesh"),
        (planning_session, "find_craniotomy"),
        (planning_session, "PoseSampler"),
        (mri, "scan_identity"),
    ):
        count(module, name)

    def look() -> dict:
        found = dict(done)
        done.clear()
        return found

    return look


def test_a_refresh_does_only_what_has_changed(scene, planned, tmp_path, counted):
    """Ticks of the panel's timer must stay cheap however large the case is, so work is counted, not timed."""
    session, p = planned
    p.casePath = str(tmp_path / "case")
    case = save(session, p, tmp_path)
    case.record("render", **session.pose_settings(p), circular_field=None, done=True)
    camera, pose = overview_view(session.craniotomy(p), case.cortex, 64)
    item = {"style": "a", "image": "a.png", "texture_sha256": "", "camera_from_world": pose.tolist()}
    settings = {"size_px": 384, "iterations": 50, "overview": pose.tolist()}
    store.write_index(case, "surface", camera, settings, [item] * 500, done=True)
    (case.model_folder).mkdir()
    (case.model_folder / "checkpoint.safetensors").write_bytes(b"")

    def tick():
        record = session.recorded(p)
        session.steps(p, frozenset({"train"}), record)
        session.reader.curve(session.case(p))
        session.reader.newest_image(session.case(p), "surface")
        return counted()

    assert tick()["overview_changed"] == 1
    assert [tick() for _ in range(5)] == [{}] * 5
    case.record("train", done=False)
    counted()  # what writing reads
    assert tick() == {"read_json": 2}  # the manifest and the camera; nothing is hashed again
    (case.model_folder / "checkpoint.safetensors").write_bytes(b"12345678")
    assert tick() == {"training_state": 1}
    (case.appearances_folder / "surface" / "b.png").touch()
    assert tick() == {"newest_image": 1}
    p.tiltMaxDeg = 40.0
    assert tick() == {"PoseSampler": 1}
    p.vesselsNode.SetAndObserveTransformNodeID(None)
    moved = tick()
    # They are now so far off that another part of the cortex is near them: its axis is found, then the centre.
    assert moved == {"world_mesh": 1, "same_mesh": 1, "find_craniotomy": 2, "PoseSampler": 1}
    store.write_index(case, "surface", camera, settings, [item] * 501, done=True)
    assert tick() == {"read_json": 1, "sha256": 1, "overview_changed": 1, "newest_image": 1}


def test_prepared_in_pieces_it_answers_at_once(scene, planned, tmp_path, counted):
    session, p = planned
    p.casePath = str(tmp_path / "case")
    save(session, p, tmp_path)
    p.vesselsNode.GetPolyData().Modified()
    counted()
    done = []
    for _piece in session.prepare(p):
        done.append(counted())
    assert max(len(piece) for piece in done) <= 2 and sum(piece.get("world_mesh", 0) for piece in done) == 1
    session.steps(p)
    assert counted() == {}
    p.vesselsNode.SetAndObservePolyData(vtk.vtkPolyData())
    list(session.prepare(p))  # what is wrong is said by the steps
    assert session.steps(p)["poses"].state is StepState.MISSING


def test_the_session_loads_nothing_heavy():
    """In a fresh interpreter: what the panel imports when it is opened."""
    code = (
        "import sys; from ExpectedAppearancesLib.mrml import planning_session, planning_adopt, labelling, charts; "
        "from ExpectedAppearancesLib.runs import runner, closing, dependencies; "
        "from ExpectedAppearancesLib.model.presets import PRESETS; from ExpectedAppearancesLib.masks import stage; "
        "session = planning_session.PlanningSession(); "
        "print([m for m in ('torch', 'cv2', 'onnxruntime', 'skimage', 'scipy', 'matplotlib') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


LOOK_AROUND = """
import sys
sys.path.insert(0, sys.argv[1])
import cases, numpy as np
from ExpectedAppearancesLib.masks.renderer import MaskRenderer
from ExpectedAppearancesLib.mrml import planning
from ExpectedAppearancesLib.poses.craniotomy import find_craniotomy
from ExpectedAppearancesLib.poses.sampling import PoseRanges, PoseSampler
vessels, cortex, camera = cases.vessels(), cases.dome(), cases.camera()
sampler = PoseSampler(find_craniotomy(vessels, cortex), PoseRanges(), camera, vessels.vertices_mm, 0)
poses = np.stack([sampler.sample(i) for i in range(3)])
planning.frustum_polydata(camera, poses, np.ones(3), "LPS")
with MaskRenderer(vessels, cortex, camera) as renderer:
    assert renderer.render(poses[0]).any()
print([m for m in ("torch", "cv2", "onnxruntime", "skimage", "scipy") if m in sys.modules])
"""


def test_drawing_cameras_and_label_maps_loads_nothing_heavy():
    """OpenCV takes a quarter of a second of the GUI's thread, seconds on a busy computer."""
    command = [sys.executable, "-c", LOOK_AROUND, str(Path(__file__).parent)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr
