"""The planning panel with stand-ins for Qt and Slicer: what its sections do with what they are told."""

from __future__ import annotations

import subprocess
import sys

from test_extension import FOLDER, OPEN_THE_PANEL, ROOT


def in_the_panel(code: str, *arguments) -> None:
    """Run `code` in a fresh interpreter in which `panel` is open; what it asserts must hold."""
    command = [sys.executable, "-c", OPEN_THE_PANEL + code, str(FOLDER), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


def test_what_a_training_told_is_not_shown_for_another_case(tmp_path):
    in_the_panel(
        """
from ExpectedAppearancesLib.runs.state import RunState, RunStatus
panel.scene.GetNumberOfNodesByClass.return_value = 0
training, told = panel.sections["training"], RunStatus(RunState.RUNNING, values={"step": 5, "loss": 1.0})
for folder in ("first", "second", "second"):  # the second one saved anew
    panel.open_folder(sys.argv[2] + folder)
    assert training._curve(None) == []
    training.on_status(told)
    assert [point["step"] for point in training._curve(None)] == [5]
""",
        tmp_path,
    )


def test_a_run_of_the_case_that_was_replaced_is_forgotten(tmp_path):
    in_the_panel(
        """
from ExpectedAppearancesLib.runs.state import RunState, RunStatus
panel.open_folder(sys.argv[2])
panel.runs["train"].status = RunStatus(RunState.FAILED, problem="The run was ended by signal 9.")
panel.refresh()
assert "signal 9" in panel.sections["training"].controls._label.text
panel.open_folder(sys.argv[2])
assert panel.sections["training"].controls._label.text == ""
""",
        tmp_path,
    )


def test_a_photograph_is_kept_in_the_folder_that_it_was_added_to(tmp_path):
    """Saved an hour later, maybe: the shipped textures, or those of another case, may be chosen by then."""
    (tmp_path / "own").mkdir()
    in_the_panel(
        """
from ExpectedAppearancesLib.widgets import planning_labelling
commands = []
planning_labelling.Child = lambda command, *_: commands.append(command) or MagicMock()
planning_labelling.labelling.labels_of = lambda nodes: []
panel.parameters.texturesPath = sys.argv[2]
panel.sections["textures"].on_add("/photographs/a.png")
panel.parameters.texturesPath = ""
panel.sections["textures"].labelling.save()
assert commands[-1][-2:] == [sys.argv[2], "a"], commands[-1]
""",
        tmp_path / "own",
    )


def test_a_photograph_never_takes_the_name_of_another_file(tmp_path):
    for name in ("Foto 1.png", "Foto_1.jpg", "b.png", "b.tif"):
        (tmp_path / name).touch()
    in_the_panel(
        """
from ExpectedAppearancesLib.widgets import planning_labelling
planning_labelling.Child = MagicMock()
textures = panel.sections["textures"]
panel.parameters.texturesPath = sys.argv[2]
for photograph, name in (("foto_1", "foto_1-2"), ("b", "b-2"), ("labels", "labels-2"), ("c", "c")):
    textures.on_add(f"/photographs/{photograph}.png")
    assert textures.labelling._name == name, textures.labelling._name
""",
        tmp_path,
    )


def test_textures_that_cannot_be_written_are_told(tmp_path):
    (tmp_path / "a.png").touch()
    in_the_panel(
        """
from pathlib import Path
from ExpectedAppearancesLib.widgets import planning_textures
planning_textures.slicer.util = MagicMock()
told = planning_textures.slicer.util.errorDisplay
textures = panel.sections["textures"]

def refused(*_arguments, **_named):
    raise PermissionError(13, "Permission denied")

Path.unlink = planning_textures.copy_shipped_textures.__globals__["shutil"].copyfile = refused
panel.parameters.texturesPath = sys.argv[2]
panel.ui.texturesList.selectedItems.return_value = [MagicMock(data=lambda role: "a")]
textures.on_remove()
assert "cannot be written" in told.call_args.args[0]
told.reset_mock()
panel.parameters.texturesPath = ""
panel.session.case = lambda p: MagicMock(folder=Path(sys.argv[2]))
textures.on_add("/photographs/a.png")
assert "cannot be written" in told.call_args.args[0]
assert panel.parameters.texturesPath == "" and textures.labelling._name == ""
""",
        tmp_path,
    )


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


def test_a_card_of_another_computer_is_not_asked_for():
    """A scene names the card that was chosen where it was saved; the panel shows Automatic where it is not."""
    in_the_panel(
        """
from ExpectedAppearancesLib.gpus import Gpu
for card, options, shown in ((1, ["--device", "auto"], 0), (0, ["--device", "cuda"], 2)):
    panel.sections["training"]._found([Gpu(0, "A", 16.0)])
    panel.parameters.device = f"cuda:{card}"
    panel.refresh()
    assert panel.ui.deviceCombo.currentIndex == shown
    for name in ("appearances", "training", "validation"):
        arguments, environment = panel.sections[name].arguments()
        assert arguments[-2:] == options and bool(environment) is (shown == 2), (name, arguments, environment)
"""
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


def test_the_verdict_names_the_test_that_it_rests_on():
    in_the_panel(
        """
from ExpectedAppearancesLib.case.recorded import Recorded
from ExpectedAppearancesLib.evaluation.verdict import OWN_VALIDATION, Figures
panel.recorded = Recorded(verdict=(True, ()))
loto, own, strict = (Figures(name, "", *[1.0] * 6) for name in ("loto", OWN_VALIDATION, "strict"))
for rows, words in (([loto, own], "own validation"), ([strict, loto, own], "unseen texture and pose")):
    assert words in panel.sections["validation"]._verdict(rows), panel.sections["validation"]._verdict(rows)
    assert ">Ready<" in panel.sections["validation"]._verdict(rows)
panel.recorded = Recorded(verdict=(True, ()), validation="stale")
text = panel.sections["validation"]._verdict(rows)
assert "Outdated" in text and ">Ready<" not in text
"""
    )


def test_helpers_open_no_window_on_windows():
    in_the_panel(
        """
from ExpectedAppearancesLib.runs import system_report, worker
from ExpectedAppearancesLib.widgets import planning_qt
for module in (planning_qt, system_report, worker):
    module.WITHOUT_WINDOW = {"creationflags": 134217728}
    module.subprocess = MagicMock()
planning_qt.Child(["nvidia-smi"], print)
system_report.SystemCheck()
worker.Worker("surfaces").ask({})
for module in (planning_qt, system_report, worker):
    assert module.subprocess.Popen.call_args.kwargs["creationflags"] == 134217728, module
"""
    )


def test_the_shipped_textures_are_known_however_their_path_is_written(tmp_path):
    """Qt writes paths with other slashes than Windows; taken for the user's own they could be deleted."""
    in_the_panel(
        """
from ExpectedAppearancesLib.textures.library import shipped_textures_folder
shipped = str(shipped_textures_folder())
for path, chosen in ((shipped + "/", ""), (sys.argv[2], sys.argv[2]), (shipped + "/../generated", ""), ("", "")):
    panel.ui.texturesPathEdit.currentPath = path
    panel.sections["textures"].on_path()
    assert panel.parameters.texturesPath == chosen, path
""",
        tmp_path,
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


def test_a_study_that_would_begin_anew_says_so():
    in_the_panel(
        """
from ExpectedAppearancesLib.case.recorded import Recorded
from ExpectedAppearancesLib.case.steps import Study
validation, p = panel.sections["validation"], panel.parameters
panel.recorded = Recorded(study=Study.STOPPED, study_preset={"name": p.preset.value, "minutes": p.minutes})
validation._show_hint(2)
assert "begins anew" not in panel.ui.studyHint.text and "Trains 4 models" in panel.ui.studyHint.text
p.minutes *= 2
validation._show_hint(2)
assert "begins anew" in panel.ui.studyHint.text
"""
    )


def test_another_preset_or_method_brings_its_time_or_size_at_once():
    """Slicer binds parameters to widgets after the panel was set up: who is told of a choice first is the panel, and
    every parameter that is set puts all widgets back to what the parameters say."""
    in_the_panel(
        """
class Bound(module.ExpectedAppearancesParameterNode):
    box = None
    def __setattr__(self, name, value):
        object.__setattr__(self, name, value)
        self.box and self.show()
    def show(self):
        choose(self.box, list(type(getattr(self, self.box))).index(getattr(self, self.box)))

def choose(box, index):
    if shown[box] != index:
        shown[box] = index
        heard[box](index)
        setattr(p, box, list(type(getattr(p, box)))[shown[box]])

shown = {"preset": 0, "method": 0}
heard = {"preset": panel.sections["training"].on_preset, "method": panel.sections["appearances"].on_method}
p = panel.parameters = Bound()
for box, name, index, value in (
    ("preset", "minutes", 1, 90.0),
    ("preset", "minutes", 2, 720.0),
    ("preset", "minutes", 0, 26.0),
    ("method", "sizePx", 1, 256),
    ("method", "sizePx", 0, 384),
):
    p.box = box
    choose(box, index)
    assert shown[box] == index and getattr(p, name) == value, (box, shown, getattr(p, name))
for box, name in (("preset", "minutes"), ("method", "sizePx")):
    p.box = box
    setattr(p, name, 111)
    choose(box, 1)
    assert getattr(p, name) == 111  # what the user has set
"""
    )


def test_plots_and_table_of_a_case_do_not_stay_for_the_next_one():
    in_the_panel(
        """
from ExpectedAppearancesLib.mrml import charts
from ExpectedAppearancesLib.widgets import planning_training
training, validation, p = panel.sections["training"], panel.sections["validation"], panel.parameters
drawn = {}
charts.chart_of = charts.table_of = lambda *_: bool(drawn)
charts.show_training = lambda scene, curve: drawn.update(loss=curve)
charts.show_figures = lambda scene, rows, limit: drawn.update(figures=rows, limit=limit) or (MagicMock(), MagicMock())
of_case = {"first": [{"step": 5}], "second": [{"step": 5}], "new": []}
training._curve = lambda case: of_case[p.casePath]
validation._rows = lambda: of_case[p.casePath]
validation._verdict = lambda rows: ""
p.casePath = "new"
drawn = {"loss": "saved with the scene", "figures": "saved with the scene"}
panel.open_folder("new")
assert drawn["loss"] == drawn["figures"] == "saved with the scene"
for folder in ("first", "new", "second"):
    panel.open_folder(folder)
    assert drawn["loss"] is drawn["figures"] is of_case[folder], (folder, drawn)
training.on_show_loss()
validation.on_show()
panel.open_folder("new")
assert drawn["loss"] == drawn["figures"] == []
p.addLimitMm = 2.0
panel.open_folder("first")
assert drawn["limit"] == 2.0
p.addLimitMm = 1.5
panel.refresh()
assert drawn["limit"] == 1.5
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
    looking._show_slice(mask, None, None, 1.0, "LPS")
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


def test_an_appearance_that_is_made_again_is_shown_anew(tmp_path):
    """After its texture was corrected, or in a case that was saved anew: it has the name of the old one."""
    in_the_panel(
        """
import os
from pathlib import Path
from ExpectedAppearancesLib.widgets import planning_appearances
planning_appearances.qt = MagicMock()
planning_appearances.qt.QPixmap.return_value.isNull.return_value = False
picture, appearances = Path(sys.argv[2]) / "apricot-0.png", panel.sections["appearances"]
panel.session.reader.newest_image = lambda case, method: (picture, 1) if picture.is_file() else (picture, 0)
panel.session.case = lambda p: MagicMock()
for made_at, shown in ((1, 1), (1, 1), (2, 2), (None, 2), (3, 3)):
    picture.unlink(missing_ok=True)
    if made_at:
        picture.touch()
        os.utime(picture, (made_at, made_at))
    appearances._show_newest(panel.parameters)
    assert panel.ui.newestImage.setPixmap.call_count == shown, (made_at, panel.ui.newestImage.setPixmap.call_count)
""",
        tmp_path,
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


def test_a_full_disk_is_told_where_a_photograph_is_saved_or_a_camera_looked_through(tmp_path):
    in_the_panel(
        """
import numpy as np
from ExpectedAppearancesLib.widgets import planning_labelling, planning_look

def full(*_arguments):
    raise OSError(28, "No space left on device")

np.save = full
planning_labelling.slicer.util = told = MagicMock()
planning_labelling.Child = MagicMock()
planning_labelling.labelling.labels_of = lambda nodes: np.zeros((2, 2), np.uint8)
panel.parameters.texturesPath = sys.argv[2]
panel.sections["textures"].on_add("/photographs/a.png")
labelling = panel.sections["textures"].labelling
planning_labelling.Child.reset_mock()
labelling.save()
assert "No space left" in told.errorDisplay.call_args.args[0] and not planning_labelling.Child.called
assert labelling._name == "a"  # what was drawn can be saved once there is space
planning_look.planning.view_direction = lambda *_: (0.0, 100.0)
panel.session.mesh = lambda p, name: MagicMock()
sampler = MagicMock()
sampler.camera.height = sampler.camera.width = 100
panel.sections["poses"]._looking.refresh(panel.parameters, sampler)
assert "No space left" in panel.ui.lookCaption.text
""",
        tmp_path,
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


def test_a_photograph_is_labelled_only_for_a_folder_that_it_can_be_saved_in(tmp_path):
    (tmp_path / "shared").mkdir()
    in_the_panel(
        """
import os
from ExpectedAppearancesLib.widgets import planning_labelling, planning_textures
planning_labelling.Child, planning_textures.slicer.util = MagicMock(), MagicMock()
textures, told = panel.sections["textures"], planning_textures.slicer.util.errorDisplay
usual = os.access
os.access = lambda path, mode: mode != os.W_OK and usual(path, mode)
for folder in ("/shared", "/gone"):
    panel.parameters.texturesPath = sys.argv[2] + folder
    textures.on_add("/photographs/a.png")
    assert folder + ": you may not write" in told.call_args.args[0] and textures.labelling._name == ""
os.access = usual
panel.parameters.texturesPath = sys.argv[2] + "/shared"
textures.on_add("/photographs/a.png")
assert textures.labelling._name == "a"
""",
        tmp_path,
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


def test_who_declines_packages_is_not_asked_for_more():
    in_the_panel(
        """
import contextlib
from ExpectedAppearancesLib.widgets import planning_help
util = planning_help.slicer.util = MagicMock()
util.tryWithErrorDisplay = lambda *_, **__: contextlib.nullcontext()
planning_help.dependencies.missing = lambda kind: ["filelock>=3.12"]
util.confirmOkCancelDisplay.return_value = False
panel.help.on_install()
assert util.confirmOkCancelDisplay.call_count == 1
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
