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


def test_each_3d_view_is_drawn_in_an_event_of_its_own_and_none_is_left_paused():
    """All views in one call hold the GUI up; a view that stays paused is never drawn again."""
    in_the_live_panel(
        """
import contextlib
from ExpectedAppearancesLib.widgets.live_drawing import DrawnInTurn
drawn = []

class View:
    paused = 0
    def pauseRender(self):
        self.paused += 1
    def resumeRender(self):
        self.paused -= 1
        if not self.paused:
            drawn.append(self)

slices, first, second = views = View(), View(), View()
slicer.app = MagicMock()
slicer.app.pauseRender = lambda: [view.pauseRender() for view in views]
slicer.app.resumeRender = lambda: [view.resumeRender() for view in views]
manager = slicer.app.layoutManager.return_value
manager.threeDViewCount = 2
manager.threeDWidget = lambda i: MagicMock(threeDView=lambda: views[1 + i])

drawing = DrawnInTurn()
with drawing:
    with drawing:
        pass
    assert not drawn
assert drawn == [slices] and [view.paused for view in views] == [0, 1, 1]
drawing._draw_next()
assert drawn == [slices, first]
with drawing:  # the next frame is there before the second view had its turn
    assert drawn == [slices, first]
drawing._draw_next()
drawing._draw_next()
assert drawn == [slices, first, slices, second, first] and not any(view.paused for view in views)
with contextlib.suppress(RuntimeError), drawing:
    raise RuntimeError
drawing.finish()
assert drawn[5:] == [slices, first, second] and not any(view.paused for view in views)

def gone():
    raise ValueError("Trying to call 'resumeRender' on a destroyed qMRMLThreeDView object")

with drawing:
    pass
first.resumeRender = gone
drawing.finish()
assert drawn[-1] is second and not second.paused
"""
    )
