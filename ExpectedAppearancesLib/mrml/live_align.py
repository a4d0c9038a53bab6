"""Manual alignment in the scene: handles that move the vessels over a frozen frame, and pairs of landmarks."""

from __future__ import annotations

import numpy as np

from ..case.case import Case
from ..geometry.pose import inverse, ras_from_world, transform
from ..live.alignment import LandmarkPose, pose_from_landmarks
from . import scene as scenes
from .live_nodes import ROLE_ATTRIBUTE
from .live_scene import LiveScene

HANDLES, FRAME_LANDMARKS, MESH_LANDMARKS = "handles", "landmarks in frame", "landmarks on mesh"


class Alignment:
    """The vessels hang under a transform with handles while the camera stands still; `finish` moves the camera.

    start: the camera_from_world to begin with.
    """

    def __init__(self, live_scene: LiveScene, case: Case, start: np.ndarray):
        self._live, self._case, self._scene = live_scene, case, live_scene._scene
        self._ras_from_world = ras_from_world(case.space)
        self._start = np.asarray(start, float)
        self._before = inverse(inverse(self._ras_from_world) @ live_scene.camera_to_ras)
        live_scene.set_pose(self._start)
        live_scene.is_aligned_by_hand = True
        pivot_ras = transform(self._ras_from_world, case.vessels.centroid_mm[None])[0]
        self.handles = self._scene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "Manual alignment")
        self.handles.SetAttribute(ROLE_ATTRIBUTE, HANDLES)
        self.handles.SetSaveWithScene(False)
        self.handles.CreateDefaultDisplayNodes()
        display = self.handles.GetDisplayNode()
        if display is not None:
            display.SetAttribute(ROLE_ATTRIBUTE, HANDLES)
            display.SetSaveWithScene(False)
            display.SetEditorVisibility(True)
            display.SetEditorSliceIntersectionVisibility(False)
            display.SetEditorScalingEnabled(False)
        if hasattr(self.handles, "SetCenterOfTransformation"):  # the handles then sit in the vessels, not at 0
            self.handles.SetCenterOfTransformation(*pivot_ras)
        self._parents = {name: node.GetTransformNodeID() for name, node in live_scene.models.items()}
        self.handles.SetAndObserveTransformNodeID(self._parents[scenes.VESSELS])  # where the user put them
        for node in live_scene.models.values():
            node.SetAndObserveTransformNodeID(self.handles.GetID())

    @property
    def camera_from_world(self) -> np.ndarray:
        """The pose at which the camera would see the vessels as they lie now."""
        moved_from_ras = scenes.matrix_of(self.handles)
        world_from_ras = inverse(self._ras_from_world)
        return self._start @ world_from_ras @ moved_from_ras @ self._ras_from_world

    def set_pose(self, camera_from_world: np.ndarray) -> None:
        """Move the vessels so that the camera, which stands still, sees them as from this pose."""
        moved = inverse(self._start) @ np.asarray(camera_from_world, float)
        scenes.set_pose(self.handles, self._ras_from_world @ moved @ inverse(self._ras_from_world))

    def finish(self, keep: bool = True) -> np.ndarray:
        """Put the vessels back to their place, and the camera to its, where it was unless that is kept; returns the
        pose. A guess to begin with must not stay in the transform that others listen to."""
        pose = self.camera_from_world if keep else self._before
        for name, node in self._live.models.items():
            if self._scene.IsNodePresent(node):
                node.SetAndObserveTransformNodeID(self._parents[name])
        scenes.remove_node(self._scene, self.handles)
        self._live.set_pose(pose)
        self._live.is_aligned_by_hand = False
        return pose


def add_landmark_lists(live_scene: LiveScene) -> tuple:
    """Two lists of points, (in the frame, on the mesh). Those of the frame lie in camera mm and move with it, those on
    the mesh move with the vessels."""
    nodes = []
    for role, name, rgb in (
        (FRAME_LANDMARKS, "F", (1.0, 0.82, 0.2)),
        (MESH_LANDMARKS, "M", (0.3, 0.9, 1.0)),
    ):
        node = live_scene._scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", name)
        node.SetAttribute(ROLE_ATTRIBUTE, role)
        node.CreateDefaultDisplayNodes()
        node.GetDisplayNode().SetSelectedColor(*rgb)
        nodes.append(node)
    nodes[0].SetAndObserveTransformNodeID(live_scene.transform.GetID())
    nodes[1].SetAndObserveTransformNodeID(live_scene.models[scenes.VESSELS].GetTransformNodeID())
    return tuple(nodes)


def pose_of_landmarks(live_scene: LiveScene, case: Case, in_frame, on_mesh) -> LandmarkPose:
    """The pose that the two lists give for the frame that is shown. Raises InputError as pose_from_landmarks does."""
    camera = live_scene.camera
    points_mm = _points(in_frame)
    points_px = points_mm[:, :2] / points_mm[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    world_from_ras = inverse(ras_from_world(case.space))
    return pose_from_landmarks(points_px, transform(world_from_ras, _points(on_mesh)), camera)


def _points(markups) -> np.ndarray:
    """Its defined points (N, 3), under its own transform: where they were picked, however far that moved since."""
    points = []
    for i in range(markups.GetNumberOfControlPoints()):
        if markups.GetNthControlPointPositionStatus(i) != markups.PositionDefined:
            continue
        position = [0.0, 0.0, 0.0]
        markups.GetNthControlPointPosition(i, position)
        points.append(position)
    return np.array(points, float).reshape(-1, 3)
