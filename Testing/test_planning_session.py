"""What the planning panel works on, on slicer-core's scene: cases saved and opened again, steps, options."""

from __future__ import annotations

from dataclasses import replace

import cases
import numpy as np
import pytest

from ExpectedAppearancesLib.geometry.camera import read_camera
from ExpectedAppearancesLib.planning.steps import StepState
from ExpectedAppearancesLib.poses.craniotomy import find_craniotomy

pytest.importorskip("slicer")
import vtk
from planning_scene import LPS, Source, Where, add_transform, adopt, new_scene, parameters, save, turned

from ExpectedAppearancesLib.mrml.planning_adopt import adopting


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
