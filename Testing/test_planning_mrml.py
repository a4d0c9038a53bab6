"""Planning on slicer-core's real scene: models and segments in, cameras and label maps out, measured with OpenCV."""

from __future__ import annotations

import sys

import cases
import cv2
import numpy as np
import pytest

from ExpectedAppearancesLib.case.meshes import read_mesh
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.evaluation.verdict import OWN_VALIDATION, Figures
from ExpectedAppearancesLib.geometry.camera import Camera
from ExpectedAppearancesLib.geometry.pose import look_at
from ExpectedAppearancesLib.masks.renderer import MaskRenderer
from ExpectedAppearancesLib.poses.craniotomy import Craniotomy, find_craniotomy

slicer = pytest.importorskip("slicer")
import vtk  # noqa: E402 (after the skip)
from planning_scene import LPS, add_model, add_transform, turned  # noqa: E402
from vtk.util.numpy_support import vtk_to_numpy  # noqa: E402

from ExpectedAppearancesLib.mrml import charts, labelling, planning  # noqa: E402
from ExpectedAppearancesLib.mrml.planning_session import write_plain_mesh  # noqa: E402

POSE = look_at(np.array([25.0, -18.0, 90.0]), np.array([1.0, 0.5, -2.0]), np.array([0.2, 1.0, 0.0]))


@pytest.mark.parametrize("space", ["LPS", "RAS"])
def test_models_are_taken_in_world_coordinates_and_left_alone(scene, space):
    mesh = cases.vessels()
    node = add_model(scene, mesh)
    second = np.diag([1.0, 1.0, 1.0, 1.0])
    second[:3, 3] = 0.0, 100.0, 0.0
    node.SetAndObserveTransformNodeID(add_transform(scene, turned(), add_transform(scene, second)).GetID())
    before = node.GetPolyData().GetMTime()
    found = planning.world_mesh(node, space=space)
    expected_ras = mesh.vertices_mm @ turned()[:3, :3].T + turned()[:3, 3] + [0, 100, 0]
    np.testing.assert_allclose(found.vertices_mm * (LPS if space == "LPS" else 1), expected_ras, atol=1e-4)
    np.testing.assert_array_equal(found.triangles, mesh.triangles)
    assert node.GetPolyData().GetMTime() == before
    assert node.GetParentTransformNode() is not None


@pytest.mark.parametrize("space", ["LPS", "RAS"])
def test_model_file_and_back_keeps_the_space(scene, tmp_path, space):
    """Slicer's own storage node is the judge of what the file's coordinates are."""
    mesh = planning.world_mesh(add_model(scene, cases.vessels()), space=space)
    write_plain_mesh(tmp_path / "mesh.vtk", mesh, space)
    np.testing.assert_allclose(read_mesh(tmp_path / "mesh.vtk", "mesh").vertices_mm, mesh.vertices_mm, atol=1e-9)
    storage = slicer.vtkMRMLModelStorageNode()
    storage.SetFileName(str(tmp_path / "mesh.vtk"))
    node = scene.AddNewNodeByClass("vtkMRMLModelNode")
    assert storage.ReadData(node)
    in_ras = vtk_to_numpy(node.GetPolyData().GetPoints().GetData())
    np.testing.assert_allclose(in_ras, cases.vessels().vertices_mm, atol=1e-4)


def test_segment_becomes_a_surface_in_a_copy(scene):
    image = slicer.vtkOrientedImageData()
    image.SetDimensions(40, 40, 40)
    image.SetSpacing(0.5, 0.5, 0.5)
    image.SetOrigin(10, 20, 30)
    image.AllocateScalars(vtk.VTK_UNSIGNED_CHAR, 1)
    voxels = vtk_to_numpy(image.GetPointData().GetScalars()).reshape(40, 40, 40)
    voxels[:] = 0
    voxels[10:30, 10:20, 10:20] = 1  # k, j, i
    node = scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "Segmentation")
    node.AddSegmentFromBinaryLabelmapRepresentation(image, "Vessels")
    identifier = node.GetSegmentation().GetNthSegmentID(0)
    shift = np.eye(4)
    shift[:3, 3] = 100, 0, 0
    node.SetAndObserveTransformNodeID(add_transform(scene, shift).GetID())
    mesh = planning.world_mesh(node, identifier, "RAS")
    # Voxel centres 10..19 and 10..29, half a millimetre apart, from the origin.
    middle = np.array([110, 20, 30]) + 0.5 * np.array([14.5, 14.5, 19.5])
    np.testing.assert_allclose((mesh.vertices_mm.min(0) + mesh.vertices_mm.max(0)) / 2, middle, atol=0.05)
    np.testing.assert_allclose(np.ptp(mesh.vertices_mm, axis=0), [5, 5, 10], atol=0.6)
    assert not node.GetSegmentation().ContainsRepresentation("Closed surface")
    with pytest.raises(InputError, match="choose the segment"):
        planning.world_mesh(node, "absent")


def test_what_has_no_surface_is_refused(scene):
    node = scene.AddNewNodeByClass("vtkMRMLModelNode", "Empty")
    with pytest.raises(InputError, match="Empty: holds no surface"):
        planning.world_mesh(node)
    line = vtk.vtkLineSource()
    line.Update()
    node.SetAndObservePolyData(line.GetOutput())
    with pytest.raises(InputError, match="no triangles"):
        planning.world_mesh(node)
    mesh = cases.vessels()
    mesh.vertices_mm[3, 1] = np.nan
    with pytest.raises(InputError, match=r"Bad: .* not numbers"):
        planning.world_mesh(add_model(scene, mesh, "Bad"))


def test_craniotomy_from_a_point_and_from_a_curve(scene):
    vessels, cortex = cases.vessels(), cases.dome()
    point = scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", "Point")
    with pytest.raises(InputError, match="click on the cortex"):
        planning.craniotomy_of_markups(point, vessels, cortex, "LPS")
    point.AddControlPoint(*(np.array([3.0, 4.0, -1.0]) * LPS))
    found = planning.craniotomy_of_markups(point, vessels, cortex, "LPS")
    np.testing.assert_allclose(found.centre_world_mm, [3, 4, -1], atol=1e-9)
    np.testing.assert_allclose(found.outward_axis, find_craniotomy(vessels, cortex).outward_axis)

    curve = scene.AddNewNodeByClass("vtkMRMLMarkupsClosedCurveNode", "Curve")
    normal = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
    across = np.linalg.svd(normal[None])[2][1:]
    # Many points on one side: the centre must not be drawn there.
    for angle in np.concatenate([np.linspace(0, np.pi, 9)[:-1], [np.pi, 1.5 * np.pi]]):
        position = np.array([1.0, 2.0, 3.0]) + 10 * (np.cos(angle) * across[0] + np.sin(angle) * across[1])
        curve.AddControlPoint(*(position * LPS))
        if curve.GetNumberOfControlPoints() == 2:
            with pytest.raises(InputError, match="fewer than 3"):
                planning.craniotomy_of_markups(curve, vessels, cortex, "LPS")
    found = planning.craniotomy_of_markups(curve, vessels, cortex, "LPS")
    np.testing.assert_allclose(found.centre_world_mm, [1, 2, 3], atol=0.6)
    np.testing.assert_allclose(found.outward_axis, normal, atol=0.02)


@pytest.mark.parametrize("space", ["LPS", "RAS"])
def test_frustums_hold_what_their_cameras_see(scene, space):
    """The drawn corners, projected by OpenCV, are the image's corners; the tick is above the image's upper side."""
    camera = cases.camera()
    poses = np.stack([POSE, look_at(np.array([-9.0, 30.0, 70.0]), np.zeros(3), np.array([0.0, 1.0, 0.2]))])
    lengths_mm = planning.frustum_lengths_mm(poses, np.zeros(3))
    polydata = planning.frustum_polydata(camera, poses, lengths_mm, space)
    points = vtk_to_numpy(polydata.GetPoints().GetData()).reshape(2, 6, 3) * (LPS if space == "LPS" else 1)
    for pose, corners in zip(poses, points):
        np.testing.assert_allclose(pose[:3, :3] @ corners[0] + pose[:3, 3], 0, atol=1e-9)
        rotation = cv2.Rodrigues(pose[:3, :3])[0]
        pixels = cv2.projectPoints(corners[1:], rotation, pose[:3, 3], camera.matrix, None)[0].reshape(-1, 2)
        right, bottom = camera.width - 0.5, camera.height - 0.5
        np.testing.assert_allclose(
            pixels[:4], [[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom]], atol=1e-6
        )
        assert pixels[4, 1] < -5
    assert polydata.GetNumberOfLines() == 20
    node = planning.line_model(scene, None, "Cameras", polydata, (1, 0, 0))
    count = scene.GetNumberOfNodes()
    assert planning.line_model(scene, node, "Cameras", polydata, (1, 0, 0)) is node
    assert scene.GetNumberOfNodes() == count


class SliceView:
    """A slice view without Qt, of the size of the label map's pixels."""

    def __init__(self, scene, size):
        self.logic = slicer.vtkMRMLSliceLogic()
        self.logic.SetMRMLApplicationLogic(scene.keep_alive[0])
        scene.keep_alive[0].GetSliceLogics().AddItem(self.logic)
        slicer.vtkMRMLSliceNode.AddDefaultSliceOrientationPresets(scene, True)
        self.logic.SetMRMLScene(scene)
        self.node = self.logic.AddSliceNode("Red")
        self.logic.ResizeSliceNode(*size)

    def pixels(self) -> np.ndarray:
        """RGB (H, W, 3), top row first."""
        connection = self.logic.GetImageDataConnection()
        connection.GetProducer().Update()
        image = connection.GetProducer().GetOutputDataObject(connection.GetIndex())
        width, height, _ = image.GetDimensions()
        return vtk_to_numpy(image.GetPointData().GetScalars()).reshape(height, width, -1)[::-1, :, :3]


@pytest.mark.parametrize("space", ["LPS", "RAS"])
def test_label_map_in_the_slice_view_is_the_librarys_pixel_by_pixel(scene, space):
    camera = Camera(96, 80, 180.0, 180.0, 50.0, 37.5)  # square pixels, as a slice view has
    with MaskRenderer(cases.vessels(), cases.dome(), camera) as renderer:
        labels = renderer.render(POSE)
    assert set(np.unique(labels)) == {0, 1, 2}
    plane_mm = planning.plane_through(np.zeros(3), POSE)
    nodes: dict = {}
    volume = planning.show_mask(scene, nodes, labels, camera, POSE, plane_mm, space)
    view = SliceView(scene, (camera.width, camera.height))
    planning.look_at_mask(view.node, camera, POSE, plane_mm, space)
    view.logic.GetSliceCompositeNode().SetLabelVolumeID(volume.GetID())
    view.logic.GetSliceCompositeNode().SetLabelOpacity(1.0)
    shown = view.pixels().astype(int)
    colours = (255 * np.array(planning.CLASS_COLOURS)[:, :3]).round().astype(int)
    nearest = np.abs(shown[:, :, None] - colours).sum(axis=-1).argmin(axis=-1)
    np.testing.assert_array_equal(nearest, labels)
    # Another pose moves the same nodes.
    count = scene.GetNumberOfNodes()
    assert planning.show_mask(scene, nodes, labels, camera, POSE, 50.0, space) is volume
    assert scene.GetNumberOfNodes() == count
    planning.remove_nodes(scene, nodes)
    assert scene.GetNumberOfNodesByClass("vtkMRMLLabelMapVolumeNode") == 0
    assert nodes == {}


@pytest.mark.parametrize("space", ["LPS", "RAS"])
def test_the_3d_view_looks_onto_the_craniotomy_as_an_upright_microscope(scene, space):
    centre, outward, up = np.array([10.0, 20.0, 30.0]), np.array([0.6, 0.0, 0.8]), np.array([0.0, 1.0, 0.0])
    craniotomy = Craniotomy(centre, outward, up)
    camera_node = scene.AddNewNodeByClass("vtkMRMLCameraNode")
    planning.look_onto(camera_node, craniotomy, space)
    flip = np.array([1.0, 1.0, 1.0] if space == "RAS" else [-1.0, -1.0, 1.0])
    focal, position = np.array(camera_node.GetFocalPoint()), np.array(camera_node.GetPosition())
    np.testing.assert_allclose(focal, centre * flip)
    np.testing.assert_allclose((position - focal) / np.linalg.norm(position - focal), outward * flip, atol=1e-12)
    np.testing.assert_allclose(camera_node.GetViewUp(), up * flip)


def test_photograph_and_labels_survive_the_segment_editors_form(scene):
    rng = np.random.default_rng(4)
    image = rng.integers(0, 255, (40, 60, 3), dtype=np.uint8)
    labels = np.ones((40, 60), np.uint8)
    labels[5:9, 10:50] = 2
    labels[:, :3] = 0
    before = scene.GetNumberOfNodes()
    nodes = labelling.add_photograph(scene, "cortex", image, labels)
    np.testing.assert_array_equal(labelling.labels_of(nodes), labels)
    segmentation = nodes["segmentation"].GetSegmentation()
    outside = segmentation.GetSegmentIdBySegmentName("Outside of the cortex")
    segmentation.GetSegment(outside).SetName("Dura")  # by the user
    np.testing.assert_array_equal(labelling.labels_of(nodes), labels)
    segmentation.RemoveSegment(outside)
    np.testing.assert_array_equal(labelling.labels_of(nodes), np.maximum(labels, 1))
    planning.remove_nodes(scene, nodes)
    assert scene.GetNumberOfNodes() == before
    nodes = labelling.add_photograph(scene, "no vessels", image, np.ones((40, 60), np.uint8))
    assert (labelling.labels_of(nodes) == 1).all()
    assert nodes["segmentation"].GetSegmentation().GetNumberOfSegments() == 2  # to draw into


SHARES = ("Within 3 mm, 3° (%)", "Accepted below 3 mm (%)")


def test_plots_are_found_again_and_filled_anew(scene):
    curve = [{"step": 10, "loss": None, "validation_add_mm": 5.0}, {"step": 20, "loss": 1.0, "validation_add_mm": 4.0}]
    chart = charts.show_training(scene, curve)
    assert chart.GetNumberOfPlotSeriesNodes() == 1  # VTK logs an error for a line of one point
    count = scene.GetNumberOfNodes()
    curve.append({"step": 30, "loss": 0.5, "validation_add_mm": float("nan")})
    assert charts.show_training(scene, curve) is chart
    assert scene.GetNumberOfNodes() == count
    series = {chart.GetNthPlotSeriesNode(i).GetName(): chart.GetNthPlotSeriesNode(i) for i in range(2)}
    rows = {name: node.GetTableNode().GetNumberOfRows() for name, node in series.items()}
    assert rows == {"Validation ADD (mm)": 2, "Loss": 2}
    charts.show_training(scene, [])
    assert [series[name].GetTableNode().GetNumberOfRows() for name in rows] == [0, 0]
    table, chart = charts.show_figures(scene, [Figures("strict", "a", *[1.0] * 8)], 3.0)
    assert (table.GetNumberOfRows(), chart.GetNumberOfPlotSeriesNodes()) == (1, 1)
    own = Figures(OWN_VALIDATION, "", accepted_add_mm=0.5, accepted_right=0.5)
    charts.show_figures(scene, [Figures("strict", "a", *[1.0] * 8), own], 3.0)
    shares = [[table.GetCellText(i, table.GetColumnIndex(name)) for i in range(2)] for name in SHARES]
    assert shares == [["100.00", ""], ["100.00", "50.00"]]
    assert charts.show_figures(scene, [], 3.0) == (table, chart)
    assert (table.GetNumberOfRows(), chart.GetNumberOfPlotSeriesNodes()) == (0, 0)


KEEP_THE_CONTEXT = """
import sys
sys.path.insert(0, sys.argv[1])
import cases, numpy as np, vtk
from ExpectedAppearancesLib.geometry.pose import look_at
from ExpectedAppearancesLib.masks.renderer import MaskRenderer
pose = look_at(np.array([0.0, 0.0, 100.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
renderer = MaskRenderer(cases.vessels(), cases.dome(), cases.camera())
view = vtk.vtkRenderWindow()
view.AddRenderer(vtk.vtkRenderer())
view.Render()
renderer.render(pose)
renderer.render_surface(pose)
print(bool(view.IsCurrent()))
"""


def test_drawing_a_label_map_leaves_the_views_context_current():
    """Slicer's views and the label maps share one thread; a display is needed to have two contexts."""
    import shutil
    import subprocess
    from pathlib import Path

    if shutil.which("xvfb-run") is None:
        pytest.skip("xvfb-run is not installed, and without a display there is one context only")
    command = ["xvfb-run", "-a", sys.executable, "-c", KEEP_THE_CONTEXT, str(Path(__file__).parent)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stdout.split()[-1:] == ["True"], done.stdout + done.stderr
