"""The planning panel with stand-ins for Qt and Slicer: its case, what is chosen for it and shown of it."""

from __future__ import annotations

from panels import in_the_panel

SAVED_ANEW = """
from pathlib import Path
from ExpectedAppearancesLib.widgets import planning_case
told = planning_case.slicer.util = MagicMock()
section, folder, made = panel.sections["case"], Path(sys.argv[2]), Path(sys.argv[2]).with_name(".case.new")

def save(content):
    for part in (made, folder / "textures"):
        part.mkdir(parents=True, exist_ok=True)
    (folder / "textures" / "a.png").touch()
    (made / "case.json").write_text(content)
    section._put_in_place(made, folder)

panel.open_folder(str(folder))
"""


def test_a_case_may_be_saved_anew_twice_within_a_minute(tmp_path):
    in_the_panel(
        SAVED_ANEW
        + """
planning_case.time.strftime = lambda _format: "2026-01-02 03.04"
for content in ("1", "2", "3"):
    save(content)
kept = sorted(path.name for path in folder.parent.iterdir())
name = "case until 2026-01-02 03.04"
assert kept == ["case", name, name + " (2)", name + " (3)"], kept
assert (folder / "case.json").read_text() == "3" and (folder / "textures" / "a.png").is_file()
assert (folder.with_name(name + " (3)") / "case.json").read_text() == "2"
assert not told.errorDisplay.called
""",
        tmp_path / "case",
    )


def test_a_case_that_cannot_be_replaced_stays_as_it_was(tmp_path):
    in_the_panel(
        SAVED_ANEW
        + """
save("1")
usual, planning_case.shutil.copytree = planning_case.shutil.copytree, MagicMock(side_effect=OSError(28, "disk full"))
save("2")
assert "disk full" in told.errorDisplay.call_args.args[0]
planning_case.shutil.copytree, rename = usual, Path.rename
Path.rename = lambda path, to: rename(path, to) if path.name != made.name else open(path)  # used by another program
save("3")
assert (folder / "case.json").read_text() == "1" and (folder / "textures" / "a.png").is_file()
assert len(list(folder.parent.iterdir())) == 2, list(folder.parent.iterdir())
""",
        tmp_path / "case",
    )


def test_a_case_that_another_program_works_on_is_neither_replaced_nor_worked_on(tmp_path):
    """A training that a second Slicer or a shell has started would write its model into the new case."""
    in_the_panel(
        SAVED_ANEW
        + """
from ExpectedAppearancesLib.runs.record import exclusive
from ExpectedAppearancesLib.widgets import planning_run
save("1")
started = []
panel.runs["synthesize"].start = lambda *_arguments: started.append("synthesize")
panel.session.case = lambda p: None
with exclusive(folder, "train"):
    save("2")
    assert "a training is going on" in told.errorDisplay.call_args.args[0]
    told.errorDisplay.reset_mock()
    sys.modules["slicer"].util = told
    assert not planning_run.started(panel, panel.runs["synthesize"], []) and not started
    assert "a training is going on" in told.errorDisplay.call_args.args[0]
assert (folder / "case.json").read_text() == "1"
assert not made.exists()
assert planning_run.started(panel, panel.runs["synthesize"], []) and started
save("3")
assert (folder / "case.json").read_text() == "3"
""",
        tmp_path / "case",
    )


def test_a_case_that_was_opened_while_another_one_was_saved_stays_open(tmp_path):
    in_the_panel(
        SAVED_ANEW
        + """
panel.open_folder(sys.argv[2] + " of another patient")
save("1")
assert panel.parameters.casePath.endswith("patient") and (folder / "case.json").read_text() == "1"
""",
        tmp_path / "case",
    )


def test_placing_a_point_leaves_a_list_of_points_as_it_is():
    in_the_panel(
        """
for points, emptied in ((0, True), (1, True), (3, False)):
    chosen = panel.parameters.craniotomyNode = MagicMock()
    chosen.GetNumberOfControlPoints.return_value = points
    panel.sections["poses"].on_place()
    assert chosen.RemoveAllControlPoints.called is emptied
    assert (panel.parameters.craniotomyNode is chosen) is emptied
"""
    )


def test_a_mark_that_is_moved_by_its_transform_is_followed():
    """Slicer tells of that by another event than of a point that is dragged."""
    in_the_panel(
        """
mark = panel.parameters.craniotomyNode = MagicMock()
panel.parameters.craniotomySource = module.CraniotomySource.MARKED
panel.refresh()
events = [call.args[0] for call in mark.AddObserver.call_args_list]
assert mark.TransformModifiedEvent in events and mark.PointModifiedEvent in events
"""
    )


def test_the_slice_view_looked_through_shows_the_scan_that_was_chosen_meanwhile_afterwards():
    """Another case is opened while the box is ticked: its scan must not give way to that of the patient before."""
    in_the_panel(
        """
from ExpectedAppearancesLib.widgets.planning_look import planning
before = {"BackgroundVolumeID": "MRI of the first", "ForegroundVolumeID": None, "LabelVolumeID": None}
before["LabelOpacity"] = 0.5
shown, composite, slice_node = dict(before), MagicMock(), MagicMock()
for name in shown:
    getattr(composite, "Get" + name).side_effect = lambda n=name: shown[n]
    getattr(composite, "Set" + name).side_effect = lambda value, n=name: shown.update({n: value})
slice_node.GetFieldOfView.return_value = (1.0, 1.0, 1.0)
composite.GetID.return_value, slice_node.GetID.return_value = "Composite", "Slice"
panel.scene.GetNodeByID = lambda name: composite if "Composite" in name else slice_node
planning.look_at_mask = MagicMock()
looking, mask = panel.sections["poses"]._looking, MagicMock(GetID=lambda: "mask")

def look():
    list(looking._show_slice(mask, None, None, 1.0, "LPS"))
    assert list(shown.values()) == [None, None, "mask", 1.0]

for chosen in (None, "MRI of the second"):
    for once_more in (False, True):
        shown.update(before)
        look()
        shown["BackgroundVolumeID"] = chosen
        if once_more:
            look()
        list(looking._take_away())
        assert shown == before | ({"BackgroundVolumeID": chosen} if chosen else {}), shown
"""
    )


def test_what_is_enabled_says_what_it_is():
    """The reason why it was disabled takes the place of its tool tip."""
    in_the_panel(
        """
panel.session.sampler, panel.help.reason = lambda p: MagicMock(), lambda kind: ""
panel.sections["poses"]._show_automatic = panel.sections["poses"]._refresh_cameras = lambda *_: None
panel.sections["poses"]._looking = MagicMock()
p, ui = panel.parameters, panel.ui
for automatic in (True, False):
    p.distanceAuto = p.lateralAuto = automatic
    p.lookThrough = not automatic
    panel.refresh()
    for widget in (ui.nearestSlider, ui.farthestSlider, ui.lateralSlider, ui.poseSlider):
        assert widget.enabled is not automatic and isinstance(widget.toolTip, str) and widget.toolTip
"""
    )


def test_a_case_of_a_scene_from_another_system_is_not_saved_somewhere(tmp_path):
    """On Linux a folder of Windows would be made in whatever folder Slicer was started from."""
    in_the_panel(
        """
panel.session.mesh = lambda p, name: None
panel.parameters.vesselsNode, panel.ui.saveCaseButton.enabled = MagicMock(), True
for folder, enabled in (("case", False), (sys.argv[2], True)):
    panel.open_folder(folder)
    assert panel.ui.saveCaseButton.enabled is enabled, panel.ui.saveCaseButton.toolTip
    assert enabled or "is not there" in panel.ui.saveCaseButton.toolTip
""",
        tmp_path / "case",
    )


def test_a_case_that_was_moved_is_missed_in_a_saved_scene_and_not_saved_anew(tmp_path):
    """Hours of training lie in the folder that was renamed: a new case in its old place has none of it."""
    in_the_panel(
        """
panel.session.mesh = lambda p, name: None
p, ui = panel.parameters, panel.ui
p.vesselsNode, ui.saveCaseButton.enabled = MagicMock(), True
p.casePath = p.savedCasePath = sys.argv[2]  # as the scene says
panel.refresh()
assert "open the case where it is now" in panel.steps["case"].text and not ui.saveCaseButton.enabled
panel.open_folder(sys.argv[2])  # New, of the same name
assert "is not there" not in panel.steps["case"].text and ui.saveCaseButton.enabled
""",
        tmp_path / "case",
    )


def test_runs_of_the_cases_that_were_open_before_are_ended_with_the_scene_too(tmp_path):
    in_the_panel(
        """
from pathlib import Path
from ExpectedAppearancesLib.runs.state import RunState, RunStatus

def run_of(folder, state=RunState.RUNNING):
    run = MagicMock(kind="train", case_folder=Path(sys.argv[2]) / folder, started="today")
    run.poll.return_value = RunStatus(state)
    return run

asked = []
panel._choice = lambda runs: asked.append(runs) or module.WhenClosing.DETACH
training, first, second = panel.runs["train"], run_of("first"), run_of("second")
found = {"first": first, "second": second, "third": None}
training.follow = lambda folder: setattr(training, "run", found[Path(folder).name])
for folder in ("first", "second", "first", "third"):
    panel.open_folder(str(Path(sys.argv[2]) / folder))
panel.closing_scene()
assert sorted(map(id, asked.pop())) == sorted(map(id, (first, second)))
panel.closing_scene()
assert not asked
for folder in ("first", "third"):
    panel.open_folder(str(Path(sys.argv[2]) / folder))
panel.parameters.whenClosing = module.WhenClosing.END
second.poll.return_value = first.poll.return_value = RunStatus(RunState.CANCELLING)
panel.open_folder(str(Path(sys.argv[2]) / "second"))
assert panel._ending == [first] and not panel._left  # it is seen to that it ends
panel.quitting()
assert first.wait.called and second.wait.called
""",
        tmp_path,
    )


def test_a_run_that_is_being_cancelled_is_seen_to_its_end_when_the_scene_is_closed():
    """Nobody is asked whether it goes on: it cannot, and who ends it by the deadline is the panel."""
    in_the_panel(
        """
from ExpectedAppearancesLib.runs.state import RunState, RunStatus
panel._choice = lambda runs: module.WhenClosing.DETACH if [run.kind for run in runs] == ["train"] else 1 / 0
for kind, state in (("train", RunState.RUNNING), ("render", RunState.CANCELLING)):
    panel.runs[kind].run = MagicMock(kind=kind)
    panel.runs[kind].run.poll.return_value = RunStatus(state)
cancelled = panel.runs["render"].run
panel.closing_scene()
assert panel._ending == [cancelled] and panel._ending_timer.start.called
panel._ending, panel.runs["render"].run = [], cancelled
panel.closing_scene()
assert panel._ending == [cancelled]
"""
    )


def test_the_scan_of_the_case_before_is_not_seen_behind_a_case_without_one():
    in_the_panel(
        """
from ExpectedAppearancesLib.widgets import planning_case
shown = {"Red": "scan", "Green": "atlas"}

def composite(name):
    node = MagicMock()
    node.GetBackgroundVolumeID.side_effect = lambda: shown[name]
    node.SetBackgroundVolumeID.side_effect = lambda volume: shown.update({name: volume})
    return MagicMock(mrmlSliceCompositeNode=lambda: node)

manager = planning_case.slicer.app = MagicMock()
manager.layoutManager.return_value.sliceViewNames.return_value = list(shown)
manager.layoutManager.return_value.sliceWidget.side_effect = composite
scan, case = MagicMock(), panel.sections["case"]
scan.GetID.return_value = "scan"
list(case.showing_scan(None))
assert shown == {"Red": "scan", "Green": "atlas"}
list(case.showing_scan(scan))
assert shown == {"Red": None, "Green": "atlas"}
panel.parameters.mriVolume = scan
list(case.showing_scan(scan))
assert shown == {"Red": "scan", "Green": "scan"}
"""
    )


def test_what_fails_leaves_the_panel_as_it_is_by_then():
    """Slicer displays an error, and passes it on."""
    in_the_panel(
        """
import contextlib
from ExpectedAppearancesLib.widgets import planning_help, planning_panel
planning_help.slicer.util = planning_panel.slicer.util = MagicMock()
planning_panel.slicer.util.tryWithErrorDisplay = lambda *_, **__: contextlib.nullcontext()
missing = {"planning": ["filelock>=3.12"], "training": ["torch>=2.4"]}

def install(kind, *_):
    if kind == "training":
        raise OSError("no network")
    missing[kind] = []
    return True

def refused(_folder):
    raise PermissionError("vessels.vtp")

planning_help.dependencies.missing, planning_help.dependencies.install = missing.get, install
panel.help.enter()
assert panel.help.reason("planning")
panel.session.reader.case = refused
for fails in (panel.help.on_install, lambda: list(panel._open_in_pieces("/case"))):
    panel._timer.reset_mock()
    with contextlib.suppress(OSError):
        fails()
        raise AssertionError
    assert panel._timer.start.called and not panel.opening
assert panel.help.reason("planning") == "" and panel.help.reason("training")
"""
    )


def test_of_another_segmentation_the_segment_with_vessels_is_taken():
    """Slicer calls the segments of every segmentation Segment_1, Segment_2."""
    in_the_panel(
        """
def segmentation(names):
    node = MagicMock()
    node.GetSegmentation().GetNumberOfSegments.return_value = len(names)
    node.GetSegmentation().GetNthSegmentID.side_effect = lambda i: f"Segment_{i + 1}"
    node.GetSegmentation().GetSegment.side_effect = lambda i: MagicMock(GetName=lambda: names[int(i[-1]) - 1])
    return node

case, p = panel.sections["case"], panel.parameters
for names, chosen in ((["Vessels"], 1), (["Brain", "vessels, left"], 2), (["A", "B"], 2), (["C"], 1), ([], None)):
    case.on_vessels(segmentation(names))
    assert p.vesselsSegmentId == (f"Segment_{chosen}" if chosen else ""), (names, p.vesselsSegmentId)
"""
    )


def test_parameters_are_bound_once_and_not_at_each_visit():
    """Slicer 5.8 goes on observing each of them: every visit made every change slower."""
    in_the_panel(
        """
class Widget(module.ExpectedAppearancesWidget):
    addObserver = removeObserver = lambda self, *_: None
    logic = panel = MagicMock()
    _parameterNode = _guiTag = None
    def __init__(self):
        pass

widget = Widget()
for _visit in range(3):
    widget.enter()
    widget.exit()
assert widget.logic.getParameterNode.call_count == 1
widget.onSceneStartClose(None, None)
widget.onSceneEndClose(None, None)
widget.enter()
assert widget.logic.getParameterNode.call_count == 2
"""
    )
