"""The views of the live panel inside Slicer: its own layout, banners over the pictures, and the way back."""

from __future__ import annotations

import slicer

from ..live.status import Status
from ..mrml import live_views
from ..mrml.live_banner import Banner
from . import live_texts


class LayoutSection:
    """Shows the live layout while the module is open; the layout that was there before returns on `leave`."""

    def __init__(self):
        self.views: live_views.LiveViews | None = None
        self._before: int | None = None
        self._banners: list = []
        self._with_mri = False
        self._mri_id: str | None = None
        self._overview_of: str | None = None  # the case that the 3D overview shows whole

    @property
    def active(self) -> bool:
        return self._before is not None

    def enter(self) -> live_views.LiveViews | None:
        """Switch to the live layout; None where Slicer runs without a window."""
        manager = slicer.app.layoutManager()
        if manager is None:
            return None
        layout_node = manager.layoutLogic().GetLayoutNode()
        # A scene that is being closed has no layout for a moment: the one to go back to is then known from before.
        ours = self._layout_ids(layout_node) | {slicer.vtkMRMLLayoutNode.SlicerLayoutNone}
        if layout_node.GetViewArrangement() not in ours:
            self._before = layout_node.GetViewArrangement()
        elif self._before is None:
            self._before = slicer.vtkMRMLLayoutNode.SlicerLayoutConventionalView
        layout_node.SetViewArrangement(live_views.add_layout(layout_node, self._with_mri))
        widget = manager.sliceWidget(live_views.MICROSCOPE)
        overview, through = self._three_d(live_views.OVERVIEW), self._three_d(live_views.THROUGH)
        if widget is None or overview is None or through is None:
            return None
        if self.views is not None:
            self.views.let_go()
        shown_in = [view.mrmlViewNode() for view in (overview, through)]
        for node in shown_in:  # nothing but the patient and the picture
            node.SetBoxVisible(False)
            node.SetAxisLabelsVisible(False)
        ids = tuple(node.GetID() for node in (widget.mrmlSliceNode(), *shown_in))
        _hide_slider(widget)
        self.views = live_views.LiveViews(widget.sliceLogic(), self._through, self._depth, ids)
        self._overview_of = None
        self._restrict_slice(widget.mrmlSliceNode())
        if not self._banners:
            for view in (widget.sliceView(), through.threeDView()):
                renderer = view.renderWindow().GetRenderers().GetFirstRenderer()
                self._banners.append((view, Banner(renderer)))
        return self.views

    def leave(self) -> None:
        """Give the user's layout back, unless another one was chosen meanwhile."""
        manager = slicer.app.layoutManager()
        for _view, banner in self._banners:
            banner.remove()
        self._banners = []
        if self.views is not None:
            self.views.leave()
        self.views = None
        if manager is not None and self._before is not None:
            layout_node = manager.layoutLogic().GetLayoutNode()
            if layout_node.GetViewArrangement() in self._layout_ids(layout_node):
                layout_node.SetViewArrangement(self._before)
        self._before = None

    def show(self, status: Status) -> None:
        """Say over the pictures what may be thought of them."""
        text, rgb = live_texts.banner(status), live_texts.COLOURS[status.verdict.sight]
        for view, banner in self._banners:
            if banner.say(text, rgb):
                view.scheduleRender()
        shows = self.views is not None and status.new and status.verdict.shows_overlay
        if shows and status.result.case_key != self._overview_of:
            self._overview_of = status.result.case_key
            view = self._three_d(live_views.OVERVIEW).threeDView()
            view.resetFocalPoint()
            view.resetCamera()

    def show_mri(self, volume) -> bool:
        """The volume for the depth view; without one there is no such view. True when it has come: the views put it up
        where they follow the frame again."""
        manager = slicer.app.layoutManager()
        if manager is None:
            return False
        wanted_id = volume.GetID() if volume is not None else None
        has_come = wanted_id not in (None, self._mri_id)
        self._mri_id, self._with_mri = wanted_id, volume is not None
        layout_node = manager.layoutLogic().GetLayoutNode()
        wanted = live_views.add_layout(layout_node, self._with_mri)
        if layout_node.GetViewArrangement() in self._layout_ids(layout_node) - {wanted}:
            layout_node.SetViewArrangement(wanted)
        widget = manager.sliceWidget(live_views.MRI)
        if widget is None:
            return False
        _hide_slider(widget)
        composite = widget.sliceLogic().GetSliceCompositeNode()
        composite.SetForegroundVolumeID(None)
        composite.SetLabelVolumeID(None)
        if volume is None:
            composite.SetBackgroundVolumeID(None)
            widget.mrmlSliceNode().SetSliceVisible(False)
        self._restrict_slice(widget.mrmlSliceNode())
        return has_come

    @staticmethod
    def _layout_ids(layout_node) -> set[int]:
        return {live_views.add_layout(layout_node, with_mri) for with_mri in (False, True)}

    def _depth(self) -> tuple | None:
        """Slice node, composite node and the volume's id of the MRI's view, or None without an MRI."""
        widget = slicer.app.layoutManager().sliceWidget(live_views.MRI) if self._with_mri else None
        if widget is None:
            return None
        return widget.mrmlSliceNode(), widget.sliceLogic().GetSliceCompositeNode(), self._mri_id

    def _through(self) -> tuple | None:
        """View node, camera node and size of the view through the camera."""
        widget = self._three_d(live_views.THROUGH)
        if widget is None:
            return None
        node = widget.mrmlViewNode()
        camera_node = slicer.modules.cameras.logic().GetViewActiveCameraNode(node)
        size = tuple(widget.threeDView().renderWindow().GetSize())
        return None if camera_node is None else (node, camera_node, size)

    def _restrict_slice(self, slice_node) -> None:
        """Draw a slice in the overview only: in the view through the camera the frame would hide the vessels."""
        overview = self._three_d(live_views.OVERVIEW)
        if overview is not None and not slice_node.GetNumberOfThreeDViewIDs():
            slice_node.AddThreeDViewID(overview.mrmlViewNode().GetID())

    @staticmethod
    def _three_d(name: str):
        manager = slicer.app.layoutManager()
        for i in range(manager.threeDViewCount):
            widget = manager.threeDWidget(i)
            if widget.mrmlViewNode() is not None and widget.mrmlViewNode().GetSingletonTag() == name:
                return widget
        return None


def _hide_slider(slice_widget) -> None:
    """The plane is the pose's. With each plane the slider's number changes its width, and Slicer lays out and draws all
    views anew for that, 40 ms and more."""
    slice_widget.sliceController().sliceOffsetSlider().hide()
