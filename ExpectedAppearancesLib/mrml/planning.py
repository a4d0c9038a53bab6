"""What planning takes from the scene (models, segments, craniotomies) and shows in it (cameras, label maps).

The scene's world is RAS, mm. Nodes that the user made are read, never changed: transforms are applied to a copy.
"""

from __future__ import annotations

import numpy as np

from ..case.meshes import Mesh
from ..errors import InputError
from ..geometry.camera import Camera
from ..geometry.pose import RAS_FROM_LPS, camera_to_ras, inverse, ras_from_world, transform
from ..masks.labels import CLASS_NAMES
from ..poses.craniotomy import Craniotomy, find_craniotomy
from .scene import camera_from_pixel, camera_from_slice, fitted_mm_per_px, frame_corners, remove_node
from .segment_surface import no_surface
from .vtk_data import image_data, line_polydata, vtk_matrix

FRUSTUMS, LOOKED_THROUGH, MASK = "Sampled cameras", "Camera looked through", "Label map seen"
MASK_COLOURS = "Label map colours"
CLASS_COLOURS = ((0.0, 0.0, 0.0, 0.0), (0.90, 0.75, 0.68, 1.0), (0.82, 0.13, 0.15, 1.0))
FRUSTUM_COLOUR, LOOKED_THROUGH_COLOUR = (0.20, 0.45, 0.75), (1.0, 0.82, 0.2)
ROUNDING_MM = 1e-3  # of single precision
LOOKED_FROM_MM = 200.0
FRUSTUM_LENGTH = 0.18  # of the distance to the craniotomy: cameras stay recognisable and do not cover the cortex


def world_mesh(node, segment_id: str = "", space: str = "LPS", surface: Mesh | None = None) -> Mesh:
    """Surface of a model node, or of one segment of a segmentation node, with all its transforms applied.

    space: axes of the result, 'LPS' or 'RAS', mm. surface: that of the segment in the segmentation's own RAS, where it
    was made before. Raises InputError when there is no surface.
    """
    if surface is not None:
        if node.GetParentTransformNode() is None:
            return surface if space == "RAS" else _turned(surface)
        polydata = surface.to_polydata(normals=False)
    elif node.IsA("vtkMRMLSegmentationNode"):
        polydata = _segment_surface(node, segment_id)
    else:
        polydata = node.GetPolyData()
    if polydata is None or not polydata.GetNumberOfPoints():
        raise InputError(f"{node.GetName()}: holds no surface; choose another model, or segment the vessels first.")
    polydata = _in_world(node, polydata)
    try:
        mesh = Mesh.from_polydata(polydata)
    except InputError as error:
        raise InputError(f"{node.GetName()}: {error}; make the model again.") from error
    if not len(mesh.triangles):
        raise InputError(f"{node.GetName()}: has no triangles; choose a surface, not points or centrelines.")
    if not np.isfinite(mesh.vertices_mm).all():
        raise InputError(f"{node.GetName()}: has points whose coordinates are not numbers; make the model again.")
    return mesh if space == "RAS" else _turned(mesh)


def _turned(mesh: Mesh) -> Mesh:
    """From RAS to LPS or back."""
    return Mesh(transform(RAS_FROM_LPS, mesh.vertices_mm), mesh.triangles)


def same_mesh(first: Mesh, second: Mesh) -> bool:
    """Whether two meshes are the same up to the rounding of single precision."""
    return (
        first.vertices_mm.shape == second.vertices_mm.shape
        and np.array_equal(first.triangles, second.triangles)
        and bool(np.abs(first.vertices_mm - second.vertices_mm).max(initial=0.0) <= ROUNDING_MM)
    )


def _segment_surface(node, segment_id: str):
    """Closed surface of a segment, in the segmentation's own coordinates; made in a copy where there is none yet."""
    import slicer
    import vtk

    segmentation = node.GetSegmentation()
    if not segment_id or segmentation.GetSegment(segment_id) is None:
        raise InputError(f"{node.GetName()}: choose the segment that holds the vessels.")
    copy = slicer.vtkSegmentation()
    copy.SetSourceRepresentationName(segmentation.GetSourceRepresentationName())
    copy.CopySegmentFromSegmentation(segmentation, segment_id)
    copy.CopyConversionParameters(segmentation)
    name = slicer.vtkSegmentationConverter.GetSegmentationClosedSurfaceRepresentationName()
    if not copy.CreateRepresentation(name):
        raise InputError(no_surface(node.GetName()))
    surface = vtk.vtkPolyData()
    surface.DeepCopy(copy.GetSegment(segment_id).GetRepresentation(name))
    return surface


def _in_world(node, polydata):
    import vtk

    if node.GetParentTransformNode() is None:
        return polydata
    to_world = vtk.vtkGeneralTransform()
    node.GetParentTransformNode().GetTransformToWorld(to_world)
    mover = vtk.vtkTransformPolyDataFilter()
    mover.SetTransform(to_world)
    mover.SetInputData(polydata)
    mover.Update()
    return mover.GetOutput()


def craniotomy_of_markups(
    node, vessels: Mesh, cortex: Mesh | None, space: str, fitted_axis: np.ndarray | None = None
) -> Craniotomy:
    """From a point (its first control point), or a closed curve around the craniotomy.

    A point keeps the fitted outward axis (found here where it is not given); a curve gives its own, the normal of the
    plane through it. Raises InputError when nothing is placed yet, or a curve is too short to have a plane.
    """
    points_ras = markup_points_ras(node)
    if not len(points_ras):
        raise InputError(f"{node.GetName()}: holds no point yet; click on the cortex in the 3D view.")
    points = transform(ras_from_world(space), points_ras)  # its own inverse
    if not node.IsA("vtkMRMLMarkupsCurveNode"):
        return find_craniotomy(vessels, cortex, space, points[0], fitted_axis)
    if fitted_axis is None:
        fitted_axis = find_craniotomy(vessels, cortex, space).outward_axis
    # Weighted by length: the points of a curve lie denser where its control points do.
    ends = np.roll(points, -1, axis=0)
    lengths = np.linalg.norm(ends - points, axis=1)
    centre = np.average((points + ends) / 2, axis=0, weights=lengths) if lengths.any() else points[0]
    if node.GetNumberOfDefinedControlPoints() < 3:
        raise InputError(f"{node.GetName()}: has fewer than 3 points; draw the curve around the whole craniotomy.")
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][2]
    if normal @ fitted_axis < 0:
        normal = -normal
    return find_craniotomy(vessels, cortex, space, centre, normal)


def markup_points_ras(node) -> np.ndarray:
    """(N, 3) points of a markups node, RAS mm: along the curve where it is one, else the placed control points."""
    import vtk

    points = vtk.vtkPoints()
    if node.IsA("vtkMRMLMarkupsCurveNode") and node.GetCurvePointsWorld():
        points = node.GetCurvePointsWorld()
    else:
        node.GetControlPointPositionsWorld(points)
    count = min(points.GetNumberOfPoints(), 10**6)
    # A point that follows the mouse is listed before it is placed.
    count = count if node.GetNumberOfDefinedControlPoints() else 0
    return np.array([points.GetPoint(i) for i in range(count)], float).reshape(-1, 3)


def frustum_polydata(camera: Camera, poses: np.ndarray, lengths_mm: np.ndarray, space: str):
    """One vtkPolyData in RAS mm: for each pose (N, 4, 4) four edges from the camera's centre, and the image's frame.

    lengths_mm (N,): depth at which the frame of each one is drawn. An extra tick marks the image's upper side.
    """
    tick = ((camera.width - 1) / 2, -0.5 - 0.12 * camera.height, 0)
    pixels = np.vstack([frame_corners(camera), tick])
    lines = np.array([(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1), (1, 5), (5, 2)])
    points_mm, all_lines = [], []
    for pose, length_mm in zip(poses, lengths_mm):
        of_camera = np.vstack([np.zeros(3), transform(camera_from_pixel(camera, length_mm), pixels)])
        all_lines.append(lines + 6 * len(points_mm))
        points_mm.append(transform(camera_to_ras(pose, space), of_camera))
    if not points_mm:
        return line_polydata(np.zeros((0, 3)), np.zeros((0, 2), np.int64))
    return line_polydata(np.vstack(points_mm), np.vstack(all_lines))


def frustum_lengths_mm(poses: np.ndarray, centre_world_mm: np.ndarray) -> np.ndarray:
    """(N,) lengths at which the cameras of `poses` are drawn."""
    return np.array([FRUSTUM_LENGTH * max(transform(pose, centre_world_mm)[2], 1.0) for pose in poses])


def line_model(scene, node, name: str, polydata, colour, width: float = 1.0):
    """Show `polydata` as the lines of `node`, which is made where it is None or was removed; returns the node."""
    if node is None or not scene.IsNodePresent(node):
        node = _add_hidden(scene, "vtkMRMLModelNode", name)
        node.SetAndObservePolyData(polydata)  # first: without lines there is nothing to draw, with them once
        display = _new_display(node, "vtkMRMLModelDisplayNode")
        display.SetColor(*colour)
        display.SetLighting(False)
        display.SetLineWidth(width)
        display.SetVisibility2D(False)
        node.SetAndObserveDisplayNodeID(scene.AddNode(display).GetID())
    else:
        node.SetAndObservePolyData(polydata)
    return node


def show_mask(scene, nodes: dict, labels: np.ndarray, camera: Camera, camera_from_world, plane_mm: float, space: str):
    """Put a label map (H, W) on the plane z = plane_mm of its camera; `nodes` keeps the nodes between calls.

    Returns the vtkMRMLLabelMapVolumeNode; its IJKToRAS, under the transform that `nodes` holds too, puts pixel (u, v)
    where the ray of that pixel meets the plane.
    """
    parent = nodes.get("transform")
    if parent is None or not scene.IsNodePresent(parent):
        parent = nodes["transform"] = _add_hidden(scene, "vtkMRMLLinearTransformNode", LOOKED_THROUGH)
    parent.SetMatrixTransformToParent(vtk_matrix(camera_to_ras(camera_from_world, space)))
    volume = nodes.get("mask")
    new = volume is None or not scene.IsNodePresent(volume)
    if new:
        volume = nodes["mask"] = _add_hidden(scene, "vtkMRMLLabelMapVolumeNode", MASK)
    volume.SetIJKToRASMatrix(vtk_matrix(camera_from_pixel(camera, plane_mm)))
    volume.SetAndObserveImageData(image_data(labels.astype(np.int16)))
    if new:
        display = _new_display(volume, "vtkMRMLLabelMapVolumeDisplayNode")
        display.SetAndObserveColorNodeID(_mask_colours(scene, nodes).GetID())
        volume.SetAndObserveDisplayNodeID(scene.AddNode(display).GetID())
        volume.SetAndObserveTransformNodeID(parent.GetID())
    return volume


def look_at_mask(slice_node, camera: Camera, camera_from_world, plane_mm: float, space: str) -> None:
    """Turn a slice view to the plane on which `show_mask` puts a label map, upright, the whole map in view."""
    view_width, view_height = slice_node.GetDimensions()[:2]
    mm_per_px = fitted_mm_per_px(slice_node, camera, plane_mm)
    to_ras = camera_to_ras(camera_from_world, space) @ camera_from_slice(camera, plane_mm)
    modifying = slice_node.StartModify()  # the view answers to each change, else
    slice_node.GetSliceToRAS().DeepCopy(vtk_matrix(to_ras))
    slice_node.UpdateMatrices()
    slice_node.SetFieldOfView(mm_per_px * view_width, mm_per_px * view_height, slice_node.GetFieldOfView()[2])
    slice_node.EndModify(modifying)


def look_onto(camera_node, craniotomy: Craniotomy, space: str) -> None:
    """Put a 3D view's camera over the craniotomy, upright as an upright microscope, looking at its centre."""
    to_ras = ras_from_world(space)[:3, :3]
    centre, outward, up = (to_ras @ v for v in (craniotomy.centre_world_mm, craniotomy.outward_axis, craniotomy.up))
    camera_node.SetFocalPoint(*centre)
    camera_node.SetPosition(*(centre + LOOKED_FROM_MM * outward))
    camera_node.SetViewUp(*up)
    camera_node.ResetClippingRange()


def plane_through(centre_world_mm: np.ndarray, camera_from_world: np.ndarray) -> float:
    """Depth, mm, of the plane through a point; at least 1 mm, so that a plane can always be drawn."""
    return max(float(transform(camera_from_world, centre_world_mm)[2]), 1.0)


def view_direction(camera_from_world: np.ndarray, craniotomy: Craniotomy) -> tuple[float, float]:
    """Tilt of the optical axis from the outward axis, degrees, and working distance, mm, for captions."""
    towards_camera = -np.asarray(camera_from_world)[2, :3]
    tilt = np.degrees(np.arccos(np.clip(towards_camera @ craniotomy.outward_axis, -1, 1)))
    centre_mm = inverse(np.asarray(camera_from_world, float))[:3, 3]
    return float(tilt), float(np.linalg.norm(centre_mm - craniotomy.centre_world_mm))


def remove_nodes(scene, nodes: dict) -> None:
    """Remove what `nodes` holds from the scene, display and storage nodes included."""
    for node in list(nodes.values()):
        remove_node(scene, node)
    nodes.clear()


def _new_display(node, kind: str):
    """A display node that is not in the scene yet, so that it can be set up before anything is drawn."""
    display = node.GetScene().CreateNodeByClass(kind)
    display.UnRegister(None)
    display.SetSaveWithScene(False)
    return display


def _mask_colours(scene, nodes: dict):
    table = nodes["colours"] = _add_hidden(scene, "vtkMRMLColorTableNode", MASK_COLOURS)
    table.SetTypeToUser()
    table.SetNumberOfColors(len(CLASS_COLOURS))
    for value, (name, colour) in enumerate(zip(CLASS_NAMES, CLASS_COLOURS)):
        table.SetColor(value, name, *colour)
    return table


def _add_hidden(scene, kind: str, name: str):
    """A node that comes and goes with the panel: not listed for the user, not saved with the scene."""
    node = scene.AddNewNodeByClass(kind, name)
    node.SetHideFromEditors(True)
    node.SetSaveWithScene(False)
    return node
