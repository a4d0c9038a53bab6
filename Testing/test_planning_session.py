"""What the planning panel works on, on slicer-core's scene: cases saved and opened again, steps, options."""

from __future__ import annotations

import sys
import time
from collections import Counter
from dataclasses import replace

import cases
import numpy as np
import pytest

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.appearances import store
from ExpectedAppearancesLib.appearances.overview import overview_view
from ExpectedAppearancesLib.case import recorded
from ExpectedAppearancesLib.case.steps import Step, StepState
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.geometry.camera import read_camera
from ExpectedAppearancesLib.poses.craniotomy import find_craniotomy
from ExpectedAppearancesLib.runs.worker import Worker

slicer = pytest.importorskip("slicer")
import vtk  # noqa: E402 (after the skip)
from planning_scene import LPS, Source, Where, add_transform, new_scene, parameters, save, turned  # noqa: E402
from vtk.util.numpy_support import vtk_to_numpy  # noqa: E402

from ExpectedAppearancesLib.mrml import mri, planning, planning_session  # noqa: E402
from ExpectedAppearancesLib.mrml.planning_adopt import adopt, adopting  # noqa: E402
from ExpectedAppearancesLib.mrml.segment_surface import SegmentSurfaces, answering  # noqa: E402


def test_saved_case_is_recognised_and_opened_again(scene, planned, tmp_path):
    session, p = planned
    assert session.steps(p)["case"].state is StepState.MISSING
    p.casePath = str(tmp_path / "case")
    assert session.steps(p)["case"].state is StepState.READY
    case = save(session, p, tmp_path)
    steps = session.steps(p)
    assert (steps["case"].state, steps["microscope"].state) == (StepState.DONE, StepState.DONE)
    expected_ras = cases.vessels().vertices_mm @ turned()[:3, :3].T + turned()[:3, 3]
    np.testing.assert_allclose(case.vessels.vertices_mm * LPS, expected_ras, atol=1e-4)

    p.vesselsNode.SetAndObserveTransformNodeID(None)
    assert session.changed_models(p) == ("vessel model",)
    assert session.steps(p)["case"].state is StepState.STALE

    count = scene.GetNumberOfNodesByClass("vtkMRMLModelNode")
    for _repeat in range(2):
        assert adopt(session, p, scene) is not None
        assert session.steps(p)["case"].state is StepState.DONE
        assert scene.GetNumberOfNodesByClass("vtkMRMLModelNode") == count + 2


def test_a_case_is_opened_with_its_own_models_and_not_with_those_that_were_changed_since(scene, planned, tmp_path):
    session, p = planned
    p.casePath = str(save(session, p, tmp_path).folder)
    adopt(session, p, scene)
    opened = p.vesselsNode
    opened.SetAndObserveTransformNodeID(add_transform(scene, turned()).GetID())
    p.cortexModel.SetAndObservePolyData(vtk.vtkPolyData())
    adopt(session, p, scene)
    assert p.vesselsNode is not opened
    assert session.steps(p)["case"].state is StepState.DONE


def test_models_of_the_case_before_are_not_seen_among_those_of_the_next(scene, planned, tmp_path):
    session, p = planned
    folders = [str(save(session, p, tmp_path / "first").folder)]
    for node in (p.vesselsNode, p.cortexModel):
        node.CreateDefaultDisplayNodes()
        node.SetAndObserveTransformNodeID(None)
    own = {p.vesselsNode, p.cortexModel}
    folders.append(str(save(session, p, tmp_path / "second").folder))
    models: list[set] = []
    for index in (0, 0, 1, 0, 1):
        list(adopting(session, p, folders[index], scene, print))
        models += [{p.vesselsNode, p.cortexModel}] if index == len(models) else []
        nodes = [scene.GetNthNodeByClass(i, "vtkMRMLModelNode") for i in range(2 + 2 * len(models))]
        assert {node for node in nodes if node.GetDisplayVisibility()} == own | models[index]
    p.vesselsNode, p.cortexModel = own
    list(adopting(session, p, folders[0], scene, print))
    assert not any(node.GetDisplayVisibility() for node in own)


def test_another_cortex_is_a_change_also_where_the_vessels_are_those_of_the_case(scene, planned, tmp_path):
    session, p = planned
    p.casePath = str(save(session, p, tmp_path).folder)
    p.vesselsNode = None  # removed from the scene
    assert session.changed_models(p) == ()
    p.cortexModel.SetAndObserveTransformNodeID(None)
    assert session.changed_models(p) == ("cortex model",)
    p.cortexModel = None
    assert session.changed_models(p) == ()


def test_models_follow_a_transform_that_is_put_above_theirs_or_taken_away(scene, planned):
    session, p = planned
    outer, parent = add_transform(scene, turned()), p.vesselsNode.GetParentTransformNode()
    parent.SetMatrixTransformToParent(vtk.vtkMatrix4x4())  # the newer of the two: its time is that of the chain
    expected = {None: cases.vessels().vertices_mm * LPS}
    expected[outer] = (cases.vessels().vertices_mm @ turned()[:3, :3].T + turned()[:3, 3]) * LPS
    for above in (outer, None, outer):
        parent.SetAndObserveTransformNodeID(above.GetID() if above else None)
        np.testing.assert_allclose(session.mesh(p, "vessels").vertices_mm, expected[above], atol=1e-4)


def test_a_case_that_is_not_opened_to_the_end_leaves_nothing_in_the_scene(scene, planned, tmp_path):
    session, p = planned
    p.casePath = str(tmp_path / "case")
    folder = str(save(session, p, tmp_path).folder)
    before, nodes = parameters(), scene.GetNumberOfNodes()
    assert len(list(adopting(session, parameters(), folder, scene, print))) > 5
    assert scene.GetNumberOfNodes() > nodes
    for done in range(5):
        other, chosen = new_scene(), parameters()
        there = other.GetNumberOfNodes()
        opening = adopting(session, chosen, folder, other, print)
        for _piece in range(done + 1):
            next(opening)
        opening.close()
        assert other.GetNumberOfNodes() == there, done
        assert vars(chosen) == vars(before), done


def test_rendered_poses_are_those_that_were_planned(planned, tmp_path):
    """The options for `render`, parsed and run by it, leave nothing outdated; another tilt does."""
    from ExpectedAppearancesLib import cli

    session, p = planned
    p.casePath = str(tmp_path / "case")
    p.lateralAuto, p.lateralMm = False, 0.0
    case = save(session, p, tmp_path)
    assert cli.main(["render", str(case.folder), *session.render_arguments(p)]) == 0
    assert session.steps(p)["poses"].state is StepState.DONE
    p.tiltMaxDeg = 30.0
    assert "the tilt" in session.steps(p)["poses"].text
    # Opening the case takes over what it was rendered with.
    other = parameters(casePath=p.casePath, poseCount=99)
    scene = p.vesselsNode.GetScene()
    adopt(session, other, scene)
    assert (other.poseCount, other.tiltMaxDeg, other.lateralAuto, other.lateralMm) == (4, 50.0, False, 0.0)
    assert other.craniotomySource is Where.FITTED
    assert session.steps(other)["poses"].state is StepState.DONE


def test_a_craniotomy_that_was_marked_is_kept_when_the_case_is_opened(scene, planned, tmp_path):
    from ExpectedAppearancesLib import cli

    session, p = planned
    p.casePath = str(tmp_path / "case")
    case = save(session, p, tmp_path)
    point = scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", "Craniotomy")
    p.craniotomySource, p.craniotomyNode = Where.MARKED, point
    assert "click on the cortex" in session.steps(p)["poses"].text
    centre = case.vessels.centroid_mm + np.array([2.0, 0.0, 0.0])
    point.AddControlPoint(*(centre * LPS))
    first = session.sampler(p)
    assert cli.main(["render", str(case.folder), *session.render_arguments(p)]) == 0
    assert session.steps(p)["poses"].state is StepState.DONE
    centre[0] += 1.0
    point.SetNthControlPointPosition(0, *(centre * LPS))
    assert session.sampler(p) is not first
    assert "craniotomy" in session.steps(p)["poses"].text
    other = parameters(casePath=p.casePath)
    adopt(session, other, scene)
    assert other.craniotomySource is Where.RECORDED
    assert session.steps(other)["poses"].state is StepState.DONE
    # Saved anew, as with another microscope, the case has none: a fitted one must not pass for the one that was marked.
    other.casePath = str(tmp_path / "anew")
    assert "No craniotomy is saved" in session.steps(other)["poses"].text


def test_a_craniotomy_that_is_drawn_again_is_the_very_same(planned, tmp_path):
    """A training or study that was stopped begins anew where its poses are drawn around another one."""
    session, p = planned
    case = save(session, p, tmp_path)
    p.casePath, p.craniotomySource = str(case.folder), Where.RECORDED
    for point, axis in np.random.default_rng(1).normal(size=(20, 2, 3)) * 1e-5:
        first = find_craniotomy(case.vessels, None, "LPS", point, axis)
        case.record("render", craniotomy={key: value.tolist() for key, value in vars(first).items()})
        words = session.render_arguments(p)
        point, axis = ([float(word) for word in words[words.index(w) + 1 :][:3]] for w in ("--point", "--normal"))
        again = find_craniotomy(case.vessels, None, "LPS", point, axis)
        assert all(np.array_equal(value, vars(first)[key]) for key, value in vars(again).items())
        assert not any("e" in word for word in words if not word.startswith("--"))


def test_a_craniotomy_marked_on_another_patient_is_not_kept(scene, planned, tmp_path):
    session, p = planned
    p.casePath = str(save(session, p, tmp_path).folder)
    point = scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", "of the case before")
    point.AddControlPoint(300.0, 0.0, 0.0)
    p.craniotomySource, p.craniotomyNode = Where.MARKED, point
    adopt(session, p, scene)
    assert p.craniotomySource is Where.FITTED
    np.testing.assert_allclose(session.craniotomy(p).centre_world_mm, session.mesh(p, "vessels").centroid_mm)


def test_all_problems_of_a_case_are_told_at_once(planned, tmp_path):
    session, p = planned
    p.calibrationPath = str(tmp_path / "absent.json")
    p.vesselsNode.SetAndObservePolyData(vtk.vtkPolyData())
    found = "\n".join(session.problems_of_new_case(p, ""))
    for words in ("choose one with New", "holds no surface", "absent.json"):
        assert words in found
    assert session.steps(p)["poses"].state is StepState.MISSING


def test_textures_are_compared_with_what_was_synthesised(planned, tmp_path):
    from ExpectedAppearancesLib.textures.library import read_texture, shipped_textures_folder

    session, p = planned
    files = session.texture_files(p)
    assert len(files) == 10
    assert set(session.chosen(p).textures.values()) == {""}  # not read yet
    name, (version, image, labels) = next(iter(files.items()))
    texture = read_texture(name, image, labels)
    assert texture.sha256 != replace(texture, labels=np.maximum(texture.labels, 1)[::-1]).sha256
    session.texture_digests[version] = texture.sha256
    assert session.chosen(p).textures[name] == texture.sha256
    p.texturesPath = str(tmp_path / "gone")
    assert "no longer there" in session.steps(p)["textures"].text
    assert session.textures_folder(parameters()) == shipped_textures_folder()


def test_two_pictures_of_one_name_are_told_and_the_others_listed(planned, tmp_path):
    session, p = planned
    for name in ("a.png", "a.jpg", "b.png"):
        (tmp_path / name).touch()
    p.texturesPath = str(tmp_path)
    assert list(session.texture_files(p)) == ["a", "b"]
    assert "another texture is called a too" in session.steps(p)["textures"].text


def test_a_case_is_opened_with_the_textures_it_was_made_with(scene, planned, tmp_path):
    session, p = planned
    p.casePath, own = str(tmp_path / "case"), tmp_path / "Meine Fotos"
    case = save(session, p, tmp_path)
    for folder, expected in ((None, ""), ("", ""), (str(own), str(own))):
        if folder is not None:
            case.record("synthesize", textures_folder=folder)
        other = parameters(casePath=p.casePath, texturesPath="those of the case before")
        adopt(session, other, scene)
        assert other.texturesPath == expected
    assert "no longer there" in session.steps(other)["textures"].text  # said, not taken for the ones that ship
    (case.folder / "textures").mkdir()
    adopt(session, other, scene)
    assert other.texturesPath == str(case.folder / "textures")
    moved = tmp_path / "elsewhere" / "case"
    (moved / "textures").mkdir(parents=True)
    (moved / "case.json").touch()
    own.mkdir()
    for folder, expected in ((str(moved / "textures"), str(case.folder / "textures")), (str(own), str(own))):
        case.record("synthesize", textures_folder=folder)
        adopt(session, other, scene)
        assert other.texturesPath == expected


def test_everything_on_a_network_drive_that_is_lost_is_told_as_gone(scene, planned, tmp_path, vanish):
    """The panel asks at every change; what it is told must be an answer, not an error of the system."""
    session, p = planned
    case = save(session, p, tmp_path)
    (case.folder / "textures").mkdir()
    p.casePath, p.texturesPath = str(case.folder), str(case.folder / "textures")
    assert session.steps(p)["case"].state is StepState.DONE
    vanish(tmp_path)
    for calibration in ("camera.json", "camera.yml"):
        p.calibrationPath = str(case.folder / calibration)
        steps = session.steps(p)
        assert "Connect its drive" in steps["case"].text and "not found" in steps["microscope"].text
        assert "no longer there" in steps["textures"].text and session.texture_files(p) == {}


def test_microscope_from_its_field_of_view(planned):
    session, p = planned
    p.cameraSource = Source.VIEW
    camera = session.camera(p)
    assert camera.width / camera.fx * 300.0 == pytest.approx(40.0)
    assert read_camera(p.calibrationPath) == session.camera(parameters(calibrationPath=p.calibrationPath))


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


def test_the_surface_of_a_segment_comes_from_a_process_and_an_outdated_one_never(scene, planned, tmp_path):
    session, p = planned
    image = slicer.vtkOrientedImageData()
    image.SetExtent(3, 14, -2, 9, 0, 11)
    image.SetSpacing(2.0, 1.0, 0.5)
    image.SetOrigin(5.0, -7.0, 11.0)
    image.AllocateScalars(vtk.VTK_UNSIGNED_CHAR, 1)
    voxels = vtk_to_numpy(image.GetPointData().GetScalars()).reshape(12, 12, 12)
    voxels[:] = 0
    voxels[3:8, 3:7, 3:9] = 1
    node = scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "S")
    node.CreateDefaultDisplayNodes()
    segment_id = node.AddSegmentFromBinaryLabelmapRepresentation(image, "vessels", [1.0, 0.0, 0.0])
    node.SetAndObserveTransformNodeID(add_transform(scene, turned()).GetID())
    expected = planning.world_mesh(node, segment_id)
    p.vesselsSegmentId, p.vesselsNode = segment_id, node

    asked: list[dict] = []
    worker, session.surfaces = Worker("surfaces"), SegmentSurfaces(asked.append)

    def answered() -> tuple[dict, dict]:
        list(session.surfaces.asking(node, segment_id, tmp_path))
        worker.ask(asked[-1])
        end = time.monotonic() + 300
        while not (found := worker.poll()):
            assert time.monotonic() < end
            time.sleep(0.02)
        return found

    def draw() -> None:
        segment = node.GetSegmentation().GetSegment(segment_id)
        segment.GetRepresentation(node.GetSegmentation().GetSourceRepresentationName()).Modified()

    try:
        assert session.steps(p)["case"] == Step(StepState.RUNNING, "The surface of the segment is being made.")
        with pytest.raises(InputError, match="is being made"):
            session.mesh(p, "vessels")
        first = answered()
        assert not session.surfaces.to_ask(node, segment_id)
        session.surfaces.take(*first)
        made = session.mesh(p, "vessels")
        np.testing.assert_allclose(made.vertices_mm, expected.vertices_mm, atol=1e-4)
        np.testing.assert_array_equal(made.triangles, expected.triangles)
        assert session.steps(p)["case"].state is StepState.MISSING  # a folder is to be chosen: nothing is waited for

        draw()
        assert session.surfaces.to_ask(node, segment_id)
        assert session.mesh(p, "vessels") is made  # what is drawn in the views stays until the new one comes
        assert session.steps(p)["case"].state is StepState.RUNNING
        outdated = answered()
        draw()
        voxels[:] = 0
        newest = answered()
        session.surfaces.take(*outdated)
        assert session.steps(p)["case"].state is StepState.RUNNING
        session.surfaces.take(*newest)
        with pytest.raises(InputError, match="S: "):
            session.mesh(p, "vessels")

        draw()
        voxels[4:9, 4:8, 4:9] = 1
        list(session.surfaces.asking(node, segment_id, tmp_path))
        session.surfaces.take(asked[-1], {"failed": "ended"})
        np.testing.assert_array_equal(
            session.mesh(p, "vessels").vertices_mm, planning.world_mesh(node, segment_id).vertices_mm
        )
    finally:
        worker.stop()


def test_a_segment_is_taken_with_the_smoothing_that_is_set_for_its_surface(scene, planned, tmp_path):
    """In the Segment Editor's menu of Show 3D: thin vessels vanish where they are smoothed much."""
    session, p = planned
    image = slicer.vtkOrientedImageData()
    image.SetExtent(0, 19, 0, 19, 0, 19)
    image.AllocateScalars(vtk.VTK_UNSIGNED_CHAR, 1)
    voxels = vtk_to_numpy(image.GetPointData().GetScalars()).reshape(20, 20, 20)
    voxels[:] = 0
    voxels[3:17, 9:11, 9:11] = 1
    node = scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "S")
    p.vesselsSegmentId = node.AddSegmentFromBinaryLabelmapRepresentation(image, "vessels", [1.0, 0.0, 0.0])
    p.vesselsNode, segmentation = node, node.GetSegmentation()

    def width_mm() -> float:
        return np.ptp(session.mesh(p, "vessels").vertices_mm[:, 0])

    def smooth(factor: float, shown: bool) -> None:
        segmentation.SetConversionParameter("Smoothing factor", str(factor))
        if shown:
            segmentation.CreateRepresentation("Closed surface", True)

    usual = width_mm()
    smooth(0.5, shown=True)
    assert width_mm() == pytest.approx(usual, abs=1e-3)
    smooth(0.0, shown=True)
    sharp = width_mm()
    assert sharp > usual + 0.1
    segmentation.RemoveRepresentation("Closed surface")
    assert width_mm() == pytest.approx(sharp, abs=1e-3)
    smooth(0.5, shown=False)
    assert width_mm() == pytest.approx(usual, abs=1e-3)
    smooth(0.0, shown=False)
    asked: list[dict] = []
    surfaces = SegmentSurfaces(asked.append)
    list(surfaces.asking(node, p.vesselsSegmentId, tmp_path))
    surfaces.take(asked[0], {"answer": answering()(asked[0])})
    made = surfaces.made(node, p.vesselsSegmentId)
    assert np.ptp(made.vertices_mm[:, 0]) == pytest.approx(sharp, abs=1e-3)
    smooth(0.5, shown=False)
    assert surfaces.to_ask(node, p.vesselsSegmentId)


def test_the_session_loads_nothing_heavy():
    """In a fresh interpreter: what the panel imports when it is opened."""
    import subprocess

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
    import subprocess
    from pathlib import Path

    command = [sys.executable, "-c", LOOK_AROUND, str(Path(__file__).parent)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr
