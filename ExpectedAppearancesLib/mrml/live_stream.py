"""Frames from a volume node of the scene: an OpenIGTLink stream, a sequence that plays, or any RGB or grey image."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np

from ..live.feed import FeedState, FeedStatus
from ..live.frames import LiveFrame
from .live_nodes import ROLE_ATTRIBUTE


class NodeFrames:
    """Hands on the pixels of a volume node whenever they change; finds the node again when it was removed and returns.

    Call `look` now and then (it costs nothing): it notices a node that left or came back. `close` ends everything.
    """

    def __init__(self, scene, node, deliver: Callable[[LiveFrame], None], clock: Callable[[], float] = time.monotonic):
        self._scene, self._deliver, self._clock = scene, deliver, clock
        self._id, self._name = node.GetID(), node.GetName()
        self._node = self._tags = None
        self._number = 0
        self._stamp: tuple | None = None
        self._problem = ""
        self._taken_s, self._again_s = -math.inf, math.inf
        self._attach(node, -math.inf)  # what it holds may be of yesterday

    @property
    def status(self) -> FeedStatus:
        if self._node is None:
            return FeedStatus(
                FeedState.LOST, f"The volume {self._name} is gone from the scene; frames go on when it returns."
            )
        return FeedStatus(FeedState.RUNNING, self._problem)

    def look(self) -> FeedStatus:
        """Attach or let go as the scene changed; returns the status."""
        if self._node is not None and not self._scene.IsNodePresent(self._node):
            self._detach()
        if self._node is None:
            node = find_volume(self._scene, self._id) or find_volume(self._scene, self._name)
            if node is not None:
                self._attach(node, self._clock())
        elif self._clock() >= self._again_s:
            self._stamp = None
            self._take(self._taken_s)
        return self.status

    def again_after(self, wait_s: float) -> None:
        """Hand on once more what the volume holds, as old as it is, unless it changes before that time is over."""
        self._again_s = self._clock() + wait_s

    def close(self) -> None:
        self._detach()
        self._deliver = lambda _frame: None

    def _attach(self, node, taken_s: float) -> None:
        self._node, self._id = node, node.GetID()
        events = [node.ImageDataModifiedEvent]
        if hasattr(node, "FrameModifiedEvent"):
            events.append(node.FrameModifiedEvent)
        self._tags = [node.AddObserver(event, self._on_image) for event in events]
        self._take(taken_s)

    def _detach(self) -> None:
        if self._node is not None:
            for tag in self._tags:
                self._node.RemoveObserver(tag)
        self._node = self._tags = self._stamp = None

    def _on_image(self, _caller, _event) -> None:
        self._take(self._clock())

    def _take(self, taken_s: float) -> None:
        compressed = hasattr(self._node, "GetFrame") and self._node.GetFrame() is not None
        if compressed and not self._node.DecodeFrame():
            # The node's image is the one before, or nothing, and yet it counts as changed.
            self._problem = f"The pictures of {self._name} cannot be decoded; check the codec, or send them raw."
            return
        data = self._node.GetImageData()
        if data is None:
            return
        # The object itself: VTK wraps it anew, with another id, each time that nobody holds it.
        stamp = (data, data.GetMTime())
        if stamp == self._stamp:  # one change may send more than one event
            return
        self._stamp = stamp
        image = pixels_of(data)
        self._problem = "" if image is not None else f"The volume {self._name} holds no picture of one slice."
        self._taken_s, self._again_s = taken_s, math.inf
        if image is not None:
            self._number += 1
            self._deliver(LiveFrame(image, taken_s, self._number - 1, f"{self._name} {self._number - 1}"))


def find_volume(scene, id_or_name: str):
    """The volume of that id, else the first of that name that is not the panel's own; None where there is none.

    Views and connectors may have the same name.
    """
    node = scene.GetNodeByID(id_or_name)
    if node is not None and node.IsA("vtkMRMLVolumeNode"):
        return node
    found = scene.GetNodesByClassByName("vtkMRMLVolumeNode", id_or_name)
    found.UnRegister(None)
    named = [found.GetItemAsObject(i) for i in range(found.GetNumberOfItems())]
    return next((node for node in named if not node.GetAttribute(ROLE_ATTRIBUTE)), None)


def pixels_of(image_data) -> np.ndarray | None:
    """Copy of a vtkImageData's pixels (H, W, C), row 0 first as stored; None where it holds no single slice."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    width, height, slices = image_data.GetDimensions()
    scalars = image_data.GetPointData().GetScalars()
    if slices != 1 or scalars is None or scalars.GetNumberOfTuples() != width * height or not width * height:
        return None
    # A copy: the node writes its next frame into the same memory.
    return vtk_to_numpy(scalars).reshape(height, width, -1).copy()
