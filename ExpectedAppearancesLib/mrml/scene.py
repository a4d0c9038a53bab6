"""A registered frame as a 3D Slicer scene.

The scene's world is RAS, mm. The frame, its frustum and the predicted outline lie in camera mm (OpenCV axes) under one
linear transform, 'CameraToRAS': a new pose moves them all. Whoever has a scene calls the add_... functions, which need
no more than that.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np

from .. import files
from ..case.case import Case
from ..case.meshes import Mesh
from ..errors import ExpectedAppearancesError, InputError
from ..geometry.camera import Camera, undistorted
from ..geometry.pose import camera_to_ras, is_rigid, ras_from_world, transform
from ..geometry.silhouette import Silhouette
from .vtk_data import array_of, image_data, line_polydata, vtk_matrix

VESSELS, CORTEX = "Vessels", "Cortex"
FRAME, FRUSTUM, OUTLINE = "Microscope frame", "Camera frustum", "Predicted outline"
CAMERA_TO_RAS = "CameraToRAS"
COLOURS = {VESSELS: (0.82, 0.13, 0.15), CORTEX: (0.90, 0.75, 0.68), FRUSTUM: (1.0, 0.82, 0.2), OUTLINE: (0.15, 1, 0.3)}


def save_registered_scene(
    case: Case, image_rgb: np.ndarray, camera: Camera, camera_from_world: np.ndarray, path: Path
) -> Path:
    """Write the case's models and one registered frame as a .mrb that Slicer opens; returns its path.

    image_rgb: uint8 (H, W, 3) of the camera's size; a distorted frame is undistorted, since an image plane is flat.
    camera_from_world: 4x4, mm, OpenCV camera, world = the case's files. An existing scene is replaced as a whole.
    Raises InputError: slicer-core missing, wrong image or pose, vessels behind the camera, `path` not writable.
    """
    path = Path(path)
    if path.suffix.lower() != ".mrb":
        raise InputError(f"{path}: scenes are saved as Slicer's bundles; give a name that ends in .mrb.")
    _check_frame(image_rgb, camera)
    pose = np.asarray(camera_from_world, float)
    plane_mm = plane_depth_mm(case.vessels, pose)
    scene = new_scene()
    add_case_models(scene, case)
    parent = add_camera_transform(scene, camera_to_ras(pose, case.space))
    add_frame(scene, image_rgb, camera, plane_mm, parent)
    add_frustum(scene, camera, plane_mm, parent)
    add_outline(scene, Silhouette(case.vessels.vertices_mm, case.vessels.triangles), pose, plane_mm, parent)
    write_bundle(scene, path)
    return path


def new_scene():
    """An empty vtkMRMLScene. Raises InputError where neither Slicer nor slicer-core is there."""
    try:
        import slicer
    except ImportError as error:
        raise InputError(
            f"Slicer scene: the package slicer-core cannot be loaded ({error}); "
            "install the `scene` extra: pip install slicer-core."
        ) from error
    return slicer.vtkMRMLScene()


def plane_depth_mm(vessels: Mesh, camera_from_world: np.ndarray) -> float:
    """Distance from the camera, mm, at which the frame is put up: the median depth of the vessels' vertices.

    Raises InputError for a pose that is not rigid or has the vessels behind the camera.
    """
    if not is_rigid(camera_from_world):
        raise InputError("camera_from_world: not a rigid 4x4 pose; give a rotation and a translation in mm.")
    depth_mm = float(np.median(transform(camera_from_world, vessels.vertices_mm)[:, 2]))
    if depth_mm <= 0:
        raise InputError(
            f"camera_from_world: the vessels lie {-depth_mm:.0f} mm behind the camera; give the pose with OpenCV axes "
            "(x right, y down, z forward), from world to camera."
        )
    return depth_mm


def add_case_models(scene, case: Case) -> dict:
    """Add the models 'Vessels' and, where the case has one, 'Cortex', in RAS mm; returns the nodes by name."""
    names = (VESSELS, CORTEX) if case.cortex is not None else (VESSELS,)
    return {name: add_case_model(scene, case, name) for name in names}


def add_case_model(scene, case: Case, name: str):
    """Add one of the case's models, VESSELS or CORTEX, in RAS mm; returns the node."""
    mesh = case.vessels if name == VESSELS else case.cortex
    in_ras = Mesh(transform(ras_from_world(case.space), mesh.vertices_mm), mesh.triangles)
    node = _add_model(scene, name, in_ras.to_polydata())
    if name == CORTEX:
        node.GetDisplayNode().SetOpacity(0.4)  # vessels below the surface stay visible
    return node


def add_camera_transform(scene, camera_to_ras_matrix: np.ndarray):
    """Add the linear transform 'CameraToRAS': camera mm (OpenCV axes) to RAS mm, 4x4."""
    node = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", CAMERA_TO_RAS)
    set_pose(node, camera_to_ras_matrix)
    return node


def set_pose(transform_node, camera_to_ras_matrix: np.ndarray) -> None:
    transform_node.SetMatrixTransformToParent(vtk_matrix(camera_to_ras_matrix))


def matrix_of(transform_node, to_world: bool = False) -> np.ndarray:
    """4x4 of a linear transform node, to its parent or to the world."""
    from vtkmodules.vtkCommonMath import vtkMatrix4x4

    matrix = vtkMatrix4x4()
    if to_world:
        transform_node.GetMatrixTransformToWorld(matrix)
    else:
        transform_node.GetMatrixTransformToParent(matrix)
    return array_of(matrix)


def add_frame(scene, image_rgb: np.ndarray, camera: Camera, plane_mm: float, parent):
    """Add the vector volume 'Microscope frame' on the plane z = plane_mm of the camera, under the transform `parent`.

    Its IJKToRAS puts the centre of pixel (u, v) = (i, j) where the ray of that pixel meets the plane, in camera mm.
    Raises InputError when image_rgb is not uint8 (H, W, 3) of the camera's size.
    """
    node = scene.AddNewNodeByClass("vtkMRMLVectorVolumeNode", FRAME)
    node.SetIJKToRASMatrix(vtk_matrix(camera_from_pixel(camera, plane_mm)))
    set_frame(node, image_rgb, camera)
    node.CreateDefaultDisplayNodes()
    node.GetDisplayNode().SetAutoWindowLevel(False)
    node.GetDisplayNode().SetWindowLevelMinMax(0, 255)
    node.SetAndObserveTransformNodeID(parent.GetID())
    return node


def set_frame(frame_node, image_rgb: np.ndarray, camera: Camera) -> None:
    """Give the volume new pixels, undistorted where the camera is distorted."""
    _check_frame(image_rgb, camera)
    frame_node.SetAndObserveImageData(image_data(undistorted(image_rgb, camera)))


def camera_from_pixel(camera: Camera, plane_mm: float) -> np.ndarray:
    """4x4: pixel (u, v, 0, 1) -> camera mm on the plane z = plane_mm. Pixel centres at integers, distortion ignored."""
    across, down = plane_mm / camera.fx, plane_mm / camera.fy
    matrix = np.diag([across, down, (across + down) / 2, 1.0])  # k forward: right-handed with x right, y down
    matrix[:3, 3] = -camera.cx * across, -camera.cy * down, plane_mm
    return matrix


def frame_corners(camera: Camera) -> np.ndarray:
    """(4, 3) px: the outer corners (u, v, 0) of the frame, clockwise from the upper left."""
    right, bottom = camera.width - 0.5, camera.height - 0.5
    return np.array([(-0.5, -0.5, 0), (right, -0.5, 0), (right, bottom, 0), (-0.5, bottom, 0)])


def textured_frame(camera: Camera, depth_mm: float):
    """vtkPolyData: the frame's outer edges at that depth in camera mm, with texture coordinates."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    plane = camera_from_pixel(camera, depth_mm)
    points = vtkPoints()
    points.SetData(numpy_to_vtk(frame_corners(camera) @ plane[:3, :3].T + plane[:3, 3], deep=True))
    cells = vtkCellArray()
    cells.InsertNextCell(4, range(4))
    polydata = vtkPolyData()
    polydata.SetPoints(points)
    polydata.SetPolys(cells)
    # Row 0 of the frame is the first row of the texture: v grows downwards, as in the frame.
    coordinates = numpy_to_vtk(np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32), deep=True)
    coordinates.SetName("TextureCoordinates")
    polydata.GetPointData().SetTCoords(coordinates)
    return polydata


def camera_from_slice(camera: Camera, plane_mm: float) -> np.ndarray:
    """4x4: a slice's mm -> camera mm, for a slice that lies upright on the plane z = plane_mm, the frame in its middle.

    Slice views sample at the corners of their pixels: with pixel (W / 2, H / 2 - 1) at the origin the frame is sharp.
    """
    matrix = np.diag([1.0, -1.0, -1.0, 1.0])  # the slice's y points up, the camera's down
    matrix[:, 3] = camera_from_pixel(camera, plane_mm) @ [camera.width / 2, camera.height / 2 - 1, 0, 1]
    return matrix


def fitted_mm_per_px(slice_node, camera: Camera, plane_mm: float) -> float:
    """Size of the view's pixels at which the whole frame on its plane is in view."""
    view_width, view_height = slice_node.GetDimensions()[:2]
    width, height = plane_mm * camera.width / camera.fx, plane_mm * camera.height / camera.fy
    return max(width / max(view_width, 1), height / max(view_height, 1))


def remove_node(scene, node) -> None:
    """With its display nodes, which would stay behind; nothing where it is gone already."""
    if node is None or not scene.IsNodePresent(node):
        return
    displayable = node.IsA("vtkMRMLDisplayableNode")
    displays = [node.GetNthDisplayNode(i) for i in range(node.GetNumberOfDisplayNodes())] if displayable else []
    scene.RemoveNode(node)  # first: Slicer's tables look for the display node of a node that is there
    for display in displays:
        if display is not None and scene.IsNodePresent(display):
            scene.RemoveNode(display)


def add_frustum(scene, camera: Camera, plane_mm: float, parent):
    """Add the line model 'Camera frustum': from the camera's centre to the outer edges of the frame on its plane."""
    node = _add_model(scene, FRUSTUM, _frustum(camera, plane_mm), parent)
    node.GetDisplayNode().SetLighting(False)
    return node


def set_frustum(frustum_node, camera: Camera, plane_mm: float) -> None:
    """Redraw the frustum for a frame of another size or on another plane."""
    frustum_node.SetAndObservePolyData(_frustum(camera, plane_mm))


def _frustum(camera: Camera, plane_mm: float):
    points_mm = np.vstack([np.zeros(3), transform(camera_from_pixel(camera, plane_mm), frame_corners(camera))])
    lines = np.array([(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)])
    return line_polydata(points_mm, lines)


def add_outline(scene, silhouette: Silhouette, camera_from_world: np.ndarray, plane_mm: float, parent):
    """Add the line model 'Predicted outline': the vessels' perspective outline, on the frame's plane in camera mm.

    Slicer projects models onto slices in parallel; on the frame's own plane that equals the camera's view.
    """
    node = _add_model(scene, OUTLINE, _outline(silhouette, camera_from_world, plane_mm), parent)
    display = node.GetDisplayNode()
    display.SetLighting(False)
    display.SetLineWidth(2)
    display.SetVisibility2D(True)
    display.SetSliceDisplayModeToProjection()
    display.SetSliceIntersectionThickness(2)
    return node


def write_bundle(scene, path: Path) -> None:
    """Save the scene with all its data as one .mrb, whole or not at all. Raises InputError when it cannot."""
    path = Path(path).absolute()  # Slicer writes bundles to full paths only
    with files.writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        # Under its final name in a folder of its own: Slicer names the scene inside the bundle after the file.
        with tempfile.TemporaryDirectory(prefix=f".{path.stem}.", suffix=".part", dir=path.parent) as folder:
            temporary = Path(folder) / path.name
            if not scene.WriteToMRB(str(temporary)) or not temporary.is_file():
                raise ExpectedAppearancesError(
                    f"{path}: Slicer could not save the scene; free some space, or choose a shorter path."
                )
            os.replace(temporary, path)


def _check_frame(image_rgb: np.ndarray, camera: Camera) -> None:
    wanted = (camera.height, camera.width, 3)
    if image_rgb.dtype != np.uint8 or image_rgb.shape != wanted:
        raise InputError(
            f"frame: {image_rgb.dtype} of shape {image_rgb.shape} does not fit the camera; "
            f"give uint8 RGB of shape {wanted}, or the camera of this frame size."
        )


def _outline(silhouette: Silhouette, camera_from_world: np.ndarray, plane_mm: float):
    return line_polydata(*silhouette.on_plane(np.asarray(camera_from_world, float), plane_mm))


def _add_model(scene, name: str, polydata, parent=None):
    node = scene.AddNewNodeByClass("vtkMRMLModelNode", name)
    node.SetAndObservePolyData(polydata)
    node.CreateDefaultDisplayNodes()
    node.GetDisplayNode().SetColor(*COLOURS[name])
    if parent is not None:
        node.SetAndObserveTransformNodeID(parent.GetID())
    return node
