"""The live panel with stand-ins for Qt and Slicer: what it does with what it is told."""

from __future__ import annotations

from panels import in_the_live_panel


def test_the_camera_of_a_frame_is_remembered_in_each_scene():
    """A scene does not save where a view's principal point is, so a loaded one could not be shown without it."""
    in_the_live_panel(
        """
from ExpectedAppearancesLib.geometry.camera import Camera
controller.camera = Camera(320, 240, 700.0, 690.0, 170.0, 108.0)
for scene in range(2):
    panel.set_parameter_node(parameter_node())
    panel._remember_camera()
    assert "690.0" in panel.parameters().cameraJson, scene
    panel.set_parameter_node(None)
"""
    )


def test_a_camera_file_that_is_taken_out_again_is_not_used():
    """Slicer's field says nothing of an emptied path: the field was empty, and frames went on with that calibration."""
    in_the_live_panel(
        """
class PathEdit(MagicMock):
    def type(self, text):
        for signal, slot in [call.args for call in self.line.connect.call_args_list + self.connect.call_args_list]:
            if signal.startswith("textChanged") or text.endswith(".json"):
                slot(text)

ui = MagicMock()
for name in ("case", "source", "camera"):
    edit = PathEdit()
    edit.line = edit.findChild.return_value = MagicMock()
    setattr(ui, f"{name}PathLineEdit", edit)
panel = LivePanel(ui, controller)
panel.set_parameter_node(parameter_node())
for path in ("other.json", ""):
    ui.cameraPathLineEdit.type(path)
    assert panel.source.choice().camera_path == path
"""
    )


def test_a_volume_that_leaves_the_scene_for_a_while_is_not_replaced_by_another():
    """Slicer's list then takes any other volume: the next start was on the scan, or on the panel's own picture."""
    in_the_live_panel(
        """
stream, scan = MagicMock(), MagicMock()
p = panel.parameters()
for running, chosen in ((False, stream), (True, scan)):
    panel.source.refresh(running)
    panel.source._on_node(chosen)
    assert p.sourceNode is stream
"""
    )


def test_parameters_are_bound_once_and_looked_at_at_each_visit(tmp_path):
    """Slicer 5.8 never ends what was bound: after some dozens of visits each change took the panel tens of ms."""
    in_the_live_panel(
        """
from pathlib import Path
widget = module.ExpectedAppearancesLiveWidget()
widget.addObserver = widget.removeObserver = MagicMock()
widget.logic, widget.panel = MagicMock(), panel
node = widget.logic.getParameterNode.return_value = parameter_node()
node.casePath, node.sourcePath = sys.argv[2], sys.argv[2]
panel._missing, panel.layout, panel.controller.restore = "", MagicMock(), MagicMock()
widget.enter()
assert "case.json" in panel._problem, panel._problem
Path(sys.argv[2], "model").mkdir()
for name in ("case.json", "model/model.onnx"):
    Path(sys.argv[2], name).touch()
for _visit in range(3):
    widget.enter()
    assert panel._problem == "", panel._problem
assert node.connectGui.call_count == 1
""",
        tmp_path,
    )


def test_numbers_are_those_of_what_is_seen():
    """100 % stood under a lost source, and the age of a blank frame under the picture of long before it."""
    in_the_live_panel(
        """
from types import SimpleNamespace
from ExpectedAppearancesLib.live.status import Status
from ExpectedAppearancesLib.live.trust import Sight, Verdict
ui = panel.ui
def numbers(sight, picture=True):
    result = SimpleNamespace(prediction=SimpleNamespace(confidence=0.99), image_rgb=picture or None, latency_ms=20.0)
    panel.status.show(Status(Verdict(sight, 0.2), result))
    return ui.confidenceLabel.text, ui.ageLabel.text
assert numbers(Sight.FOLLOWING) == ("99 %", "200 ms")
assert numbers(Sight.STALE) == numbers(Sight.LOST) == ("–", "200 ms")
assert numbers(Sight.UNUSABLE, picture=False)[1] == "–"
"""
    )


def test_a_message_is_seen_where_the_panel_is_scrolled_down():
    """On a small screen Export seemed to do nothing: what was missing stood above what is seen."""
    in_the_live_panel(
        """
slicer.util = MagicMock()
panel.record._ui.exportPathLineEdit.currentPath = ""
panel.record._on_export()
slicer.util.showStatusMessage.assert_called_with("Choose a folder for the export.")
"""
    )


def test_a_recorded_frame_that_was_refused_is_not_taken_for_a_live_one():
    in_the_live_panel(
        """
from types import SimpleNamespace
from ExpectedAppearancesLib.live.status import Status
from ExpectedAppearancesLib.live.trust import Sight, Verdict
from ExpectedAppearancesLib.widgets import live_texts
for picture, words in ((None, "A recorded frame, not live"), (True, "Clear the view")):
    result = SimpleNamespace(image_rgb=picture, steadied=None)
    assert words in live_texts.detail(Status(Verdict(Sight.REFUSED), result))
"""
    )


def test_a_new_choice_is_not_judged_by_the_message_about_the_one_before():
    """Start was disabled, and the panel told why another file could not be read."""
    in_the_live_panel(
        """
panel._missing = ""
panel.say("other.json: damaged")
panel.refresh()
assert "damaged" in panel.ui.problemLabel.text
panel.parameters().sourceKind, panel.parameters().device = "device", ""
panel.refresh()
assert "capture device" in panel.ui.problemLabel.text, panel.ui.problemLabel.text
"""
    )


def test_why_the_sample_cannot_be_made_is_said_in_the_panel(tmp_path):
    in_the_live_panel(
        """
from pathlib import Path
from ExpectedAppearancesLib.widgets import live_sample
live_sample.folder = lambda: Path(sys.argv[2]) / "no folder"
Path(sys.argv[2], "no folder").write_text("")
assert live_sample.run_sample(panel) is False
assert "no folder" in panel._message, panel._message
""",
        tmp_path,
    )


def test_packages_are_installed_once_however_often_it_is_clicked():
    """Slicer 5.8 works off what was clicked meanwhile at each line that pip prints: it asked, and installed, again."""
    in_the_live_panel(
        """
from ExpectedAppearancesLib.widgets import live_install
begun = []

def install(say):
    begun.append(say)
    panel.install()

live_install.install = install
panel.install()
assert len(begun) == 1
panel.install()
assert len(begun) == 2

from ExpectedAppearancesLib.runs import dependencies
with dependencies.installing():  # the planning panel does
    panel.install()
assert len(begun) == 2 and not dependencies.is_installing()
"""
    )


def test_the_overview_is_laid_out_for_each_case():
    """Two patients in turn: the second one's head may lie anywhere else."""
    in_the_live_panel(
        """
from types import SimpleNamespace
from ExpectedAppearancesLib.live.status import Status
from ExpectedAppearancesLib.live.trust import Sight, Verdict
layout = panel.layout
layout.views, widget = MagicMock(), MagicMock()
layout._three_d = lambda _name: widget
for key in ("first", "first", "second"):
    result = SimpleNamespace(case_key=key, prediction=None)
    layout.show(Status(Verdict(Sight.FOLLOWING), result, new=True))
assert widget.threeDView().resetCamera.call_count == 2
"""
    )


def test_a_landmark_that_was_not_picked_in_the_end_is_not_waited_for():
    """The next click made a new list of points in the patient's scene."""
    in_the_live_panel(
        """
slicer.app = MagicMock()
interaction = slicer.app.applicationLogic().GetInteractionNode()
selection = slicer.app.applicationLogic().GetSelectionNode()
panel.align._lists = [MagicMock(), MagicMock()]
for node, name in zip(panel.align._lists, "FM"):
    node.GetID.return_value = name
panel.align._pick(1)
selection.GetActivePlaceNodeID.return_value = "M"
interaction.SetCurrentInteractionMode.assert_called_with(interaction.Place)
panel.align.close()
interaction.SetCurrentInteractionMode.assert_called_with(interaction.ViewTransform)
interaction.reset_mock()
panel.align.close()
interaction.SetCurrentInteractionMode.assert_not_called()  # the user's own picking goes on
"""
    )


def test_each_view_is_drawn_in_an_event_of_its_own_and_none_is_left_paused():
    """All views in one call hold the GUI up; a view that stays paused is never drawn again."""
    in_the_live_panel(
        """
import contextlib
from ExpectedAppearancesLib.widgets import drawing
drawn, events = [], []
drawing.qt.QTimer = MagicMock(singleShot=lambda _ms, action: events.append(action))

class View:
    visible, paused = True, 0
    def pauseRender(self):
        self.paused += 1
    def resumeRender(self):
        self.paused -= 1
        if not self.paused:
            drawn.append(self)

views = plane, overview, through = View(), View(), View()
hidden = View()
hidden.visible = False
drawing.slicer.app = MagicMock()
drawing.slicer.app.pauseRender = lambda: [view.pauseRender() for view in views]
drawing.slicer.app.resumeRender = lambda: [view.resumeRender() for view in views]
manager = drawing.slicer.app.layoutManager.return_value
manager.sliceViewNames.return_value = ["Microscope", "Hidden"]
manager.sliceWidget = lambda name: MagicMock(sliceView=lambda: plane if name == "Microscope" else hidden)
manager.threeDViewCount = 2
manager.threeDWidget = lambda i: MagicMock(threeDView=lambda: views[1 + i])

def event():
    events.pop(0)()
    assert len(events) <= 1  # one turn at a time

held = drawing.DrawnInTurn()
with held:
    with held:
        pass
    assert not events
assert not drawn
event()
assert drawn == [plane]
event()
with held:  # the next frame is there before the last view had its turn
    pass
assert drawn == [plane, overview]
while events:
    event()
assert drawn == [plane, overview, through, plane, overview] and not any(view.paused for view in views)

def gone():
    raise ValueError("Trying to call 'resumeRender' on a destroyed qMRMLThreeDView object")

with contextlib.suppress(RuntimeError), held:
    raise RuntimeError
overview.resumeRender = gone
while events:
    event()
assert drawn[5:] == [plane, through] and not plane.paused and not through.paused and not hidden.paused
"""
    )


def test_nothing_of_a_recording_is_shown_once_the_module_is_left():
    """The end of the session that it was made in brings it back, and after that nobody would take it away."""
    in_the_live_panel(
        """
shown = []
controller.running, controller.recorder = True, None
def stop():
    controller.running = False
    shown.clear()
controller.stop = controller.leave = stop
controller.look_at = lambda browser, _case: shown.append(browser) or controller.status
slicer.mrmlScene = MagicMock()
slicer.mrmlScene.IsBatchProcessing.return_value = False
browser = panel.parameters().browser = MagicMock()
browser.GetNumberOfItems.return_value = 2
panel._camera, panel.status, panel.layout, panel.align = controller.camera, MagicMock(), MagicMock(), MagicMock()
panel.stop()
assert shown == [browser]
panel.leave()
assert shown == []
"""
    )
