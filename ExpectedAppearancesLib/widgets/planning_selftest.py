"""Tests of the planning panel in a running 3D Slicer, one per section and one from the models to a trained model.

Run by the module's test class. Each takes the unittest case that it asserts with.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import slicer

from .. import files
from ..case.case import Case
from ..case.meshes import Mesh, write_vtp
from ..case.steps import StepState
from ..geometry.camera import Camera, write_camera
from ..masks.labels import VESSELS
from ..mrml import charts, labelling, planning
from ..runs import dependencies
from ..textures.library import LABELS_SUFFIX, read_library, shipped_textures_folder

HEAVY = {"torch", "cv2", "onnxruntime", "skimage"}
LONGEST_WAIT_S = 1200.0  # on a busy computer; usually a minute or two


def test_opening_loads_nothing_heavy(test) -> None:
    before = set(sys.modules)
    panel = _panel()
    test.assertEqual((set(sys.modules) - before) & HEAVY, set())
    test.assertFalse(panel.ui.saveCaseButton.enabled)
    for name, section in panel.sections.items():
        test.assertEqual(section.button.collapsed, name != "case")
        test.assertTrue(panel.steps[name].text)
    for button in _buttons(panel):
        test.assertTrue(button.enabled or button.toolTip, f"{button.name} does not say why it is disabled")


def test_case_is_saved_in_world_coordinates(test) -> None:
    with _Folder() as folder:
        panel, node = _with_models(folder)
        moved = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "moved")
        matrix = np.eye(4)
        matrix[:3, 3] = 5.0, -3.0, 2.0
        slicer.util.updateTransformMatrixFromArray(moved, matrix)
        for model in (node, panel.parameters.cortexModel):
            model.SetAndObserveTransformNodeID(moved.GetID())
        before_ras = np.array(node.GetPolyData().GetPoint(0))
        case = _saved(test, panel, folder)
        test.assertEqual(panel.steps["case"].state, StepState.DONE, panel.steps["case"].text)
        expected_lps = (before_ras + matrix[:3, 3]) * (-1, -1, 1)
        np.testing.assert_allclose(case.vessels.vertices_mm[0], expected_lps, atol=1e-3)
        np.testing.assert_allclose(node.GetPolyData().GetPoint(0), before_ras)
        test.assertIs(node.GetParentTransformNode(), moved)
        matrix[0, 3] = 9.0
        slicer.util.updateTransformMatrixFromArray(moved, matrix)
        panel.refresh()
        test.assertEqual(panel.steps["case"].state, StepState.STALE)
        test.assertIn("vessel model", panel.steps["case"].text)


def test_microscope_from_file_or_view(test) -> None:
    panel = _panel()
    p = panel.parameters
    test.assertEqual(panel.steps["microscope"].state, StepState.MISSING)
    p.cameraSource = type(p.cameraSource)("view")
    _events(0.2)
    test.assertEqual(panel.steps["microscope"].state, StepState.READY)
    test.assertIn("40", panel.ui.microscopeSummary.text)
    with _Folder() as folder:
        (folder / "camera.json").write_text("{}", encoding="utf-8")
        p.cameraSource = type(p.cameraSource)("file")
        panel.ui.calibrationPathEdit.currentPath = str(folder / "camera.json")
        _events(0.2)
        test.assertEqual(panel.steps["microscope"].state, StepState.MISSING)
        test.assertIn("camera.json", panel.steps["microscope"].text)


def test_cameras_follow_the_sliders(test) -> None:
    if _lacks(test, "cv2"):
        return
    with _Folder() as folder:
        panel, _node = _with_models(folder)
        p = panel.parameters
        panel.unfold("poses")
        _wait(test, lambda: _frustums() is not None)
        first = _frustums().GetPolyData().GetNumberOfPoints()
        highest = _frustums().GetPolyData().GetBounds()[5]
        p.distanceAuto = False
        p.farthestMm = p.nearestMm = 500.0
        _wait(test, lambda: _frustums().GetPolyData().GetBounds()[5] > highest + 50)
        test.assertEqual(_frustums().GetPolyData().GetNumberOfPoints(), first)
        p.distanceAuto = p.lookThrough = True
        _wait(test, lambda: _mask() is not None)
        sampler = panel.session.sampler(p)
        camera = sampler.camera
        from ..masks.renderer import MaskRenderer

        with MaskRenderer(panel.session.mesh(p, "vessels"), panel.session.mesh(p, "cortex"), camera) as renderer:
            expected = renderer.render(sampler.sample(0))
        np.testing.assert_array_equal(slicer.util.arrayFromVolume(_mask())[0], expected)
        test.assertTrue((expected == VESSELS).any())
        p.lookThrough = p.showCameras = False
        _wait(test, lambda: _mask() is None and _frustums() is None)


def test_textures_are_listed_and_labelled(test) -> None:
    if _lacks(test, "cv2"):
        return
    with _Folder() as folder:
        panel = _panel()
        own = _few_textures(folder / "textures", 2)
        panel.parameters.texturesPath = str(own)
        panel.unfold("textures")
        _wait(test, lambda: panel.ui.texturesList.count == 2)
        test.assertIn("Only 2", panel.steps["textures"].text)
        image = files.read_image_rgb(own / "apricot.png")
        labels = files.read_label_map(own / f"apricot{LABELS_SUFFIX}")
        nodes = labelling.add_photograph(slicer.mrmlScene, "photograph", image, labels)
        np.testing.assert_array_equal(labelling.labels_of(nodes), labels)
        planning.remove_nodes(slicer.mrmlScene, nodes)
        (own / f"apricot{LABELS_SUFFIX}").unlink()
        panel.refresh()
        _wait(test, lambda: panel.steps["textures"].state is StepState.MISSING)
        test.assertIn("apricot", panel.steps["textures"].text)


def test_photograph_becomes_a_texture(test) -> None:
    if _lacks(test, "cv2") or _lacks(test, "skimage"):
        return
    with _Folder() as folder:
        panel = _panel()
        panel.parameters.texturesPath = str(_few_textures(folder / "textures", 1))
        photograph = read_library(shipped_textures_folder())[1].image[:256, :256]
        files.write_png(folder / "Foto 1.png", np.ascontiguousarray(photograph))
        panel.sections["textures"].on_add(str(folder / "Foto 1.png"))
        labelling_ = panel.sections["textures"].labelling
        _wait(test, lambda: labelling_.nodes, 120)
        proposed = labelling.labels_of(labelling_.nodes)
        test.assertTrue((proposed == VESSELS).any())
        panel = _panel()
        test.assertFalse(panel.ui.addPhotographButton.enabled)
        test.assertFalse(panel.ui.texturesSection.collapsed)  # where the photograph is saved
        panel.ui.useLabelsButton.click()
        test.assertEqual(labelling_.nodes, {})
        panel.unfold("textures")
        _wait(test, lambda: panel.ui.texturesList.count == 2)
        np.testing.assert_array_equal(files.read_label_map(folder / "textures" / f"Foto_1{LABELS_SUFFIX}"), proposed)


def test_verdict_follows_the_limits(test) -> None:
    with _Folder() as folder:
        panel, _node = _with_models(folder)
        p = panel.parameters
        case = _saved(test, panel, folder)
        test.assertTrue(panel.ui.showFiguresButton.toolTip)
        figures = {"add_mm_mean": 2.4, "add_mm_median": 2.0, "add_below_3mm": 0.9, "accepted_of_true": 0.7}
        files.write_json(case.model_folder / "model.json", {"validation": figures})
        panel.refresh()
        test.assertIn(">Ready<", panel.ui.verdictLabel.text)
        p.addLimitMm = 2.0
        _wait(test, lambda: "Not ready" in panel.ui.verdictLabel.text)
        test.assertIn("2.40 mm", panel.ui.verdictLabel.text)
        panel.ui.showFiguresButton.click()
        table = charts.table_of(slicer.mrmlScene)
        test.assertEqual(table.GetCellText(0, table.GetColumnIndex("ADD mean (mm)")), "2.40")


def test_run_is_found_again_and_cancelled(test) -> None:
    """Left going on with its scene, found in the next one, and ended with it."""
    missing = dependencies.missing("planning")
    if missing:
        test.delayDisplay(f"Skipped: {', '.join(missing)} not installed in this Slicer.")
        return
    with _Folder() as folder:
        panel, _node = _with_models(folder)
        _saved(test, panel, folder)
        p = panel.parameters
        p.poseCount, p.whenClosing = 1000, type(p.whenClosing)("detach")
        panel.refresh()
        panel.ui.renderButton.click()
        _wait(test, lambda: panel.runs["render"].active, 60)
        slicer.mrmlScene.Clear()
        test.assertEqual(panel.running(), frozenset())

        panel.open_folder(str(folder / "case"), take_over=True)
        test.assertTrue(panel.ui.renderCancelButton.enabled)
        _wait(test, lambda: panel.runs["render"].status.fraction > 0, 60)
        run = panel.runs["render"].run
        panel.parameters.whenClosing = type(p.whenClosing)("end")
        slicer.mrmlScene.Clear()
        _wait(test, lambda: not run.poll().state.active, 60)

        panel.open_folder(str(folder / "case"), take_over=True)
        test.assertEqual(panel.steps["poses"].state, StepState.READY, panel.steps["poses"].text)
        test.assertIn("goes on where it was", panel.steps["poses"].text)


def test_plots_leave_no_nodes_behind(test) -> None:
    scene = slicer.mrmlScene
    for steps in (3, 60):
        curve = [{"step": i, "loss": -float(i), "validation_add_mm": 9.0 / (i + 1)} for i in range(steps)]
        chart = charts.show_training(scene, curve)
        count = scene.GetNumberOfNodes()
        charts.show_training(scene, curve)
        test.assertEqual(scene.GetNumberOfNodes(), count)
    test.assertEqual(chart.GetNumberOfPlotSeriesNodes(), 2)
    slicer.modules.plots.logic().ShowChartInLayout(chart)
    _events(0.2)


def test_same_panel_after_the_scene_is_saved_and_opened(test) -> None:
    with _Folder() as folder:
        panel, _node = _with_models(folder)
        p = panel.parameters
        p.tiltMaxDeg, p.poseCount, p.method, p.minutes = 33.0, 17, type(p.method)("image"), 3.0
        path = folder / "scene.mrb"
        test.assertTrue(slicer.util.saveScene(str(path)))
        slicer.mrmlScene.Clear()
        _events(0.2)
        test.assertEqual(_panel().parameters.poseCount, 100)
        slicer.util.loadScene(str(path))
        p = _panel().parameters
        test.assertEqual((p.tiltMaxDeg, p.poseCount, p.method.value, p.minutes), (33.0, 17, "image", 3.0))
        test.assertEqual(p.vesselsNode.GetName(), "Vessels")
        test.assertEqual(panel.ui.poseCountSpin.value, 17)


def test_from_models_to_a_trained_model(test) -> None:
    """The whole quick workflow at its smallest, by clicks."""
    missing = dependencies.missing("training")
    if missing:
        test.delayDisplay(f"Skipped: {', '.join(missing)} not installed in this Slicer.")
        return
    with _Folder() as folder:
        panel, _node = _with_models(folder)
        p = panel.parameters
        p.poseCount, p.sizePx, p.iterations, p.minutes, p.device = 4, 64, 2, 0.1, "cpu"
        p.texturesPath = str(_few_textures(folder / "textures", 2))
        p.whenClosing = type(p.whenClosing)("end")  # a test that fails leaves nothing going on
        case = _saved(test, panel, folder)
        for name, button, kind in (
            ("poses", panel.ui.renderButton, "render"),
            ("appearances", panel.ui.appearancesStart, "synthesize"),
            ("training", panel.ui.trainingStart, "train"),
        ):
            panel.refresh()
            test.assertTrue(button.enabled, f"{name}: {button.toolTip}")
            longest_s = 0.0
            button.click()
            end = time.monotonic() + LONGEST_WAIT_S
            while panel.runs[kind].active or kind in panel.running():
                begin = time.monotonic()
                slicer.app.processEvents()
                longest_s = max(longest_s, time.monotonic() - begin)
                time.sleep(0.01)
                test.assertLess(time.monotonic(), end, f"{name} takes too long")
            panel.refresh()
            status = panel.runs[kind].status
            test.assertEqual(panel.steps[name].state, StepState.DONE, f"{panel.steps[name].text} {status.problem}")
            print(f"{name}: longest call on the GUI thread {1000 * longest_s:.0f} ms")
        test.assertTrue((case.model_folder / "model.onnx").is_file())
        test.assertTrue(panel.ui.showFiguresButton.enabled)
        test.assertTrue(panel.ui.verdictLabel.text)
        test.assertIsNotNone(charts.chart_of(slicer.mrmlScene, "training.chart"))
        p.poseCount = 5
        panel.refresh()
        test.assertEqual(panel.steps["poses"].state, StepState.STALE)
        test.assertEqual(panel.steps["training"].state, StepState.STALE)


TESTS = [value for name, value in list(globals().items()) if name.startswith("test_")]


class _Folder(tempfile.TemporaryDirectory):
    """A folder whose name has a space and is not ASCII, gone at the end; the panel lets go of it before."""

    def __init__(self):
        super().__init__(prefix="Fälle Expected ")

    def __enter__(self) -> Path:
        return Path(super().__enter__())

    def __exit__(self, *error):
        slicer.mrmlScene.Clear()
        _events(0.1)
        return super().__exit__(*error)


def _panel():
    """The module's panel, entered, with a fresh scene's parameters."""
    widget = slicer.util.getModuleWidget("ExpectedAppearances")
    if slicer.util.mainWindow():
        slicer.util.selectModule("ExpectedAppearances")
    if not widget.panel.entered:
        widget.enter()
    _events(0.2)
    widget.panel.refresh()
    return widget.panel


def _buttons(panel) -> list:
    return [widget for name, widget in vars(panel.ui).items() if name.endswith("Button") or name.endswith("Start")]


def _with_models(folder: Path):
    """Panel with a generated patient chosen; the panel and the vessels' node."""
    panel = _panel()
    vessels, cortex = generated_patient()
    nodes = []
    for name, mesh in (("Vessels", vessels), ("Cortex", cortex)):
        write_vtp(folder / f"{name}.vtp", mesh, "LPS")
        nodes.append(slicer.util.loadModel(str(folder / f"{name}.vtp")))
        nodes[-1].SetName(name)
    write_camera(folder / "camera.json", Camera(96, 80, 300.0, 300.0, 47.5, 39.5))
    panel.parameters.vesselsNode, panel.parameters.cortexModel = nodes
    panel.parameters.calibrationPath = str(folder / "camera.json")
    _events(0.2)
    return panel, nodes[0]


def _saved(test, panel, folder: Path) -> Case:
    panel.open_folder(str(folder / "case"))
    test.assertTrue(panel.ui.saveCaseButton.enabled, panel.ui.saveCaseButton.toolTip)
    panel.ui.saveCaseButton.click()
    _wait(test, lambda: not panel.sections["case"].saving)
    _events(0.2)
    return Case.open(folder / "case")


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


def _few_textures(folder: Path, count: int) -> Path:
    """Some of the shipped textures, a quarter as large."""
    folder.mkdir()
    for texture in read_library(shipped_textures_folder())[:count]:
        files.write_png(folder / f"{texture.name}.png", np.ascontiguousarray(texture.image[::4, ::4]))
        files.write_png(folder / f"{texture.name}{LABELS_SUFFIX}", np.ascontiguousarray(texture.labels[::4, ::4]))
    return folder


def _frustums():
    return slicer.mrmlScene.GetFirstNodeByName(planning.FRUSTUMS)


def _mask():
    return slicer.mrmlScene.GetFirstNodeByName(planning.MASK)


def _lacks(test, module: str) -> bool:
    import importlib.util

    if importlib.util.find_spec(module) is None:
        test.delayDisplay(f"Skipped: {module} is not installed in this Slicer.")
        return True
    return False


def _events(seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        slicer.app.processEvents()
        time.sleep(0.005)


def _wait(test, condition, seconds: float = 120.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        test.assertLess(time.monotonic(), end, "waited too long")
        _events(0.02)
