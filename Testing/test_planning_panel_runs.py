"""The planning panel with stand-ins for Qt and Slicer: training, study, verdict and packages."""

from __future__ import annotations

from panels import in_the_panel

from ExpectedAppearancesLib.widgets.refreshing import set_percent


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


def test_the_verdict_names_the_test_that_it_rests_on():
    in_the_panel(
        """
from ExpectedAppearancesLib.planning.recorded import Recorded
from ExpectedAppearancesLib.evaluation.verdict import OWN_VALIDATION, Figures
panel.recorded = Recorded(verdict=(True, ()))
loto, own, strict = (Figures(name, "", *[1.0] * 8) for name in ("loto", OWN_VALIDATION, "strict"))
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


def test_a_study_that_would_begin_anew_says_so():
    in_the_panel(
        """
from ExpectedAppearancesLib.planning.recorded import Recorded
from ExpectedAppearancesLib.planning.steps import Study
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
p.acceptedAddLimitMm = 2.0
panel.open_folder("first")
assert drawn["limit"] == 2.0
p.acceptedAddLimitMm = 1.5
panel.refresh()
assert drawn["limit"] == 1.5
"""
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


def test_packages_are_installed_once_however_often_it_is_clicked():
    """Slicer 5.8 works off what was clicked meanwhile at each line that pip prints: pip was started again within."""
    in_the_panel(
        """
import contextlib
from ExpectedAppearancesLib.widgets import planning_help
planning_help.slicer.util.tryWithErrorDisplay = lambda *_, **__: contextlib.nullcontext()
missing, begun = {"planning": ["filelock>=3.12"], "training": []}, []

def install(kind, *_):
    begun.append(kind)
    panel.help.on_install()
    panel.help.refresh()
    assert "being installed" in panel.ui.installButton.toolTip
    missing["planning"] = []
    return True

planning_help.dependencies.missing, planning_help.dependencies.install = missing.get, install
panel.help.enter()
panel.help.on_install()
assert begun == ["planning", "training"], begun
"""
    )


def test_progress_is_painted_with_the_rest_of_the_window():
    """QProgressBar paints as soon as its value changes: 40 ms in the midst of a refresh, of the whole window."""

    class Bar:
        """As QProgressBar, whose setValue repaints at once unless updates are off; switching them on paints later."""

        updatesEnabled, painted_at_once, _value = True, 0, -1

        @property
        def value(self):
            return self._value

        @value.setter
        def value(self, percent):
            self._value = percent
            self.painted_at_once += self.updatesEnabled

    bar = Bar()
    for percent in (3, 4, 4):
        set_percent(bar, percent)
        assert (bar.value, bar.updatesEnabled, bar.painted_at_once) == (percent, True, 0)
