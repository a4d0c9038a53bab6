"""Tests of the planning panel in a running 3D Slicer, one per section and one from the models to a trained model.

Run by the module's test class. Each takes the unittest case that it asserts with.
"""

from __future__ import annotations

import sys
import time

import numpy as np
import slicer

from .. import files
from ..masks.labels import VESSELS
from ..mrml import charts, labelling, planning
from ..planning.steps import StepState
from ..runs import dependencies
from ..textures.library import LABELS_SUFFIX, read_library, shipped_textures_folder
from .planning_selftest_tools import (
    Folder,
    buttons_of,
    few_textures,
    lacks,
    let_events_pass,
    open_case,
    open_panel,
    panel_with_models,
    saved_case,
    shown_frustums,
    shown_mask,
    wait_until,
)

HEAVY = {"torch", "cv2", "onnxruntime", "skimage"}
LONGEST_WAIT_S = 1200.0  # on a busy computer; usually a minute or two


def test_opening_loads_nothing_heavy(test) -> None:
    before = set(sys.modules)
    panel = open_panel()
    test.assertEqual((set(sys.modules) - before) & HEAVY, set())
    test.assertFalse(panel.ui.saveCaseButton.enabled)
    for name, section in panel.sections.items():
        test.assertEqual(section.button.collapsed, name != "case")
        test.assertTrue(panel.steps[name].text)
    for button in buttons_of(panel):
        test.assertTrue(button.enabled or button.toolTip, f"{button.name} does not say why it is disabled")


def test_case_is_saved_in_world_coordinates(test) -> None:
    with Folder() as folder:
        panel, node = panel_with_models(folder)
        moved = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLLinearTransformNode", "moved")
        matrix = np.eye(4)
        matrix[:3, 3] = 5.0, -3.0, 2.0
        slicer.util.updateTransformMatrixFromArray(moved, matrix)
        for model in (node, panel.parameters.cortexModel):
            model.SetAndObserveTransformNodeID(moved.GetID())
        before_ras = np.array(node.GetPolyData().GetPoint(0))
        case = saved_case(test, panel, folder)
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


def test_a_model_that_is_deleted_is_not_replaced_by_another(test) -> None:
    with Folder() as folder:
        panel, node = panel_with_models(folder)
        p, scan = panel.parameters, slicer.util.addVolumeFromArray(np.zeros((2, 2, 2)))
        slicer.util.addVolumeFromArray(np.zeros((2, 2, 2)))
        panel.ui.mriSelector.setCurrentNode(scan)
        for name, chosen in (("vesselsNode", node), ("cortexModel", p.cortexModel), ("mriVolume", scan)):
            slicer.util.loadModel(str(folder / "Vessels.vtp"))
            slicer.mrmlScene.RemoveNode(chosen)
            let_events_pass(0.2)
            test.assertIsNone(getattr(p, name), name)


def test_scan_is_saved_with_the_case_and_found_again(test) -> None:
    with Folder() as folder:
        panel, _node = panel_with_models(folder)
        case = saved_case(test, panel, folder)
        scan = slicer.util.addVolumeFromArray(np.arange(24000, dtype=np.int16).reshape(20, 30, 40), name="T1")
        panel.ui.mriSelector.setCurrentNode(scan)
        wait_until(test, lambda: "without the MRI" in panel.steps["case"].text)
        test.assertTrue(panel.ui.saveCaseButton.enabled)
        panel.ui.saveCaseButton.click()
        wait_until(test, lambda: panel.steps["case"].text == "Saved.")
        test.assertTrue((case.folder / "mri.nrrd").is_file())
        slicer.mrmlScene.Clear()
        open_case(test, panel, folder / "case")
        shown = panel.parameters.mriVolume
        test.assertEqual(shown.GetName(), "T1")
        np.testing.assert_array_equal(slicer.util.arrayFromVolume(shown).shape, (20, 30, 40))
        test.assertEqual(panel.steps["case"].text, "Saved.")
        slicer.mrmlScene.Clear()
        test.assertIsNone(panel.parameters.mriVolume)


def test_a_case_is_opened_in_pieces_and_not_at_all_once_the_scene_is_closed(test) -> None:
    with Folder() as folder:
        panel, _node = panel_with_models(folder)
        saved_case(test, panel, folder)
        slicer.mrmlScene.Clear()
        let_events_pass(0.2)
        count = slicer.mrmlScene.GetNumberOfNodesByClass("vtkMRMLModelNode")
        panel.open_folder(str(folder / "case"), take_over=True)
        test.assertTrue(panel.opening)
        test.assertIn("being opened", panel.ui.nextLabel.text)
        test.assertFalse(panel.ui.openCaseButton.enabled)
        panel.open_folder(str(folder / "case"), take_over=True)  # a second time: it begins anew
        wait_until(test, lambda: slicer.mrmlScene.GetNumberOfNodesByClass("vtkMRMLModelNode") > count)
        slicer.mrmlScene.Clear()
        test.assertFalse(panel.opening)
        let_events_pass(0.5)
        test.assertEqual(slicer.mrmlScene.GetNumberOfNodesByClass("vtkMRMLModelNode"), count)
        test.assertEqual(panel.parameters.casePath, "")
        test.assertTrue(panel.ui.openCaseButton.enabled)
        open_case(test, panel, folder / "case")
        test.assertEqual(panel.parameters.vesselsNode.GetName(), "Vessels")
        test.assertEqual(slicer.mrmlScene.GetNumberOfNodesByClass("vtkMRMLModelNode"), count + 2)


def test_a_segment_becomes_vessels_in_a_process_of_its_own(test) -> None:
    with Folder() as folder:
        panel, _node = panel_with_models(folder)
        segmentation = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLSegmentationNode", "Drawn")
        voxels = np.zeros((20, 30, 40), np.int16)
        voxels[5:15, 10:20, 8:30] = 1
        labels = slicer.util.addVolumeFromArray(voxels, nodeClassName="vtkMRMLLabelMapVolumeNode")
        slicer.modules.segmentations.logic().ImportLabelmapToSegmentationNode(labels, segmentation)
        slicer.mrmlScene.RemoveNode(labels)
        panel.open_folder(str(folder / "case"))
        panel.ui.vesselsSelector.setCurrentNode(segmentation)
        panel.refresh()
        test.assertIn("is being made", panel.steps["case"].text)
        test.assertIn("is being made", panel.ui.saveCaseButton.toolTip)
        test.assertFalse(panel.ui.saveCaseButton.enabled)
        wait_until(test, lambda: panel.ui.saveCaseButton.enabled)
        extent = np.ptp(panel.session.mesh(panel.parameters, "vessels").vertices_mm, axis=0)
        np.testing.assert_allclose(extent, (22, 10, 10), atol=1.5)
        test.assertFalse(segmentation.GetSegmentation().ContainsRepresentation("Closed surface"))
        segment = segmentation.GetSegmentation().GetNthSegment(0)
        segment.GetRepresentation("Binary labelmap").Modified()
        panel.refresh()
        test.assertFalse(panel.ui.saveCaseButton.enabled)
        slicer.mrmlScene.Clear()  # while it is being made
        wait_until(test, lambda: panel.steps["case"].state is StepState.MISSING)
        test.assertEqual(panel.session.waiting(panel.parameters), "")


def test_microscope_from_file_or_view(test) -> None:
    panel = open_panel()
    p = panel.parameters
    test.assertEqual(panel.steps["microscope"].state, StepState.MISSING)
    p.cameraSource = type(p.cameraSource)("view")
    wait_until(test, lambda: panel.steps["microscope"].state is StepState.READY)
    test.assertIn("40", panel.ui.microscopeSummary.text)
    with Folder() as folder:
        (folder / "camera.json").write_text("{}", encoding="utf-8")
        p.cameraSource = type(p.cameraSource)("file")
        panel.ui.calibrationPathEdit.currentPath = str(folder / "camera.json")
        wait_until(test, lambda: panel.steps["microscope"].state is StepState.MISSING)
        test.assertIn("camera.json", panel.steps["microscope"].text)
        panel.ui.calibrationPathEdit.currentPath = ""
        test.assertEqual(p.calibrationPath, "")


def test_cameras_follow_the_sliders(test) -> None:
    if lacks(test, "cv2"):
        return
    with Folder() as folder:
        panel, _node = panel_with_models(folder)
        p = panel.parameters
        panel.unfold("poses")
        wait_until(test, lambda: shown_frustums() is not None)
        first = shown_frustums().GetPolyData().GetNumberOfPoints()
        highest = shown_frustums().GetPolyData().GetBounds()[5]
        p.distanceAuto = False
        p.farthestMm = p.nearestMm = 500.0
        wait_until(test, lambda: shown_frustums().GetPolyData().GetBounds()[5] > highest + 50)
        test.assertEqual(shown_frustums().GetPolyData().GetNumberOfPoints(), first)
        p.distanceAuto = p.lookThrough = True
        wait_until(test, lambda: shown_mask() is not None)
        sampler = panel.session.sampler(p)
        camera = sampler.camera
        from ..masks.renderer import MaskRenderer

        with MaskRenderer(panel.session.mesh(p, "vessels"), panel.session.mesh(p, "cortex"), camera) as renderer:
            expected = renderer.render(sampler.sample(0))
        np.testing.assert_array_equal(slicer.util.arrayFromVolume(shown_mask())[0], expected)
        test.assertTrue((expected == VESSELS).any())
        p.poseIndex = 2
        wait_until(test, lambda: "Camera 3" in panel.ui.lookCaption.text)
        p.lookThrough = p.showCameras = False
        wait_until(test, lambda: shown_mask() is None and shown_frustums() is None)
        p.lookThrough = True
        panel.refresh()
        slicer.mrmlScene.Clear()  # while the label map is being drawn
        let_events_pass(0.5)
        test.assertIsNone(shown_mask())
        test.assertEqual(panel.ui.lookCaption.text, "")


def test_textures_are_listed_and_labelled(test) -> None:
    if lacks(test, "cv2"):
        return
    with Folder() as folder:
        panel = open_panel()
        own = few_textures(folder / "textures", 2)
        panel.parameters.texturesPath = str(own)
        panel.unfold("textures")
        wait_until(test, lambda: panel.ui.texturesList.count == 2)
        test.assertIn("Only 2", panel.steps["textures"].text)
        image = files.read_image_rgb(own / "apricot.png")
        labels = files.read_label_map(own / f"apricot{LABELS_SUFFIX}")
        nodes = labelling.add_photograph(slicer.mrmlScene, "photograph", image, labels)
        np.testing.assert_array_equal(labelling.labels_of(nodes), labels)
        planning.remove_nodes(slicer.mrmlScene, nodes)
        (own / f"apricot{LABELS_SUFFIX}").unlink()
        panel.refresh()
        wait_until(test, lambda: panel.steps["textures"].state is StepState.MISSING)
        test.assertIn("apricot", panel.steps["textures"].text)


def test_photograph_becomes_a_texture(test) -> None:
    if lacks(test, "cv2") or lacks(test, "skimage"):
        return
    with Folder() as folder:
        panel = open_panel()
        panel.parameters.texturesPath = str(few_textures(folder / "textures", 1))
        photograph = read_library(shipped_textures_folder())[1].image[:256, :256]
        files.write_png(folder / "Foto 1.png", np.ascontiguousarray(photograph))
        panel.sections["textures"].on_add(str(folder / "Foto 1.png"))
        labelling_ = panel.sections["textures"].labelling
        wait_until(test, lambda: labelling_.nodes, 120)
        proposed = labelling.labels_of(labelling_.nodes)
        test.assertTrue((proposed == VESSELS).any())
        panel = open_panel()
        test.assertFalse(panel.ui.addPhotographButton.enabled)
        test.assertFalse(panel.ui.texturesSection.collapsed)  # where the photograph is saved
        scan = slicer.util.addVolumeFromArray(np.zeros((100, 100, 100)))
        panel.parameters.mriVolume = scan
        panel.ui.useLabelsButton.click()
        panel.refresh()
        test.assertFalse(panel.ui.useLabelsButton.enabled)  # while it is being saved
        wait_until(test, lambda: labelling_.nodes == {})
        red = slicer.app.layoutManager().sliceWidget("Red").mrmlSliceNode()
        wait_until(test, lambda: red.GetFieldOfView()[1] >= 100)  # the scan, not the place where the photograph was
        panel.unfold("textures")
        wait_until(test, lambda: panel.ui.texturesList.count == 2)
        np.testing.assert_array_equal(files.read_label_map(folder / "textures" / f"Foto_1{LABELS_SUFFIX}"), proposed)


def test_verdict_follows_the_limits(test) -> None:
    with Folder() as folder:
        panel, _node = panel_with_models(folder)
        p = panel.parameters
        case = saved_case(test, panel, folder)
        test.assertTrue(panel.ui.showFiguresButton.toolTip)
        figures = {"add_mm_mean": 2.4, "accepted_of_true": 0.7, "accepted_add_mm_mean": 0.8}
        figures |= {"accepted_add_below_3mm": 0.99}
        files.write_json(case.model_folder / "model.json", {"validation": figures})
        panel.refresh()
        test.assertIn(">Ready<", panel.ui.verdictLabel.text)
        p.acceptedAddLimitMm = 0.7
        wait_until(test, lambda: "Not ready" in panel.ui.verdictLabel.text)
        test.assertIn("0.80 mm", panel.ui.verdictLabel.text)
        panel.ui.showFiguresButton.click()
        table = charts.table_of(slicer.mrmlScene)
        test.assertEqual(table.GetCellText(0, table.GetColumnIndex("ADD mean (mm)")), "2.40")


def test_run_is_found_again_and_cancelled(test) -> None:
    """Left going on with its scene, found in the next one, and ended with it."""
    missing = dependencies.missing("planning")
    if missing:
        test.delayDisplay(f"Skipped: {', '.join(missing)} not installed in this Slicer.")
        return
    with Folder() as folder:
        panel, _node = panel_with_models(folder)
        saved_case(test, panel, folder)
        p = panel.parameters
        p.poseCount, p.whenClosing = 1000, type(p.whenClosing)("detach")
        panel.refresh()
        panel.ui.renderButton.click()
        wait_until(test, lambda: panel.runs["render"].active, 60)
        slicer.mrmlScene.Clear()
        test.assertEqual(panel.running(), frozenset())

        open_case(test, panel, folder / "case")
        test.assertTrue(panel.ui.renderCancelButton.enabled)
        wait_until(test, lambda: panel.runs["render"].status.fraction > 0, 60)
        run = panel.runs["render"].run
        panel.parameters.whenClosing = type(p.whenClosing)("end")
        slicer.mrmlScene.Clear()
        wait_until(test, lambda: not run.poll().state.active, 60)

        open_case(test, panel, folder / "case")
        test.assertEqual(panel.steps["poses"].state, StepState.READY, panel.steps["poses"].text)
        test.assertIn("goes on where it was", panel.steps["poses"].text)
        test.assertEqual(panel.ui.renderButton.text, "Continue")


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
    let_events_pass(0.2)


def test_same_panel_after_the_scene_is_saved_and_opened(test) -> None:
    with Folder() as folder:
        panel, _node = panel_with_models(folder)
        p = panel.parameters
        p.tiltMaxDeg, p.poseCount, p.method, p.minutes = 33.0, 17, type(p.method)("image"), 3.0
        path = folder / "scene.mrb"
        test.assertTrue(slicer.util.saveScene(str(path)))
        slicer.mrmlScene.Clear()
        let_events_pass(0.2)
        test.assertEqual(open_panel().parameters.poseCount, 100)
        slicer.util.loadScene(str(path))
        p = open_panel().parameters
        test.assertEqual((p.tiltMaxDeg, p.poseCount, p.method.value, p.minutes), (33.0, 17, "image", 3.0))
        test.assertEqual(p.vesselsNode.GetName(), "Vessels")
        test.assertEqual(panel.ui.poseCountSpin.value, 17)


def test_another_preset_or_method_brings_its_time_or_size(test) -> None:
    panel = open_panel()
    p, ui = panel.parameters, panel.ui
    for index, chosen in ((1, ("best", 90.0)), (2, ("paper", 720.0)), (0, ("quick", 26.0))):
        ui.presetCombo.currentIndex = index
        test.assertEqual((p.preset.value, p.minutes, ui.presetCombo.currentIndex), (*chosen, index))
    for index, chosen in ((1, ("image", 256)), (0, ("surface", 384))):
        ui.methodCombo.currentIndex = index
        test.assertEqual((p.method.value, p.sizePx, ui.sizeSpin.value), (*chosen, chosen[1]))


def test_from_models_to_a_trained_model(test) -> None:
    """The whole quick workflow at its smallest, by clicks."""
    missing = dependencies.missing("training")
    if missing:
        test.delayDisplay(f"Skipped: {', '.join(missing)} not installed in this Slicer.")
        return
    with Folder() as folder:
        panel, _node = panel_with_models(folder)
        p = panel.parameters
        p.poseCount, p.sizePx, p.iterations, p.minutes, p.device = 4, 64, 2, 0.1, "cpu"
        p.texturesPath = str(few_textures(folder / "textures", 2))
        p.whenClosing = type(p.whenClosing)("end")  # a test that fails leaves nothing going on
        case = saved_case(test, panel, folder)
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
                begin = time.thread_time()  # what other processes take is not the panel's
                slicer.app.processEvents()
                longest_s = max(longest_s, time.thread_time() - begin)
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
        _start_and_cancel_a_study(test, panel)
        slicer.mrmlScene.Clear()
        open_case(test, panel, case.folder)
        p = panel.parameters
        test.assertEqual(panel.ui.renderButton.text, "Make again")
        test.assertEqual(panel.ui.trainingStart.text, "Make again")
        test.assertEqual(panel.ui.studyStart.text, "Continue the study")
        p.poseCount = 5
        panel.refresh()
        test.assertEqual(panel.steps["poses"].state, StepState.STALE)
        test.assertEqual(panel.steps["training"].state, StepState.STALE)


def _start_and_cancel_a_study(test, panel) -> None:
    """It trains a model for each texture, which is too long for a test; what it says of itself is looked at."""
    ui = panel.ui
    test.assertEqual(ui.studyStart.text, "Start the study")
    test.assertIn("4 models", ui.studyHint.text)
    test.assertTrue(ui.studyStart.enabled, ui.studyStart.toolTip)
    ui.studyStart.click()
    wait_until(
        test, lambda: "models are to be trained" in ui.studyLine.text or "quick model without" in ui.studyLine.text, 300
    )
    test.assertEqual(panel.steps["validation"].state, StepState.RUNNING)
    for button in (ui.renderButton, ui.appearancesStart, ui.trainingStart):
        test.assertIn("A study is going on", button.toolTip)
        test.assertFalse(button.enabled)
    ui.studyCancel.click()
    wait_until(test, lambda: not panel.runs["study"].active, 120)
    wait_until(test, lambda: ui.studyStart.text == "Continue the study")


TESTS = [value for name, value in list(globals().items()) if name.startswith("test_")]
