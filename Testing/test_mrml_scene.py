"""Scenes are loaded again from their files and measured with OpenCV and the mask renderer."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

import cases
import cv2
import numpy as np
import pytest

from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.geometry.camera import Camera
from ExpectedAppearancesLib.geometry.pose import look_at
from ExpectedAppearancesLib.mrml import scene as scenes

slicer = pytest.importorskip("slicer")

POSE = look_at(np.array([25.0, -18.0, 90.0]), np.array([1.0, 0.5, -2.0]), np.array([0.2, 1.0, 0.0]))
CAMERA = Camera(96, 80, 182.0, 178.0, 50.0, 37.5)


def frame_of(camera: Camera) -> np.ndarray:
    """Noise with one blue pixel, the top left one."""
    image = np.random.default_rng(3).integers(0, 200, (camera.height, camera.width, 3), dtype=np.uint8)
    image[0, 0] = (0, 0, 255)
    return image


@pytest.fixture(scope="module", params=["LPS", "RAS"])
def saved(request, tmp_path_factory):
    """Case, and the scene loaded afresh from the file that was written."""
    folder = tmp_path_factory.mktemp(f"Szene ü {request.param}")
    inputs = cases.write_inputs(folder)
    case = Case.create(
        folder / "case", inputs["vessels.vtp"], inputs["cortex.vtp"], inputs["camera.json"], request.param
    )
    path = scenes.save_registered_scene(case, frame_of(CAMERA), CAMERA, POSE, folder / "out" / "registered.mrb")
    return case, load(path, folder / "unpacked")


def load(path, folder):
    with zipfile.ZipFile(path) as bundle:
        bundle.extractall(folder)
    loaded = slicer.vtkMRMLScene()
    loaded.SetURL(str(next(folder.rglob("*.mrml"))))
    assert loaded.Connect()
    return loaded


def node_of(scene, name, kind):
    nodes = scene.GetNodesByClassByName(kind, name)
    assert nodes.GetNumberOfItems() == 1, name
    return nodes.GetItemAsObject(0)


def points_of(model) -> np.ndarray:
    from vtk.util.numpy_support import vtk_to_numpy

    return vtk_to_numpy(model.GetPolyData().GetPoints().GetData()).astype(float)


def matrix_of(read) -> np.ndarray:
    import vtk

    matrix = vtk.vtkMatrix4x4()
    read(matrix)
    return np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])


def to_world(scene, case, points_camera_mm) -> np.ndarray:
    """Points under CameraToRAS -> coordinates of the case's files, by the loaded transform alone."""
    node = node_of(scene, "CameraToRAS", "vtkMRMLLinearTransformNode")
    ras = np.c_[points_camera_mm, np.ones(len(points_camera_mm))] @ matrix_of(node.GetMatrixTransformToWorld).T
    return ras[:, :3] * ([-1, -1, 1] if case.space == "LPS" else 1)


def project(points_world_mm) -> np.ndarray:
    rotation = cv2.Rodrigues(np.ascontiguousarray(POSE[:3, :3]))[0]
    return cv2.projectPoints(points_world_mm, rotation, POSE[:3, 3], CAMERA.matrix, None)[0].reshape(-1, 2)


def test_models_come_back_in_ras_at_the_place_of_the_files(saved):
    case, scene = saved
    for name, mesh in (("Vessels", case.vessels), ("Cortex", case.cortex)):
        model = node_of(scene, name, "vtkMRMLModelNode")
        assert model.GetParentTransformNode() is None
        sign = [-1, -1, 1] if case.space == "LPS" else [1, 1, 1]
        np.testing.assert_allclose(points_of(model), mesh.vertices_mm * sign, atol=1e-4)
        assert model.GetPolyData().GetNumberOfPolys() == len(mesh.triangles)
        assert model.GetDisplayNode().GetVisibility()


def test_frame_frustum_and_outline_hang_under_one_transform(saved):
    case, scene = saved
    parent = node_of(scene, "CameraToRAS", "vtkMRMLLinearTransformNode")
    kinds = {"Microscope frame": "vtkMRMLVectorVolumeNode"}
    kinds |= dict.fromkeys(("Camera frustum", "Predicted outline"), "vtkMRMLModelNode")
    for name, kind in kinds.items():
        assert node_of(scene, name, kind).GetParentTransformNode() is parent
    ras_from_world = np.diag([-1, -1, 1, 1]) if case.space == "LPS" else np.eye(4)
    expected = ras_from_world @ np.linalg.inv(POSE)
    np.testing.assert_allclose(matrix_of(parent.GetMatrixTransformToParent), expected, atol=1e-9)


def test_frame_keeps_its_pixels_and_is_neither_mirrored_nor_flipped(saved):
    from vtk.util.numpy_support import vtk_to_numpy

    case, scene = saved
    volume = node_of(scene, "Microscope frame", "vtkMRMLVectorVolumeNode")
    assert volume.GetImageData().GetDimensions() == (CAMERA.width, CAMERA.height, 1)
    pixels = vtk_to_numpy(volume.GetImageData().GetPointData().GetScalars())
    assert pixels.dtype == np.uint8
    np.testing.assert_array_equal(pixels.reshape(CAMERA.height, CAMERA.width, 3), frame_of(CAMERA))
    assert [volume.GetImageData().GetScalarComponentAsDouble(0, 0, 0, c) for c in range(3)] == [0, 0, 255]

    ijk = np.array([[0, 0, 0, 1], [CAMERA.width - 1, 0, 0, 1], [17, CAMERA.height - 1, 0, 1]], float)
    in_camera = (ijk @ matrix_of(volume.GetIJKToRASMatrix).T)[:, :3]
    np.testing.assert_allclose(project(to_world(scene, case, in_camera)), ijk[:, :2], atol=1e-3)
    display = volume.GetDisplayNode()
    assert (display.GetWindowLevelMin(), display.GetWindowLevelMax()) == (0, 255)
    assert not display.GetAutoWindowLevel()


def test_frustum_starts_at_the_camera_and_ends_at_the_edges_of_the_frame(saved):
    case, scene = saved
    points = to_world(scene, case, points_of(node_of(scene, "Camera frustum", "vtkMRMLModelNode")))
    np.testing.assert_allclose(points[0], [25, -18, 90], atol=1e-4)
    edges = [(-0.5, -0.5), (95.5, -0.5), (95.5, 79.5), (-0.5, 79.5)]
    np.testing.assert_allclose(project(points[1:]), edges, atol=1e-3)


def test_outline_is_the_boundary_of_the_drawn_vessels(saved):
    from ExpectedAppearancesLib.masks.renderer import MaskRenderer

    case, scene = saved
    outline = node_of(scene, "Predicted outline", "vtkMRMLModelNode")
    points_mm = points_of(outline)
    plane_mm = matrix_of(node_of(scene, "Microscope frame", "vtkMRMLVectorVolumeNode").GetIJKToRASMatrix)[2, 3]
    np.testing.assert_allclose(points_mm[:, 2], plane_mm, atol=1e-3)
    pixels = np.rint(project(to_world(scene, case, points_mm))).astype(int)
    inside = (pixels >= 0).all(axis=1) & (pixels < [CAMERA.width, CAMERA.height]).all(axis=1)
    assert inside.sum() > 100

    far_below = case.cortex.vertices_mm - [0, 0, 30]  # out of the way: nothing hides the vessels
    with MaskRenderer(case.vessels, type(case.cortex)(far_below, case.cortex.triangles), CAMERA) as renderer:
        mask = (renderer.render(POSE) == 2).astype(np.uint8)
    u, v = pixels[inside].T
    grown = cv2.dilate(mask, np.ones((3, 3), np.uint8))
    assert grown[v, u].all()

    # And the other way round: drawn as lines, it follows the whole boundary of the mask.
    lines = np.full(mask.shape, 255, np.uint8)
    for i in range(outline.GetPolyData().GetNumberOfCells()):
        ends = outline.GetPolyData().GetCell(i).GetPointIds()
        cv2.line(lines, pixels[ends.GetId(0)].tolist(), pixels[ends.GetId(1)].tolist(), 0)
    distance_px = cv2.distanceTransform(lines, cv2.DIST_L2, 5)
    boundary = (mask == 1) & (cv2.erode(mask, np.ones((3, 3), np.uint8)) == 0)
    assert distance_px[boundary].max() <= 1.5
    assert (
        outline.GetDisplayNode().GetSliceDisplayModeAsString(outline.GetDisplayNode().GetSliceDisplayMode())
        == "projection"
    )


def test_distorted_frames_are_straightened():
    camera = Camera(96, 80, 182.0, 178.0, 50.0, 37.5, (-3.0, 0.0, 0.0, 0.0, 0.0))
    image = np.zeros((80, 96, 3), np.uint8)
    ray = np.array([[(12 - 50.0) / 182, (10 - 37.5) / 178, 1.0]])
    u, v = np.rint(camera.project(ray)[0]).astype(int)
    assert np.hypot(u - 12, v - 10) > 4
    image[v - 1 : v + 2, u - 1 : u + 2] = 255
    scene = scenes.new_scene()
    parent = scenes.add_camera_transform(scene, np.eye(4))
    volume = scenes.add_frame(scene, image, camera, 100.0, parent)
    assert volume.GetImageData().GetScalarComponentAsDouble(12, 10, 0, 0) > 200


def test_what_cannot_be_saved_is_refused_and_leaves_nothing(tmp_path, monkeypatch):
    inputs = cases.write_inputs(tmp_path)
    case = Case.create(tmp_path / "case", inputs["vessels.vtp"], None, inputs["camera.json"])
    out = tmp_path / "out"
    image = frame_of(CAMERA)
    from_behind = np.diag([1.0, -1.0, -1.0, 1.0]) @ POSE  # OpenGL axes
    for message, arguments in {
        "ends in .mrb": (image, CAMERA, POSE, out / "scene.txt"),
        "does not fit the camera": (image[:, ::2], CAMERA, POSE, out / "a.mrb"),
        "behind the camera": (image, CAMERA, from_behind, out / "a.mrb"),
        "rigid": (image, CAMERA, 2 * POSE, out / "a.mrb"),
    }.items():
        with pytest.raises(InputError, match=message):
            scenes.save_registered_scene(case, *arguments)
    monkeypatch.setitem(sys.modules, "slicer", None)
    with pytest.raises(InputError, match="pip install slicer-core"):
        scenes.save_registered_scene(case, image, CAMERA, POSE, out / "a.mrb")
    assert not out.exists()


def test_saving_again_replaces_the_scene_and_leaves_no_other_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = Path("scene.mrb")  # as the demo gives it: relative, which Slicer itself refuses
    path.write_text("old")
    scene = scenes.new_scene()
    scenes.add_camera_transform(scene, np.eye(4))
    scenes.write_bundle(scene, path)
    assert zipfile.is_zipfile(path)
    assert [p.name for p in tmp_path.iterdir()] == ["scene.mrb"]
    (tmp_path / "folder.mrb").mkdir()
    with pytest.raises(InputError, match="cannot be written"):
        scenes.write_bundle(scene, tmp_path / "folder.mrb")
