"""Section Training: preset, device and time; progress and the loss as a plot while it goes on."""

from __future__ import annotations

import math

import slicer
from slicer.i18n import tr as _

from ..gpus import Gpu, device_arguments
from ..model.presets import PRESETS
from ..mrml import charts
from ..planning.steps import StepState
from ..runs.state import RunStatus
from .planning_devices import find_gpus
from .planning_qt import allow
from .planning_run import RunControls, in_the_way, started
from .planning_section import Section, changed
from .refreshing import quiet


class TrainingSection(Section):
    name = "training"
    title = "Training"

    def setup(self) -> None:
        ui = self.ui
        self._gpus: list[Gpu] = []
        self._asked = None
        self._live: list[dict] = []  # told by the run since its last checkpoint
        self._plotted: tuple | None = None  # what the plot shows: case, number of points, last step
        self.controls = RunControls(
            self.panel.runs["train"],
            ui.trainingStart,
            ui.trainingCancel,
            ui.trainingProgress,
            ui.trainingLine,
            _("Train this patient's model on the expected appearances."),
        )
        ui.trainingStart.connect("clicked(bool)", lambda _checked=False: self.on_start())
        ui.trainingCancel.connect("clicked(bool)", lambda _checked=False: self.controls.watch.cancel())
        ui.deviceCombo.connect("currentIndexChanged(int)", self.on_device)
        ui.presetCombo.connect("currentIndexChanged(int)", self.on_preset)
        ui.showLossButton.connect("clicked(bool)", lambda _checked=False: self.on_show_loss())
        self._fill_devices()

    def enter(self) -> None:
        """Look for graphics cards, once."""
        if self._asked is None:
            self._asked = find_gpus(self._found) or False

    def refresh(self) -> None:
        p, ui = self.parameters, self.ui
        with quiet(ui.deviceCombo):
            ui.deviceCombo.currentIndex = self._device_keys().index(self.device)
        problem = self.step.text if self.step.state is StepState.MISSING else ""
        before = self.panel.steps["appearances"]
        if before.state is not StepState.DONE:
            problem = problem or self.reason_of("appearances")
        problem = in_the_way(self.panel, "train") or problem or self.panel.help.reason("training")
        self.controls.refresh(problem, self._unfinished(), self.step.state is StepState.DONE, self.step.text)
        curve = self._curve(self.session.case(p))
        allow(
            ui.showLossButton, "" if curve else _("Nothing has been trained yet."), _("Show the plot of loss and ADD.")
        )
        self._plot(curve)

    @property
    def device(self) -> str:
        """What is chosen; "auto" for a card of the computer that the scene comes from."""
        return self.parameters.device if self.parameters.device in self._device_keys() else "auto"

    def close(self) -> None:
        self.forget_run()
        self._plotted = None

    def forget_run(self) -> None:
        """Another case is open: what a run of the one before has told is not its own."""
        self._live = []

    def on_status(self, status: RunStatus) -> None:
        """Take what the run tells between two checkpoints."""
        step = status.values.get("step")
        if step is None:
            return
        if not self._live or self._live[-1]["step"] != step:
            loss, add = (status.values.get(key) for key in ("loss", "validation_add_mm"))
            self._live.append({"step": step, "loss": loss, "validation_add_mm": add})
        if self.parameters is not None:  # the plot is looked at while another module is used
            self._plot(self._curve(self.session.case(self.parameters)))

    def on_start(self) -> None:
        self._live = []
        self.on_show_loss()  # before: to open a plot view takes Slicer a while
        started(self.panel, self.controls.watch, *self.arguments())

    def arguments(self) -> tuple[list[str], dict[str, str]]:
        """Options of the command `train`, and what its environment needs."""
        p = self.parameters
        device, environment = device_arguments(self.device)
        options = ["--preset", p.preset.value, "--minutes", f"{p.minutes:g}", "--appearances", p.method.value]
        return [*options, *device], environment

    def on_preset(self, index: int) -> None:
        """Each preset has a time of its own, which is taken over where the time was that of the preset before."""
        p = self.parameters
        if p is None or self.panel.loading or index < 0:
            return
        before, chosen = p.preset, list(type(p.preset))[index]
        # Set here: its box is bound to it later than to this, and to set the time before would undo the choice.
        if not changed(p, "preset", chosen):
            return
        if math.isclose(p.minutes, PRESETS[before.value].minutes):
            p.minutes = PRESETS[chosen.value].minutes

    def on_device(self, index: int) -> None:
        keys = self._device_keys()
        if 0 <= index < len(keys):
            changed(self.parameters, "device", keys[index])

    def on_show_loss(self) -> None:
        """Draw the plot, and a layout with a plot view where there is none."""
        chart = self._draw(self._curve(self.session.case(self.parameters)))
        slicer.modules.plots.logic().ShowChartInLayout(chart)

    def _plot(self, curve: list[dict]) -> None:
        """Bring the plot up to date where there is one; it comes with the start, or when it is asked for."""
        other = self._version(curve) != self._plotted and (curve or self._plotted)  # nothing, after another case's
        if other and charts.chart_of(self.panel.scene, "training.chart"):
            with slicer.util.RenderBlocker():
                self._draw(curve)

    def _draw(self, curve: list[dict]):
        self._plotted = self._version(curve)
        return charts.show_training(self.panel.scene, curve)

    def _version(self, curve: list[dict]) -> tuple:
        return (self.parameters.casePath, len(curve), curve[-1]["step"] if curve else 0)

    def _curve(self, case) -> list[dict]:
        """What the last checkpoint holds, then what the run has told since."""
        saved = self.session.reader.curve(case) if case else []
        last = saved[-1]["step"] if saved else -1
        if self.panel.runs["train"].active and self._live and self._live[0]["step"] < last // 2:
            saved = []  # the checkpoint is that of an older training
            last = -1
        return saved + [point for point in self._live if point["step"] > last]

    def _unfinished(self) -> bool:
        manifest = self.panel.recorded.manifest
        trained = manifest and manifest["stages"].get("train", {})
        return bool(trained and not trained.get("done") and self.panel.recorded.steps_trained)

    def _found(self, gpus: list[Gpu]) -> None:
        self._gpus = gpus
        self._fill_devices()
        self.panel.refresh_soon()

    def _device_keys(self) -> list[str]:
        return ["auto", "cpu", *(gpu.key for gpu in self._gpus)]

    def _fill_devices(self) -> None:
        combo = self.ui.deviceCombo
        with quiet(combo):
            combo.clear()
            combo.addItems([_("Automatic: a graphics card where there is one"), _("Processor (CPU)")])
            for gpu in self._gpus:
                combo.addItem(_("{name}, {memory:.0f} GB").format(name=gpu.name, memory=gpu.memory_gb))
