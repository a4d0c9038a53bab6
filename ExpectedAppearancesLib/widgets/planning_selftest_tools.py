"""What the planning panel's tests in a running 3D Slicer share: a generated patient in the panel, and waiting."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np
import slicer

from .. import files
from ..case.case import Case
from ..case.meshes import Mesh, write_vtp
from ..geometry.camera import Camera, write_camera
from ..mrml import planning
from ..textures.library import LABELS_SUFFIX, read_library, shipped_textures_folder


class Folder(tempfile.TemporaryDirectory):
    """A folder whose name has a space and is not ASCII, gone at the end; the panel lets go of it before."""

    def __init__(self):
        super().__init__(prefix="Fälle Expected ")

    def __enter__(self) -> Path:
        return Path(super().__enter__())

    def __exit__(self, *error):
        slicer.mrmlScene.Clear()
        let_events_pass(0.1)
        return super().__exit__(*error)


def open_panel():
    """The module's panel, entered, with a fresh scene's parameters."""
    widget = slicer.util.getModuleWidget("ExpectedAppearances")
    if slicer.util.mainWindow():
        slicer.util.selectModule("ExpectedAppearances")
    if not widget.panel.entered:
        widget.enter()
    let_events_pass(0.2)
    widget.panel.refresh()
    return widget.panel


def buttons_of(panel) -> list:
    return [widget for name, widget in vars(panel.ui).items() if name.endswith("Button") or name.endswith("Start")]


def panel_with_models(folder: Path):
    """Panel with a generated patient chosen; the panel and the vessels' node."""
    panel = open_panel()
    vessels, cortex = generated_patient()
    nodes = []
    for name, mesh in (("Vessels", vessels), ("Cortex", cortex)):
        write_vtp(folder / f"{name}.vtp", mesh, "LPS")
        nodes.append(slicer.util.loadModel(str(folder / f"{name}.vtp")))
        nodes[-1].SetName(name)
    write_camera(folder / "camera.json", Camera(96, 80, 300.0, 300.0, 47.5, 39.5))
    panel.parameters.vesselsNode, panel.parameters.cortexModel = nodes
    panel.parameters.calibrationPath = str(folder / "camera.json")
    let_events_pass(0.2)
    return panel, nodes[0]


def saved_case(test, panel, folder: Path) -> Case:
    panel.open_folder(str(folder / "case"))
    test.assertTrue(panel.ui.saveCaseButton.enabled, panel.ui.saveCaseButton.toolTip)
    panel.ui.saveCaseButton.click()
    wait_until(test, lambda: not panel.sections["case"].saving)
    let_events_pass(0.2)
    return Case.open(folder / "case")


def open_case(test, panel, folder: Path) -> None:
    panel.open_folder(str(folder), take_over=True)
    wait_until(test, lambda: not panel.opening)


def generated_patient() -> tuple[Mesh, Mesh]:
    """Two crossing vessels on a dome, LPS mm: asymmetric, so that a view from elsewhere looks different."""
    import vtk

    append = vtk.vtkAppendPolyData()
    for ends in (((-15, -9), (14, 12)), ((-4, 2), (9, -14))):
        points = vtk.vtkPoints()
        for t in np.linspace(0, 1, 24):
            x, y = (1 - t) * np.array(ends[0], float) + t * np.array(ends[1], float) + 2 * np.sin(6 * t)
            points.InsertNextPoint(x, y, _dome(x, y) + 0.2)
        line = vtk.vtkPolyLineSource()
        line.SetPoints(points)
        tube = vtk.vtkTubeFilter()
        tube.SetInputConnection(line.GetOutputPort())
        tube.SetRadius(1.2)
        tube.SetNumberOfSides(10)
        tube.CappingOn()
        append.AddInputConnection(tube.GetOutputPort())
    append.Update()
    plane = vtk.vtkPlaneSource()
    plane.SetOrigin(-22, -22, 0)
    plane.SetPoint1(22, -22, 0)
    plane.SetPoint2(-22, 22, 0)
    plane.SetResolution(30, 30)
    plane.Update()
    cortex = Mesh.from_polydata(plane.GetOutput())
    cortex.vertices_mm[:, 2] = _dome(cortex.vertices_mm[:, 0], cortex.vertices_mm[:, 1])
    return Mesh.from_polydata(append.GetOutput()), cortex


def _dome(x, y):
    return -(x * x + y * y) / 120.0


def few_textures(folder: Path, count: int) -> Path:
    """Some of the shipped textures, a quarter as large."""
    folder.mkdir()
    for texture in read_library(shipped_textures_folder())[:count]:
        files.write_png(folder / f"{texture.name}.png", np.ascontiguousarray(texture.image[::4, ::4]))
        files.write_png(folder / f"{texture.name}{LABELS_SUFFIX}", np.ascontiguousarray(texture.labels[::4, ::4]))
    return folder


def shown_frustums():
    return slicer.mrmlScene.GetFirstNodeByName(planning.FRUSTUMS)


def shown_mask():
    return slicer.mrmlScene.GetFirstNodeByName(planning.MASK)


def lacks(test, module: str) -> bool:
    import importlib.util

    if importlib.util.find_spec(module) is None:
        test.delayDisplay(f"Skipped: {module} is not installed in this Slicer.")
        return True
    return False


def let_events_pass(seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        slicer.app.processEvents()
        time.sleep(0.005)


def wait_until(test, condition, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        test.assertLess(time.monotonic(), end, "waited too long")
        let_events_pass(0.02)
