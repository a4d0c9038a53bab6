"""The nodes of a live session: made once, then only given new pixels, points and matrices.

The frame, its frustum and all that is drawn over it lie in camera mm under one transform, CameraToRAS, as scene.py
says. A frame and its pose are always set together; what belongs to no accepted pose is hidden, not left where it was.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..case.case import Case
from ..geometry.camera import Camera
from ..geometry.pose import camera_to_ras
from ..live.overlay import Overlay
from ..live.session import LiveResult
from . import scene as scenes
from .live_nodes import ROLE_ATTRIBUTE, mark, node_of_role, remove_live_nodes
from .vtk_data import line_polydata, set_image, vtk_matrix

FIRST_PLANE_MM = 200.0  # where the frame is put up before any pose says how far the vessels are
PLANE_CHANGE = 0.1  # share by which the vessels' depth may leave the plane before the plane follows
TRUE_RGB, PREDICTED_RGB = (0.16, 0.86, 0.24), (0.20, 0.43, 1.0)  # the paper's figure: true green, predicted blue
ASIDE_MM = 1e5  # farther than anything of a patient lies
FRAME, TRANSFORM, FRUSTUM, ASIDE = "frame", "transform", "frustum", "aside"
OUTLINE, TRUTH, BOX, FILL, COLOURS, BACKDROP = "outline", "truth", "box", "fill", "colours", "backdrop"
NAMES = {OUTLINE: "Predicted outline", TRUTH: "True outline", BOX: "Vessel box"}
RGB = {OUTLINE: PREDICTED_RGB, TRUTH: TRUE_RGB, BOX: (1.0, 0.82, 0.2)}


@dataclass(frozen=True)
class OverlayOptions:
    """What the user wants to see over the frame; fill_opacity 0..1."""

    outline: bool = True
    fill: bool = True
    fill_opacity: float = 0.35
    box: bool = False


class LiveScene:
    """Adds the case and the live nodes to `scene`; `close` takes them out again.

    The frame and the transform of an earlier recording are used again, so that one pair of nodes is what all views,
    recordings and outside listeners (OpenIGTLink) look at.
    """

    def __init__(self, scene, case: Case):
        self._scene, self._case = scene, case
        remove_live_nodes(scene, but=(FRAME, TRANSFORM))
        self.options = OverlayOptions()
        self.overlay_visible = False
        self.is_aligned_by_hand = False  # while it is, the vessels are seen over a frame whose pose was refused, too
        self.camera: Camera | None = None
        self.camera_to_ras = np.eye(4)
        self.plane_mm = FIRST_PLANE_MM
        self._view_pixel_mm = 0.0
        self._drawn: dict[str, tuple] = {}
        self._stamp: tuple | None = None
        self.models = scenes.add_case_models(scene, case)
        for name, node in self.models.items():
            mark(node, name)
        self._vessel_points = self._points_of_vessels()
        self.transform = node_of_role(scene, TRANSFORM)
        if self.transform is None:
            self.transform = mark(scenes.add_camera_transform(scene, self.camera_to_ras), TRANSFORM)
        else:
            self.camera_to_ras = scenes.matrix_of(self.transform)
        self.frame = node_of_role(scene, FRAME)
        self._aside, self._is_aside = self._add_aside(), False
        self.frustum = None
        self.lines = {role: self._add_lines(role) for role in NAMES}
        self._filled = np.zeros((2, 2), np.uint8)
        self.fill = self._add_fill()
        self.backdrop = None

    def show(self, result: LiveResult) -> bool:
        """Put up a frame with its pose and overlay. True when the image plane moved or the frame changed its size.

        A result without a picture changes nothing but hides the overlay.
        """
        if result.image_rgb is None:
            self.set_overlay_visible(False)
            return False
        self.follow_models()
        changed = self._set_geometry(result.camera, result.overlay)
        self._set_pixels(result.image_rgb, changed)
        if result.overlay is not None:
            self.set_pose(result.camera_from_world)
            self.draw(result.overlay, result.camera)
        self.set_overlay_visible(result.overlay is not None)
        self.show_truth(None, None)
        self._stamp = self._newest_change()
        return changed

    def show_again(self, result: LiveResult) -> None:
        """Put the frame and the pose that are shown back where a recording has played into their nodes."""
        if result.image_rgb is not None:
            self._set_pixels(result.image_rgb, changed=True)
            scenes.set_pose(self.transform, self.camera_to_ras)
            self._stamp = self._newest_change()

    @property
    def damage(self) -> str:
        """What the user did to the nodes that no frame can be shown with, in words; '' where nothing."""
        if self._points_of_vessels() != self._vessel_points:  # no camera would follow that
            return "The vessels in the scene were changed: edited, or a transform of theirs was hardened"
        nodes = (self.transform, self.frame, self.frustum, self.fill, self.backdrop)
        nodes += (*self.models.values(), *self.lines.values())
        if not all(self._scene.IsNodePresent(node) for node in nodes if node is not None):
            return "Something that the live views need was removed from the scene"
        return ""

    def _points_of_vessels(self) -> tuple | None:
        data = self.models[scenes.VESSELS].GetPolyData()
        points = data.GetPoints() if data is not None else None
        return None if points is None else (points, points.GetMTime())

    @property
    def camera_to_world(self) -> np.ndarray:
        """Camera mm to what the views show: RAS, moved as the case's models are where they hang under a transform."""
        return scenes.matrix_of(self.transform, to_world=True)

    @property
    def picture_to_world(self) -> np.ndarray:
        """Camera mm to where the picture is seen in the microscope's view."""
        return self.camera_to_world @ _aside_matrix() if self._is_aside else self.camera_to_world

    def put_picture_aside(self, aside: bool) -> None:
        """Move the picture far along the optical axis, or back. Slicer draws in the microscope's view what its plane
        cuts: over a frame without a pose, segments and curves would be an overlay of the pose before."""
        self._is_aside = aside
        wanted = self._aside if aside else self.transform
        if self.frame is not None and self.frame.GetParentTransformNode() is not wanted:
            self.frame.SetAndObserveTransformNodeID(wanted.GetID())

    def follow_models(self) -> None:
        """Hang camera and frame under the linear transform that the user put the vessels under, if any."""
        parent = self.models[scenes.VESSELS].GetParentTransformNode()
        if parent is not None and parent.GetAttribute(ROLE_ATTRIBUTE):
            return  # the handles of the alignment: then the vessels move and the camera does not
        if parent is not None and not parent.IsTransformToWorldLinear():
            parent = None  # a camera cannot be deformed
        if self.transform.GetParentTransformNode() is not parent:
            self.transform.SetAndObserveTransformNodeID(parent.GetID() if parent is not None else None)

    @property
    def intact(self) -> bool:
        """Whether frame and transform are still as they were put up: a recording plays into the same nodes."""
        return self._stamp is None or self._stamp == self._newest_change()

    def _newest_change(self) -> tuple:
        data = self.frame.GetImageData()
        # The transform's own: the user may move what it hangs under.
        return data.GetMTime() if data is not None else 0, self.transform.GetTransformToParent().GetMTime()

    def take_replayed(self, camera: Camera) -> bool:
        """The frame node was given a recorded frame of `camera`. True when the plane or the frame's size changed."""
        from vtkmodules.vtkCommonMath import vtkMatrix4x4

        self.follow_models()
        self.frame.SetAndObserveTransformNodeID(self.transform.GetID())  # one that the user removed is made anew
        matrix = vtkMatrix4x4()
        self.frame.GetIJKToRASMatrix(matrix)
        self._stamp = self._newest_change()
        return self._put_plane(camera, matrix.GetElement(2, 3))

    def put_plane_at(self, depth_mm: float) -> None:
        """Put the frame that is shown at that distance from the camera, and what is drawn over it with it."""
        if self._put_plane(self.camera, depth_mm):
            self._place_frame()
            self._place_fill(self.camera)
            self._draw_lines_again()

    def set_pose(self, camera_from_world: np.ndarray) -> None:
        self.camera_to_ras = camera_to_ras(camera_from_world, self._case.space)
        scenes.set_pose(self.transform, self.camera_to_ras)
        if self._stamp is not None:
            self._stamp = self._newest_change()

    def draw(self, overlay: Overlay, camera: Camera) -> None:
        """Outline, box and fill of a pose, onto the image plane."""
        self._draw_lines(OUTLINE, camera, overlay.outline_px, overlay.outline_lines)
        self._draw_lines(BOX, camera, overlay.box_px, overlay.box_lines)
        was_modifying = self.fill.StartModify()
        self._filled = overlay.fill
        self._show_fill()
        self._place_fill(camera)
        self.fill.EndModify(was_modifying)

    def show_truth(self, overlay: Overlay | None, camera: Camera | None) -> None:
        """The true outline in green, for the frame that is shown; None takes it away."""
        if overlay is not None:
            self._draw_lines(TRUTH, camera, overlay.outline_px, overlay.outline_lines)
        _set_visible(self.lines[TRUTH], overlay is not None)

    def set_view_pixel(self, view_pixel_mm: float) -> None:
        """Tell the size of the microscope view's pixels on the image plane; the lines are drawn anew if it changed.

        Slicer draws an image half a pixel of the view to the right of, and above, models at the same place.
        """
        if abs(view_pixel_mm - self._view_pixel_mm) > 0.02 * view_pixel_mm:
            self._view_pixel_mm = view_pixel_mm
            self._draw_lines_again()

    def show_lines_in(self, view_ids: tuple[str, ...]) -> None:
        """Draw the lines in these views only; () for all. An edge-on outline would be a stroke across the MRI."""
        for node in self.lines.values():
            display = node.GetDisplayNode()
            if tuple(display.GetViewNodeIDs()) != view_ids:
                display.RemoveAllViewNodeIDs()
                for view_id in view_ids:
                    display.AddViewNodeID(view_id)

    def set_overlay_visible(self, visible: bool) -> None:
        """Show or hide all that depends on the pose: outline, fill, box and frustum."""
        if visible != self.overlay_visible:
            self.overlay_visible = visible
            self._show_fill()
        _set_visible(self.lines[OUTLINE], visible and self.options.outline)
        _set_visible(self.lines[BOX], visible and self.options.box)
        if self.frustum is not None:
            _set_visible(self.frustum, visible)

    @property
    def vessels_visible(self) -> bool:
        """Whether the vessels themselves may be seen over the frame."""
        return self.overlay_visible or self.is_aligned_by_hand

    @property
    def fill_opacity(self) -> float:
        """Opacity of the label layer in the views: 0 when unwanted. It is empty where the overlay is hidden."""
        return self.options.fill_opacity if self.options.fill else 0.0

    def set_options(self, options: OverlayOptions) -> None:
        self.options = options
        self._draw_lines_again()
        self.set_overlay_visible(self.overlay_visible)

    def show_backdrop(self, view_id: str) -> None:
        """Hang the frame up behind the vessels, in one 3D view: that through the camera."""
        if self.frame is None or self.camera is None:
            return
        if self.backdrop is None:
            self.backdrop = mark(self._scene.AddNewNodeByClass("vtkMRMLModelNode", "Microscope backdrop"), BACKDROP)
            self.backdrop.CreateDefaultDisplayNodes()
            self.backdrop.SetAndObserveTransformNodeID(self.transform.GetID())
            for node in (self.backdrop, self.backdrop.GetDisplayNode()):
                node.SetSaveWithScene(False)
            self.backdrop.SetSelectable(False)
            display = self.backdrop.GetDisplayNode()
            display.SetLighting(False)
            display.SetInterpolateTexture(True)
            display.AddViewNodeID(view_id)
            self._backdrop_of = None
        display, picture = self.backdrop.GetDisplayNode(), self.frame.GetImageDataConnection()
        if display.GetTextureImageDataConnection() is not picture:  # a recording gives the frame another image
            display.SetTextureImageDataConnection(picture)
        if self._backdrop_of != (self.camera, self.plane_mm):
            self._backdrop_of = (self.camera, self.plane_mm)
            behind_mm = self.plane_mm + 3 * self._case.vessels.radius_mm
            self.backdrop.SetAndObservePolyData(scenes.textured_frame(self.camera, behind_mm))
        _set_visible(self.backdrop, self.vessels_visible)

    def close(self) -> None:
        """Take the live nodes out of the scene; those that a recording plays into stay, hidden overlay aside."""
        self.put_picture_aside(False)
        remove_live_nodes(self._scene)

    def _set_geometry(self, camera: Camera, overlay: Overlay | None) -> bool:
        """Put the image plane where the vessels are; it follows only large changes, so that views keep their zoom."""
        plane_mm = self.plane_mm
        if overlay is not None and abs(overlay.depth_mm / plane_mm - 1) > PLANE_CHANGE:
            plane_mm = overlay.depth_mm
        return self._put_plane(camera, plane_mm)

    def _put_plane(self, camera: Camera, plane_mm: float) -> bool:
        if camera == self.camera and abs(plane_mm - self.plane_mm) < 1e-6:
            return False
        self.camera, self.plane_mm = camera, plane_mm
        if self.frustum is None:
            self.frustum = mark(scenes.add_frustum(self._scene, camera, plane_mm, self.transform), FRUSTUM)
            self.frustum.SetSelectable(False)
            for node in (self.frustum, self.frustum.GetDisplayNode()):
                node.SetSaveWithScene(False)
        else:
            scenes.set_frustum(self.frustum, camera, plane_mm)
        return True

    def _set_pixels(self, image_rgb: np.ndarray, changed: bool) -> None:
        if self.frame is None:
            self.frame = scenes.add_frame(self._scene, image_rgb, self.camera, self.plane_mm, self.transform)
            mark(self.frame, FRAME)
            return
        was_modifying = self.frame.StartModify()
        if changed:
            self._place_frame()
        set_image(self.frame, image_rgb)
        self.frame.EndModify(was_modifying)

    def _place_frame(self) -> None:
        self.frame.SetIJKToRASMatrix(vtk_matrix(scenes.camera_from_pixel(self.camera, self.plane_mm)))
        self.frame.SetAndObserveTransformNodeID(self.transform.GetID())

    def _show_fill(self) -> None:
        """The filled vessels, or an empty layer while they are not to be seen. Taken off a view and put on again, the
        layer would have Slicer write the view's annotations anew: 100 ms."""
        filled = self._filled if self.overlay_visible else np.zeros_like(self._filled)
        set_image(self.fill, filled[..., None])

    def _place_fill(self, camera: Camera) -> None:
        small = camera.resized(*self.fill.GetImageData().GetDimensions()[:2])
        self.fill.SetIJKToRASMatrix(vtk_matrix(scenes.camera_from_pixel(small, self.plane_mm)))

    def _add_aside(self):
        node = mark(self._scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "Microscope picture aside"), ASIDE)
        node.SetHideFromEditors(True)
        scenes.set_pose(node, _aside_matrix())
        node.SetAndObserveTransformNodeID(self.transform.GetID())
        return node

    def _add_lines(self, role: str):
        from vtkmodules.vtkCommonDataModel import vtkPolyData

        node = mark(self._scene.AddNewNodeByClass("vtkMRMLModelNode", NAMES[role]), role)
        node.SetAndObservePolyData(vtkPolyData())
        node.CreateDefaultDisplayNodes()
        node.SetAndObserveTransformNodeID(self.transform.GetID())
        node.SetSelectable(False)
        node.SetSaveWithScene(False)  # in a saved scene nobody would judge whether it may be shown
        display = node.GetDisplayNode()
        display.SetSaveWithScene(False)
        display.SetColor(*RGB[role])
        display.SetLighting(False)
        display.SetLineWidth(2)
        display.SetVisibility2D(True)
        display.SetSliceDisplayModeToProjection()  # parallel, which on the frame's own plane is the camera's view
        display.SetSliceIntersectionThickness(3 if role == TRUTH else 2)
        display.SetVisibility(False)
        return node

    def _draw_lines_again(self) -> None:
        for role, drawn in self._drawn.items():
            self._draw_lines(role, *drawn)

    def _draw_lines(self, role: str, camera: Camera, points_px: np.ndarray, lines: np.ndarray) -> None:
        self._drawn[role] = (camera, points_px, lines)
        if not {OUTLINE: self.options.outline, BOX: self.options.box}.get(role, True):
            return
        plane = scenes.camera_from_pixel(camera, self.plane_mm)
        plane[:2, 3] += 0.5 * self._view_pixel_mm, -0.5 * self._view_pixel_mm
        points_mm = np.column_stack([points_px, np.zeros(len(points_px))]) @ plane[:3, :3].T + plane[:3, 3]
        self.lines[role].SetAndObservePolyData(line_polydata(points_mm, lines))

    def _add_fill(self):
        colours = self._scene.AddNode(_colour_table())
        node = mark(self._scene.AddNewNodeByClass("vtkMRMLLabelMapVolumeNode", "Predicted vessels"), FILL)
        set_image(node, self._filled[..., None])
        node.CreateDefaultDisplayNodes()
        node.GetDisplayNode().SetAndObserveColorNodeID(colours.GetID())
        node.SetAndObserveTransformNodeID(self.transform.GetID())
        node.SetSelectable(False)
        node.SetSaveWithScene(False)
        node.GetDisplayNode().SetSaveWithScene(False)
        return node


def _aside_matrix() -> np.ndarray:
    """Camera mm to camera mm."""
    matrix = np.eye(4)
    matrix[2, 3] = ASIDE_MM
    return matrix


def _set_visible(model, visible: bool) -> None:
    display = model.GetDisplayNode()
    if display is not None and bool(display.GetVisibility()) != visible:
        display.SetVisibility(visible)


def _colour_table():
    import slicer

    table = slicer.vtkMRMLColorTableNode()
    table.SetName("Predicted vessels colours")
    table.SetTypeToUser()
    table.SetHideFromEditors(True)
    table.SetSaveWithScene(False)
    table.SetNumberOfColors(2)
    table.SetColor(0, "none", 0, 0, 0, 0)
    table.SetColor(1, "vessels", *PREDICTED_RGB, 1)
    return mark(table, COLOURS)
