"""A scene of slicer-core, and what is chosen in the planning panel, for tests; conftest.py makes fixtures of them."""

from __future__ import annotations

from enum import Enum
from types import SimpleNamespace

import cv2
import numpy as np
import slicer
import vtk

from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.case.meshes import Mesh
from ExpectedAppearancesLib.mrml import mri
from ExpectedAppearancesLib.mrml.planning_adopt import adopting

LPS = np.array([-1.0, -1.0, 1.0])


def new_scene():
    scene = slicer.vtkMRMLScene()
    logic = slicer.vtkSlicerApplicationLogic()
    logic.SetMRMLScene(scene)
    logic.GetColorLogic().SetMRMLScene(scene)
    logic.GetColorLogic().AddDefaultColorNodes()
    logic.SetSliceLogics(vtk.vtkCollection())
    segmentations = slicer.vtkSlicerSegmentationsModuleLogic()  # registers what makes surfaces of segments
    segmentations.SetMRMLScene(scene)
    scene.keep_alive = (logic, segmentations)
    return scene


def add_model(scene, mesh: Mesh, name="Vessels"):
    """Model node with the mesh's vertices as RAS."""
    node = scene.AddNewNodeByClass("vtkMRMLModelNode", name)
    node.SetAndObservePolyData(mesh.to_polydata())
    return node


def add_transform(scene, matrix: np.ndarray, parent=None):
    node = scene.AddNewNodeByClass("vtkMRMLLinearTransformNode")
    result = vtk.vtkMatrix4x4()
    result.DeepCopy(matrix.ravel().tolist())
    node.SetMatrixTransformToParent(result)
    if parent:
        node.SetAndObserveTransformNodeID(parent.GetID())
    return node


def turned() -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = cv2.Rodrigues(np.array([0.3, -0.2, 0.5]))[0]
    matrix[:3, 3] = 12.0, -7.0, 30.0
    return matrix


class Source(Enum):
    FILE, VIEW = "file", "view"


class Where(Enum):
    FITTED, MARKED, RECORDED = "fitted", "marked", "recorded"


class How(Enum):
    SURFACE, IMAGE = "surface", "image"


class Preset(Enum):
    QUICK, BEST, PAPER = "quick", "best", "paper"


def parameters(**values) -> SimpleNamespace:
    usual = dict(vesselsNode=None, vesselsSegmentId="", cortexModel=None, casePath="", cameraSource=Source.FILE)
    usual |= dict(calibrationPath="", fieldOfViewMm=40.0, viewedAtMm=300.0, imageWidthPx=192, imageHeightPx=108)
    usual |= dict(craniotomySource=Where.FITTED, craniotomyNode=None, tiltMaxDeg=50.0, rollMaxDeg=45.0)
    usual |= dict(distanceAuto=True, nearestMm=80.0, farthestMm=140.0, lateralAuto=True, lateralMm=3.0)
    usual |= dict(inViewPercent=60.0, poseCount=4, seed=0, texturesPath="", method=How.SURFACE, sizePx=384)
    usual |= dict(
        iterations=50,
        preset=Preset.QUICK,
        minutes=26.0,
        mriVolume=None,
        savedCasePath="",
        acceptedAddLimitMm=1.5,
        acceptedLimitPercent=30.0,
    )
    return SimpleNamespace(**(usual | dict(acceptedRightLimitPercent=97.0) | values))


def save(session, p, folder) -> Case:
    """What the command `new` does with the exported inputs."""
    options = session.export_inputs(p, folder / "exported")
    values = dict(zip(options[::2], options[1::2]))
    return Case.create(folder / "case", values["--vessels"], values["--cortex"], values["--camera"], values["--space"])


def adopt(session, p, scene, warn=print) -> Case | None:
    """Open the case at p.casePath, at once."""
    pieces = adopting(session, p, p.casePath, scene, warn)
    while True:
        try:
            next(pieces)
        except StopIteration as stop:
            return stop.value


def keep_scan(case: Case, node, identity: dict | None = None):
    """Save the MRI with the case, at once; returns its path."""
    for _piece in mri.keeping_scan(case, node, identity or mri.scan_identity(node)):
        pass
    return case.folder / mri.FILE_NAME
