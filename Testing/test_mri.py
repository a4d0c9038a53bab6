"""The scan of a case: kept in world coordinates, known again, and shown by the live panel."""

from __future__ import annotations

import numpy as np
import pytest

from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.planning.steps import StepState

slicer = pytest.importorskip("slicer")
import vtk  # noqa: E402 (after the skip)
from planning_scene import add_transform, adopt, keep_scan, parameters, save, turned  # noqa: E402
from vtk.util.numpy_support import numpy_to_vtk, vtk_to_numpy  # noqa: E402

from ExpectedAppearancesLib.mrml import mri  # noqa: E402

SIZE = (20, 24, 28)
INSIDE = np.array([7.0, 11.0, 13.0])  # a voxel


def volume(scene, name="T1", seed=1):
    node = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", name)
    voxels = np.random.default_rng(seed).integers(0, 900, SIZE[::-1]).astype(np.int16)
    image = vtk.vtkImageData()
    image.SetDimensions(SIZE)
    image.GetPointData().SetScalars(numpy_to_vtk(voxels.ravel(), deep=True))
    node.SetAndObserveImageData(image)
    matrix = vtk.vtkMatrix4x4()
    matrix.DeepCopy([-0.9, 0, 0, 12.3, 0, 0, 1.1, -4, 0, -1.2, 0, 9, 0, 0, 0, 1])  # coronal, three spacings
    node.SetIJKToRASMatrix(matrix)
    return node


def seen_at(node, ijk=INSIDE) -> np.ndarray:
    """World position, RAS mm, of a voxel."""
    matrix, to_world = vtk.vtkMatrix4x4(), vtk.vtkGeneralTransform()
    node.GetIJKToRASMatrix(matrix)
    if node.GetParentTransformNode():
        node.GetParentTransformNode().GetTransformToWorld(to_world)
    return np.array(to_world.TransformPoint(matrix.MultiplyPoint((*ijk, 1.0))[:3]))


def value_at(node, place_ras) -> int:
    matrix = vtk.vtkMatrix4x4()
    node.GetRASToIJKMatrix(matrix)
    i, j, k = np.rint(matrix.MultiplyPoint((*place_ras, 1.0))[:3]).astype(int)
    return voxels(node).reshape(node.GetImageData().GetDimensions()[::-1])[k, j, i]


def voxels(node) -> np.ndarray:
    return vtk_to_numpy(node.GetImageData().GetPointData().GetScalars())


@pytest.fixture
def case(planned, tmp_path) -> Case:
    session, p = planned
    p.casePath = str(tmp_path / "case")
    return save(session, p, tmp_path)


def test_scan_is_kept_in_world_coordinates_and_the_node_stays(scene, case):
    node = volume(scene)
    node.SetAndObserveTransformNodeID(add_transform(scene, turned(), add_transform(scene, turned())).GetID())
    place, count, inputs = seen_at(node), scene.GetNumberOfNodes(), case.manifest["inputs"]
    path = keep_scan(case, node)
    assert scene.GetNumberOfNodes() == count and node.GetParentTransformNode() is not None
    assert Case.open(case.folder).manifest["inputs"] == inputs  # no stage depends on it
    other = slicer.vtkMRMLScene()
    read = mri.scan_of(other, Case.open(case.folder))
    assert read.GetName() == "T1" and read.GetParentTransformNode() is None and read.GetDisplayNode()
    i, j, k = INSIDE.astype(int)
    assert value_at(read, place) == voxels(node).reshape(SIZE[::-1])[k, j, i]
    assert sorted(voxels(read)) == sorted(voxels(node))
    assert read.GetStorageNode().GetFileName() == str(path)
    assert mri.scan_of(other, case) is read  # not read a second time
    assert mri.scan_of(scene, case) is node


def test_a_bent_scan_is_resampled(scene, case):
    """A thin-plate spline that is a shift by whole voxels, so that resampling changes no value."""
    node = volume(scene)
    spline, corners = vtk.vtkThinPlateSplineTransform(), (vtk.vtkPoints(), vtk.vtkPoints())
    step = seen_at(node, (1, 0, 0)) - seen_at(node, (0, 0, 0))
    for corner in ((0, 0, 0), (90, 0, 0), (0, 90, 0), (0, 0, 90), (40, 50, 60)):
        corners[0].InsertNextPoint(corner)
        corners[1].InsertNextPoint(*(np.array(corner) + step))
    spline.SetSourceLandmarks(corners[0])
    spline.SetTargetLandmarks(corners[1])
    spline.SetBasisToR()
    bend = scene.AddNewNodeByClass("vtkMRMLTransformNode")
    bend.SetAndObserveTransformToParent(spline)
    node.SetAndObserveTransformNodeID(bend.GetID())
    keep_scan(case, node)
    read = mri.scan_of(slicer.vtkMRMLScene(), case)
    i, j, k = INSIDE.astype(int)
    assert value_at(read, seen_at(node)) == pytest.approx(voxels(node).reshape(SIZE[::-1])[k, j, i], abs=1)
    case = Case.open(case.folder)
    assert mri.is_scan_of(case, mri.scan_identity(node)) and mri.is_scan_of(case, mri.scan_identity(read))


def test_a_sheared_scan_is_seen_where_it_was(scene, case):
    """A registration of 12 parameters shears; readers of volumes would drop it without a word."""
    node = volume(scene)
    k, j, i = np.mgrid[0 : SIZE[2], 0 : SIZE[1], 0 : SIZE[0]]
    voxels(node)[:] = (200 + 10 * i + 7 * j + 4 * k).ravel()
    shear = np.eye(4)
    shear[0, 1], shear[1, 1], shear[2, 0] = 0.3, 1.2, -0.1
    node.SetAndObserveTransformNodeID(add_transform(scene, shear, add_transform(scene, turned())).GetID())
    keep_scan(case, node)
    read = mri.scan_of(slicer.vtkMRMLScene(), case)
    for ijk in (INSIDE, np.add(INSIDE, (3, -4, 5))):
        assert value_at(read, seen_at(node, ijk)) == pytest.approx(200 + ijk @ [10, 7, 4], abs=15)  # half a voxel
    assert mri.is_scan_of(case, mri.scan_identity(node)) and mri.is_scan_of(case, mri.scan_identity(read))


def test_the_panel_saves_a_chosen_scan_and_finds_it_again(scene, planned, case):
    session, p = planned
    assert session.scan_to_keep(p) is None and session.steps(p)["case"].text == "Saved."
    p.mriVolume = volume(scene)
    step = session.steps(p)["case"]
    assert step.state is StepState.DONE and "without the MRI" in step.text  # nothing made from the case is outdated
    keep_scan(session.case(p), p.mriVolume, session.scan_to_keep(p))
    assert session.scan_to_keep(p) is None and session.steps(p)["case"].text == "Saved."
    p.mriVolume.SetAndObserveTransformNodeID(add_transform(scene, turned()).GetID())
    assert session.scan_to_keep(p) is not None  # it lies elsewhere now
    p.mriVolume.SetAndObserveTransformNodeID(None)
    voxels(p.mriVolume)[:] = 3
    p.mriVolume.GetImageData().Modified()
    assert session.scan_to_keep(p) is not None

    other_scene = type(scene)()
    other = parameters(casePath=p.casePath, mriVolume=volume(other_scene, "another patient's", 2))
    adopt(session, other, other_scene)
    assert other.mriVolume.GetName() == "T1" and session.scan_to_keep(other) is None
    assert other_scene.GetNumberOfNodesByClass("vtkMRMLScalarVolumeNode") == 2


def test_identity_is_taken_once_for_each_change(scene, planned, case, monkeypatch):
    session, p = planned
    p.mriVolume = volume(scene)
    taken = []
    usual = mri.scan_identity
    monkeypatch.setattr(mri, "scan_identity", lambda node: taken.append(node) or usual(node))
    for _repeat in range(5):
        session.scan_to_keep(p)
        p.mriVolume.SetName("renamed")  # modifies the node, not the image
    assert len(taken) == 1


def test_what_is_missing_or_damaged_is_told(scene, planned, case):
    session, p = planned
    with pytest.raises(InputError, match="holds no image"):
        keep_scan(case, scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", "empty"))
    assert mri.scan_of(scene, case) is None
    path = keep_scan(case, volume(slicer.vtkMRMLScene()))
    path.write_bytes(b"NRRD0004\n")
    with pytest.raises(InputError, match=r"mri\.nrrd: the MRI of the case is damaged"):
        mri.scan_of(scene, case)
    path.unlink()
    count = scene.GetNumberOfNodes()
    with pytest.raises(InputError, match=r"mri\.nrrd: the MRI of the case is missing"):
        mri.scan_of(scene, case)
    assert scene.GetNumberOfNodes() == count
    told: list[str] = []
    # The case can be worked on all the same.
    assert adopt(session, p, scene, told.append) is not None and p.mriVolume is None
    assert "mri.nrrd: the MRI of the case is missing" in told[0]
    p.mriVolume = volume(scene)
    assert session.scan_to_keep(p) is not None  # chosen again, it is kept again


def test_the_scan_of_the_case_before_is_not_chosen_for_one_that_cannot_be_opened(scene, planned, case):
    """Once its file is restored, Save would put another patient's scan into it."""
    session, p = planned
    p.mriVolume = volume(scene, "another patient's")
    vessels = case.folder / "vessels.vtp"
    vessels.rename(case.folder / "elsewhere.vtp")
    assert adopt(session, p, scene) is None
    (case.folder / "elsewhere.vtp").rename(vessels)
    assert session.case(p) and session.scan_to_keep(p) is None


def test_the_live_panel_shows_the_scan_of_its_case(scene, case):
    assert mri.scan_to_show(scene, case, None) is None
    chosen = volume(scene, "chosen by the user", 5)
    assert mri.scan_to_show(scene, case, chosen) is chosen
    keep_scan(case, volume(slicer.vtkMRMLScene()))
    found = mri.scan_to_show(scene, case, None)
    assert found.GetName() == "T1"
    assert mri.scan_to_show(scene, case, found) is found and mri.scan_to_show(scene, case, chosen) is chosen
    chosen.SetAttribute(mri.ATTRIBUTE, "that of another case")
    assert mri.scan_to_show(scene, case, chosen) is found
