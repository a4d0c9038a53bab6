"""How the views look at a live frame: the microscope's slice, the view through its camera, and the MRI beneath it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from ..geometry.camera import Camera
from . import scene as scenes
from .live_scene import LiveScene

MICROSCOPE, THROUGH, OVERVIEW, MRI = "Microscope", "MicroscopeCamera", "MicroscopeOverview", "MicroscopeMRI"
DEPTH_VIEW_FRAMES = 2.5  # how many frames high the MRI's slice along the optical axis is shown
FIRST_LAYOUT_ID = 617  # free ids are sought from here on; Slicer's own end below 100

_VIEWS = """
<layout type="horizontal" split="true">
 <item splitSize="620">
  <view class="vtkMRMLSliceNode" singletontag="{microscope}">
   <property name="orientation" action="default">Axial</property>
   <property name="viewlabel" action="default">M</property>
   <property name="viewcolor" action="default">#2E6FDB</property>
  </view>
 </item>
 <item splitSize="380">
  <layout type="vertical" split="true">
   <item splitSize="330">
    <view class="vtkMRMLViewNode" singletontag="{overview}">
     <property name="viewlabel" action="default">O</property>
    </view>
   </item>
   <item splitSize="330">
    <view class="vtkMRMLViewNode" singletontag="{through}">
     <property name="viewlabel" action="default">C</property>
    </view>
   </item>{depth}
  </layout>
 </item>
</layout>
"""
_DEPTH_VIEW = """
   <item splitSize="330">
    <view class="vtkMRMLSliceNode" singletontag="{mri}">
     <property name="orientation" action="default">Axial</property>
     <property name="viewlabel" action="default">D</property>
     <property name="viewcolor" action="default">#8C6BB1</property>
    </view>
   </item>"""


def layout_description(with_mri: bool) -> str:
    """The live layout in Slicer's XML; without an MRI there is no view for it."""
    depth = _DEPTH_VIEW.format(mri=MRI) if with_mri else ""
    return _VIEWS.format(microscope=MICROSCOPE, overview=OVERVIEW, through=THROUGH, depth=depth)


class LiveViews:
    """The views of the live layout. slice_logic: of the view that shows the frame. through_view: gives view node,
    camera node and size (px) of the view through the camera, or None while there is none; depth_view: gives slice node,
    composite node and volume's id of the MRI's, or None. line_view_ids: of the views that outlines are drawn in; () for
    all."""

    def __init__(
        self,
        slice_logic,
        through_view: Callable[[], tuple | None],
        depth_view: Callable[[], tuple | None] = lambda: None,
        line_view_ids: tuple[str, ...] = (),
    ):
        self._slice, self._composite = slice_logic.GetSliceNode(), slice_logic.GetSliceCompositeNode()
        self._intensity = UnusedIntensity(slice_logic)
        self._through_view, self._depth_view = through_view, depth_view
        self._line_view_ids = line_view_ids
        self._fitted: tuple | None = None
        self._depth_fitted = None
        self._live: LiveScene | None = None  # what was followed last
        self._laid: list | None = None  # where the slice was laid
        self._aimed: tuple | None = None  # the camera node that looks through the microscope's, and from where

    def follow(self, live: LiveScene, changed: bool) -> None:
        """Lay all views onto the frame of `live`; what depends on a pose that is not trusted is not shown."""
        size = self._slice.GetDimensions()[:2]
        camera_to_world = live.camera_to_world
        visible = live.vessels_visible
        live.put_picture_aside(not visible)
        self._live = live
        sample_by_rows(self._slice)
        align_slice(self._slice, live.camera, live.picture_to_world, live.plane_mm)
        self._laid = _lies(self._slice)
        if changed or self._fitted != (size, live.camera):
            self._fitted = (size, live.camera)
            fit_slice(self._slice, live.camera, live.plane_mm)
        live.set_view_pixel(view_pixel_mm(self._slice))
        live.show_lines_in(self._line_view_ids)
        show_layers(self._composite, live.frame, live.fill, live.fill_opacity)
        self._intensity.skip()
        if bool(self._slice.GetSliceVisible()) != visible:
            self._slice.SetSliceVisible(visible)
        depth = self._depth_view()
        if depth is not None:
            self._follow_in_depth(depth, live, camera_to_world, changed)
        through = self._through_view()
        if through is not None:
            view_node, camera_node, view_size_px = through
            live.show_backdrop(view_node.GetID())
            if visible:
                aim_camera(camera_node, view_size_px, live.camera, camera_to_world, live.plane_mm)
            else:
                look_away(camera_node)
            self._aimed = (camera_node, _place_of(camera_node)) if visible else None

    def was_moved(self) -> bool:
        """Whether the user turned or zoomed the view through the camera: from elsewhere the vessels lie on other parts
        of the picture behind them. Or moved the slice, as the mouse's wheel does: outlines stay without the picture."""
        aimed = self._aimed is not None and self._aimed[1] != _place_of(self._aimed[0])
        return aimed or (self._laid is not None and self._laid != _lies(self._slice))

    def _follow_in_depth(self, view: tuple, live: LiveScene, camera_to_world: np.ndarray, changed: bool) -> None:
        slice_node, composite, volume_id = view
        visible = live.overlay_visible
        wanted = volume_id if visible else None
        if composite.GetBackgroundVolumeID() != wanted:
            composite.SetBackgroundVolumeID(wanted)
        if bool(slice_node.GetSliceVisible()) != visible:
            slice_node.SetSliceVisible(visible)
        if not visible:
            return
        align_depth_slice(slice_node, camera_to_world, live.plane_mm)
        if changed or self._depth_fitted is not slice_node:
            self._depth_fitted = slice_node
            fit_slice(slice_node, live.camera, DEPTH_VIEW_FRAMES * live.plane_mm)

    def let_go(self) -> None:
        """The view samples as Slicer does by itself; the layers stay."""
        self._intensity.restore()

    def leave(self) -> None:
        """Nothing of the live frame stays in the views."""
        self.let_go()
        if self._live is not None:
            self._live.put_picture_aside(False)  # where CameraToRAS has it, for other modules and files
        self._aimed = self._laid = self._live = None
        self._slice.SetSliceVisible(False)
        for put in (self._composite.SetBackgroundVolumeID, self._composite.SetLabelVolumeID):
            put(None)


def add_layout(layout_node, with_mri: bool = True) -> int:
    """Make the layout known to Slicer once; returns its id."""
    description = layout_description(with_mri)
    layout_id = FIRST_LAYOUT_ID
    while layout_node.IsLayoutDescription(layout_id):
        if layout_node.GetLayoutDescription(layout_id).strip() == description.strip():
            return layout_id
        layout_id += 1
    layout_node.AddLayoutDescription(layout_id, description)
    return layout_id


def align_slice(slice_node, camera: Camera, camera_to_ras: np.ndarray, plane_mm: float) -> None:
    """Lay the slice onto the image plane, upright; zoom and pan stay as they are."""
    _set_slice_to_ras(slice_node, camera_to_ras @ scenes.camera_from_slice(camera, plane_mm))


def fit_slice(slice_node, camera: Camera, plane_mm: float) -> None:
    """Zoom so that the whole frame is in view, with square pixels whatever the shape of the view."""
    view_width, view_height = slice_node.GetDimensions()[:2]
    mm_per_px = scenes.fitted_mm_per_px(slice_node, camera, plane_mm)
    slice_node.SetXYZOrigin(0, 0, 0)
    slice_node.SetFieldOfView(mm_per_px * view_width, mm_per_px * view_height, mm_per_px)


def view_pixel_mm(slice_node) -> float:
    """Size of a pixel of the slice view, mm."""
    return slice_node.GetFieldOfView()[0] / max(slice_node.GetDimensions()[0], 1)


def sample_by_rows(slice_node) -> None:
    """Let Slicer sample the frame row by row, which takes a third of the time and gives the same pixels.

    VTK does so where the space between a slab's slices is 1, and Slicer asks for that space for a single slice too: it
    is the slices' spacing by the oversampling. The spacing says only how far a scroll moves, and one slice has no next.
    """
    spacing_mm = slice_node.GetSlabReconstructionOversamplingFactor()
    if slice_node.GetPrescribedSliceSpacing()[2] != spacing_mm:
        slice_node.SetPrescribedSliceSpacing(1.0, 1.0, spacing_mm)
    if slice_node.GetSliceSpacingMode() != slice_node.PrescribedSliceSpacingMode:
        slice_node.SetSliceSpacingModeToPrescribed()


class UnusedIntensity:
    """Keeps one slice view from working out the intensity of every pixel of a colour image for a threshold that is off.

    Slicer does so for each frame, by way of hue and saturation. Where its pipeline is another one, nothing changes.
    """

    def __init__(self, slice_logic):
        self._logic = slice_logic
        self._display = self._component = self._intensity = None

    def skip(self) -> None:
        """Call it for each frame: Slicer builds the pipeline anew with another volume."""
        layer = self._logic.GetBackgroundLayer()
        display = layer.GetVolumeDisplayNode() if layer is not None else None
        if display is not self._display:
            self._display = display
            is_colour = display is not None and display.IsA("vtkMRMLVectorVolumeDisplayNode")
            self._component = _component_for_alpha(display) if is_colour else None
            self._intensity = self._component.GetInputConnection(0, 0) if self._component is not None else None
        picture = display.GetInputImageDataConnection() if self._component is not None else None
        if picture is None:
            return
        wanted = self._intensity if display.GetApplyThreshold() else picture
        if self._component.GetInputConnection(0, 0) is not wanted:
            self._component.SetInputConnection(wanted)

    def restore(self) -> None:
        if self._component is not None:
            self._component.SetInputConnection(self._intensity)
        self._display = self._component = self._intensity = None


def _component_for_alpha(display):
    """The filter that takes the intensity out of hue, saturation and intensity, or None.

    At the end of Slicer's pipeline colours and alpha are joined, and alpha is made of the intensity.
    """
    producer, which = display.GetOutputImageDataConnection().GetProducer(), 1
    while producer.GetNumberOfInputPorts() and producer.GetNumberOfInputConnections(0) > which:
        above = producer.GetInputConnection(0, which).GetProducer()
        if above.IsA("vtkImageRGBToHSI"):
            return producer
        producer, which = above, 0
    return None


def align_depth_slice(slice_node, camera_to_ras: np.ndarray, plane_mm: float) -> None:
    """Lay the slice along the optical axis: image right to the right, into the head downwards, centred on the frame."""
    slice_to_camera = np.eye(4)
    slice_to_camera[:3, 1], slice_to_camera[:3, 2] = (0, 0, -1), (0, 1, 0)
    slice_to_camera[2, 3] = plane_mm
    _set_slice_to_ras(slice_node, camera_to_ras @ slice_to_camera)


def show_layers(composite_node, frame, fill, fill_opacity: float) -> None:
    """The frame as background, the filled vessels as label layer if they are to be seen; sets only what changed."""
    fill = fill if fill_opacity > 0 else None  # a layer that nobody sees is sampled all the same
    for get, put, node in (
        (composite_node.GetBackgroundVolumeID, composite_node.SetBackgroundVolumeID, frame),
        (composite_node.GetLabelVolumeID, composite_node.SetLabelVolumeID, fill),
    ):
        wanted = node.GetID() if node is not None else None
        if get() != wanted:
            put(wanted)
    if composite_node.GetLabelOpacity() != fill_opacity:
        composite_node.SetLabelOpacity(fill_opacity)


def aim_camera(camera_node, view_size_px: tuple[int, int], camera: Camera, camera_to_ras: np.ndarray, depth_mm: float):
    """Make a 3D view of view_size_px (width, height) look through `camera`: the whole frame fits into the view.

    The principal point becomes the window centre, which no scene saves: call this again after loading a scene and
    whenever the size of the view changes. Pixels that are not square (fx != fy) are shown in true proportion.
    """

    width, height = max(view_size_px[0], 1), max(view_size_px[1], 1)
    # Pixels of the view per pixel of the frame, downwards; across, fx / fy stretches pixels that are not square.
    stretch = camera.fx / camera.fy
    scale = min(height / camera.height, width / (camera.width / stretch))
    position = camera_to_ras[:3, 3]
    vtk_camera = camera_node.GetCamera()
    was_modifying = camera_node.StartModify()
    camera_node.SetParallelProjection(False)
    camera_node.SetPosition(*position)
    camera_node.SetFocalPoint(*(position + depth_mm * camera_to_ras[:3, 2]))
    camera_node.SetViewUp(*-camera_to_ras[:3, 1])
    camera_node.SetViewAngle(math.degrees(2 * math.atan(height / scale / (2 * camera.fy))))
    vtk_camera.SetWindowCenter(
        -2 * (camera.cx - (camera.width - 1) / 2) / stretch * scale / width,
        2 * (camera.cy - (camera.height - 1) / 2) * scale / height,
    )
    camera_node.EndModify(was_modifying)
    camera_node.ResetClippingRange()


def _place_of(camera_node) -> tuple:
    return camera_node.GetPosition(), camera_node.GetParallelProjection()


def _lies(slice_node) -> list:
    matrix = slice_node.GetSliceToRAS()
    return [matrix.GetElement(i, j) for i in range(4) for j in range(4)]


def look_away(camera_node) -> None:
    """Turn a 3D view's camera from everything: what it showed belonged to a pose that does not hold any more."""
    x, y, z = camera_node.GetPosition()
    camera_node.SetFocalPoint(x, y, z + 1e5)
    camera_node.SetPosition(x, y, z + 1e5 - 1)
    camera_node.SetViewUp(0, 1, 0)


def _set_slice_to_ras(slice_node, matrix: np.ndarray) -> None:
    wanted = np.asarray(matrix, float).ravel().tolist()
    was_modifying = slice_node.StartModify()
    slice_node.GetSliceToRAS().DeepCopy(wanted)
    slice_node.UpdateMatrices()
    slice_node.EndModify(was_modifying)
