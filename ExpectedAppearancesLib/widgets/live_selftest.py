"""Self test of the live panel inside Slicer, by clicking its real widgets on the generated phantom."""

from __future__ import annotations

import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import slicer

from ..geometry.displacement import add_mm
from ..live.alignment import nudged
from ..live.trust import Sight
from ..mrml import live_views
from ..mrml.live_record import frame_at
from ..runs import dependencies
from . import live_texts

MODULE = "ExpectedAppearancesLive"
LONGEST_TICK_MS = 50.0


def says_what_is_missing(test) -> None:
    widget = opened()
    p = widget.panel.parameters()
    p.casePath = p.sourcePath = ""
    test.assertFalse(widget.ui.startButton.enabled)
    test.assertTrue(widget.ui.problemLabel.text)
    p.casePath = slicer.app.temporaryPath
    if not dependencies.missing("registration"):
        test.assertIn("case.json", widget.ui.problemLabel.text)
    for path in ("/another/camera.json", "/another/camera.txt", ""):  # what the field holds is what is taken
        widget.ui.cameraPathLineEdit.currentPath = path
        test.assertEqual(p.cameraPath, path)


def follows_frames_and_gives_the_layout_back(test) -> None:
    if not registration_is_installed(test):
        return
    if slicer.app.layoutManager():
        slicer.util.selectModule("Data")
        before = slicer.app.layoutManager().layout
    with tempfile.TemporaryDirectory() as folder:
        phantom, widget = started(Path(folder))
        nodes, wrong, ticks_ms = [], [], []
        distrusted = watch_drawing(widget.panel)
        for _ in range(40):
            status = next_result(test, widget, ticks_ms)
            truth = truth_of(phantom, status.result)
            if truth is not None and status.verdict.sight is Sight.FOLLOWING:
                predicted = status.result.prediction.camera_from_world
                wrong.append(add_mm(phantom.case.vessels.vertices_mm, truth[None], predicted[None])[0])
            nodes.append(slicer.mrmlScene.GetNumberOfNodes())
        manager = slicer.app.layoutManager()
        if manager:
            test.assertFalse(manager.sliceWidget(live_views.MICROSCOPE).sliceController().sliceOffsetSlider().visible)
        test.assertGreater(len(wrong), 15)
        test.assertLess(max(wrong), 0.5)
        test.assertEqual(nodes[5], nodes[-1])
        test.assertLess(float(np.median(ticks_ms)), LONGEST_TICK_MS)
        print(f"tick: median {np.median(ticks_ms):.1f} ms, longest {max(ticks_ms):.1f} ms")
        widget.ui.freezeButton.click()
        pump(0.3)
        test.assertIs(widget.panel.controller.tick().verdict.sight, Sight.FROZEN)
        widget.ui.freezeButton.click()
        widget.ui.startButton.click()
        test.assertFalse(widget.panel.controller.running)
        test.assertFalse(threads())
        test.assertEqual(distrusted, [])
        if slicer.app.layoutManager():
            slicer.util.selectModule("Data")
            test.assertEqual(slicer.app.layoutManager().layout, before)


def may_be_stopped_while_it_loads(test) -> None:
    if not registration_is_installed(test):
        return
    with tempfile.TemporaryDirectory() as folder:
        phantom, widget = started(Path(folder))
        controller = widget.panel.controller
        test.assertTrue(controller.loading)  # Start has returned before the model is read
        test.assertIs(controller.status.verdict.sight, Sight.LOADING)
        widget.ui.startButton.click()
        test.assertFalse(controller.running)
        until(test, lambda: not threads())
        pump(0.1)
        test.assertFalse(controller.running)
        (phantom.case.model_folder / "model.onnx").write_bytes(b"damaged")
        widget.ui.startButton.click()
        until(test, lambda: not controller.running)
        pump(0.1)
        test.assertIn("model", widget.ui.problemLabel.text)


def scene_close_and_reload_in_mid_stream_leave_nothing(test) -> None:
    if not registration_is_installed(test):
        return
    manager = slicer.app.layoutManager()
    if manager:
        slicer.util.selectModule("Data")
        before = manager.layout
    with tempfile.TemporaryDirectory() as folder:
        _phantom, widget = started(Path(folder))
        next_result(test, widget)
        slicer.mrmlScene.Clear()
        test.assertFalse(widget.panel.controller.running)
        test.assertFalse(threads())
        if manager:
            slicer.util.selectModule("Data")
            test.assertEqual(manager.layout, before)
        clean = slicer.mrmlScene.GetNumberOfNodes()
        _phantom, widget = started(Path(folder))
        next_result(test, widget)
        test.assertTrue(widget.panel.parameters().cameraJson)  # of this scene too, to show its frame when it is loaded
        if slicer.app.layoutManager():
            slicer.util.reloadScriptedModule(MODULE)
            test.assertTrue(slicer.util.getModuleWidget(MODULE).panel.layout.active)
        else:
            widget.cleanup()
        test.assertFalse(threads())
        live = [n for n in slicer.util.getNodesByClass("vtkMRMLNode") if n.GetAttribute("ExpectedAppearances.Live")]
        test.assertEqual([n.GetName() for n in live], [])
        test.assertLessEqual(slicer.mrmlScene.GetNumberOfNodes(), clean + 2)  # the parameter node, and Slicer's own


def records_and_replays(test) -> None:
    if not registration_is_installed(test):
        return
    with tempfile.TemporaryDirectory() as folder:
        _phantom, widget = started(Path(folder))
        next_result(test, widget)
        first, browser = (make_recording(test, widget, count) for count in (2, 6))
        test.assertGreaterEqual(browser.GetNumberOfItems(), 6)
        controller = widget.panel.controller
        for item, wait_s in ((0, 0.0), (3, 0.0), (3, 0.3), (1, 0.0)):  # at once, and when Slicer has done the rest
            widget.ui.replaySlider.value = item
            pump(wait_s)
            recorded = frame_at(browser)[0]
            until(test, lambda at_s=recorded.time_s: controller.result.frame.taken_s == at_s)
            pose = controller.result.prediction.camera_from_world
            test.assertEqual(controller.live.overlay_visible, controller.result.prediction.accepted)
            if not controller.result.prediction.accepted:
                continue  # a refused pose moves nothing
            matrix = slicer.util.arrayFromTransformMatrix(controller.live.transform)
            np.testing.assert_allclose(matrix, np.diag([-1, -1, 1, 1.0]) @ np.linalg.inv(pose), atol=1e-6)
        first.SetSelectedItemNumber(0)  # as Slicer's own toolbar does, with another one than is chosen here
        test.assertIs(widget.panel.parameters().browser, first)
        test.assertEqual(controller.result.frame.name, frame_at(first)[0].name)


def make_recording(test, widget, count: int):
    """A recording of so many frames or more; the session is over then."""
    if not widget.panel.controller.running:
        widget.ui.startButton.click()
        next_result(test, widget)
    widget.ui.recordButton.checked = True
    for _ in range(count):
        next_result(test, widget)
    widget.ui.recordButton.checked = False
    widget.ui.startButton.click()
    return widget.panel.parameters().browser


def aligns_by_hand(test) -> None:
    if not registration_is_installed(test):
        return
    with tempfile.TemporaryDirectory() as folder:
        phantom, widget = started(Path(folder))
        next_result(test, widget)
        widget.ui.freezeButton.click()
        pump(0.2)
        widget.ui.alignButton.checked = True
        pump(0.2)
        widget.ui.shiftXSlider.value = 4.0
        pump(0.2)
        difference = widget.panel.controller.difference()
        if widget.panel.controller.result.accepted:
            test.assertAlmostEqual(difference.add_mm, 4.0, places=1)
        alignment, centre_mm = widget.panel.controller.alignment, phantom.case.vessels.centroid_mm
        far = nudged(alignment.camera_from_world, centre_mm, np.array([0, 0, 300.0]), np.array([0, 0, 120.0]))
        alignment.set_pose(far)  # by landmarks or handles: farther than the sliders go
        pump(0.2)
        widget.ui.shiftXSlider.value = 2.0
        pump(0.2)
        expected = nudged(far, centre_mm, np.array([2.0, 0, 0]), np.zeros(3))
        np.testing.assert_allclose(alignment.camera_from_world, expected, atol=0.1)
        widget.ui.alignButton.checked = False
        pump(0.2)
        test.assertIn("ADD", widget.ui.differenceLabel.text)
        widget.ui.startButton.click()


CASES = (
    says_what_is_missing,
    follows_frames_and_gives_the_layout_back,
    may_be_stopped_while_it_loads,
    scene_close_and_reload_in_mid_stream_leave_nothing,
    records_and_replays,
    aligns_by_hand,
)


def registration_is_installed(test) -> bool:
    missing = dependencies.missing("registration")
    if missing:
        test.delayDisplay(f"Skipped: not installed in this Slicer: {', '.join(missing)}.")
    return not missing


def opened():
    """The module's widget, entered."""
    if slicer.util.mainWindow():
        slicer.util.selectModule(MODULE)
        return slicer.util.getModuleWidget(MODULE)
    widget = slicer.util.getModuleWidget(MODULE)
    widget.enter()
    return widget


def started(folder: Path):
    """The phantom and the widget, running on its frames."""
    from ..demo.phantom import make_phantom, write_sample_frames

    phantom = make_phantom(folder / "case")
    write_sample_frames(phantom, folder / "frames", 24)
    widget = opened()
    p = widget.panel.parameters()
    p.casePath, p.sourcePath, p.sourceKind = str(folder / "case"), str(folder / "frames"), "path"
    p.repeat, p.rateHz, p.staleMs = True, 15.0, 20000
    pump(0.1)
    widget.ui.startButton.enabled = True
    widget.ui.startButton.click()
    return phantom, widget


def watch_drawing(panel) -> list:
    """Collects what stood over the microscope's picture whenever it was drawn with an overlay but not as trusted."""
    found: list = []
    for view, banner in panel.layout._banners[:1]:

        def drawn(_caller, _event, banner=banner):
            live = panel.controller.live
            trusted = banner._said is not None and banner._said[1] in (live_texts.GREEN, live_texts.AMBER)
            if live is not None and live.overlay_visible and not trusted:
                found.append(banner._said)

        view.renderWindow().AddObserver("EndEvent", drawn)
    return found


def truth_of(phantom, result):
    """The true pose of a frame of the sample, or None for one that has none."""
    from ..demo.phantom import COVERED

    number = int(Path(result.frame.name).stem)
    return None if number in COVERED else phantom.pose(number / 24)


def next_result(test, widget, ticks_ms: list | None = None, timeout_s: float = 60.0):
    """Let Slicer work until another frame is shown; returns the status. ticks_ms: takes how long each tick was."""
    controller, seen = widget.panel.controller, widget.panel.controller.result
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        slicer.app.processEvents()
        begin = time.thread_time()  # of this thread alone: what else the computer does is not the panel's
        widget.panel.tick()
        if ticks_ms is not None:
            ticks_ms.append((time.thread_time() - begin) * 1000)
        if controller.result is not None and controller.result is not seen:
            return controller.status
    test.fail(f"no frame came: {controller.status}")
    return None


def until(test, condition, timeout_s: float = 60.0) -> None:
    """Let Slicer work until the condition holds."""
    end = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end:
            test.fail("did not happen in time")
        slicer.app.processEvents()
        time.sleep(0.005)


def pump(seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        slicer.app.processEvents()
        time.sleep(0.005)


def threads() -> list[str]:
    return [thread.name for thread in threading.enumerate() if thread.name.startswith("ExpectedAppearances")]
