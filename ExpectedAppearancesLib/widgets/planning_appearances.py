"""Section Expected appearances: made in a process of its own, the newest one shown as it is made."""

from __future__ import annotations

import os

import qt
from slicer.i18n import tr as _

from ..gpus import device_arguments
from ..planning.steps import StepState
from .planning_run import RunControls, in_the_way, started
from .planning_section import Section, changed

NEWEST_PX = 220
USUAL_SIZE_PX = {"surface": 384, "image": 256}


class AppearancesSection(Section):
    name = "appearances"
    title = "Expected appearances"

    def setup(self) -> None:
        ui = self.ui
        self._shown: tuple | None = None
        self.controls = RunControls(
            self.panel.runs["synthesize"],
            ui.appearancesStart,
            ui.appearancesCancel,
            ui.appearancesProgress,
            ui.appearancesLine,
            _("Make images of what the cortex could look like in the operating room."),
        )
        ui.appearancesStart.connect("clicked(bool)", lambda _checked=False: self.on_start())
        ui.appearancesCancel.connect("clicked(bool)", lambda _checked=False: self.controls.watch.cancel())
        ui.methodCombo.connect("currentIndexChanged(int)", self.on_method)

    def refresh(self) -> None:
        p = self.parameters
        step = self.step
        problem = ""
        if step.state is StepState.MISSING:
            problem = step.text
        for name in ("poses", "textures"):
            before = self.panel.steps[name]
            if before.state in (StepState.STALE, StepState.MISSING):
                problem = problem or self.reason_of(name)
        problem = in_the_way(self.panel, "synthesize") or problem or self.panel.help.reason("training")
        index = self.panel.recorded.index
        self.controls.refresh(problem, bool(index and not index["done"]), step.state is StepState.DONE, step.text)
        self._show_newest(p)

    def close(self) -> None:
        self._shown = None

    def on_method(self, index: int) -> None:
        """Each method has a size at which it works well."""
        p = self.parameters
        if p is None or self.panel.loading or index < 0:
            return
        before, chosen = p.method, list(type(p.method))[index]
        if changed(p, "method", chosen) and p.sizePx == USUAL_SIZE_PX[before.value]:  # see on_preset of the training
            p.sizePx = USUAL_SIZE_PX[chosen.value]

    def on_start(self) -> None:
        started(self.panel, self.controls.watch, *self.arguments())

    def arguments(self) -> tuple[list[str], dict[str, str]]:
        """Options of the command `synthesize`, and what its environment needs."""
        p = self.parameters
        device, environment = device_arguments(self.panel.sections["training"].device)
        options = ["--textures", str(self.session.textures_folder(p)), "--method", p.method.value]
        return [*options, "--size", str(p.sizePx), "--iterations", str(p.iterations), *device], environment

    def _show_newest(self, p) -> None:
        """The image that was finished last."""
        case = self.session.case(p)
        path, count = self.session.reader.newest_image(case, p.method.value) if case else (None, 0)
        self.ui.newestImage.visible = path is not None
        if path is None or not os.path.isfile(path):
            return
        version = (path, count, os.path.getmtime(path))  # one that is made again has the name of the old one
        if version == self._shown:
            return
        self._shown = version
        picture = qt.QPixmap(str(path))
        if picture.isNull():
            return
        self.ui.newestImage.setPixmap(
            picture.scaled(NEWEST_PX, NEWEST_PX, qt.Qt.KeepAspectRatio, qt.Qt.SmoothTransformation)
        )
        self.ui.newestImage.toolTip = _("{name}, the newest of {count}").format(name=path.name, count=count)
