"""Sections Case and Microscope: what a case is made of, and saving it."""

from __future__ import annotations

import itertools
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import qt
import slicer
from slicer.i18n import tr as _

from ..case.case import MANIFEST_NAME
from ..errors import InputError
from ..mrml.mri import keeping_scan
from ..planning.steps import StepState
from ..runs.record import refuse_if_occupied
from .planning_qt import Child, Stepper, allow, library_command, problems_in
from .planning_section import NodeWatch, Section, changed
from .refreshing import quiet

# Of models, segmentations and the transforms above them.
NODE_EVENTS = ("ModifiedEvent", slicer.vtkMRMLTransformableNode.TransformModifiedEvent)
EXPORTED = {"vessels.vtk": "Vessel model", "cortex.vtk": "Cortex model", "camera.json": "Microscope"}
OWN_TEXTURES = "textures"  # photographs added to this case
SAVE_HINT = "Check models and microscope, and write them into the case folder."


class CaseSection(Section):
    name = "case"
    title = "Case"

    def setup(self) -> None:
        self._saving: Child | None = None
        self._showing = Stepper()
        self._keeping = Stepper()
        self._watches = {name: NodeWatch(self.panel.refresh_soon) for name in ("vesselsNode", "cortexModel")}
        self.ui.vesselsSelector.connect("currentNodeChanged(vtkMRMLNode*)", self.on_vessels)
        self.ui.segmentSelector.connect("currentIndexChanged(int)", self.on_segment)
        self.ui.mriSelector.connect("currentNodeChanged(vtkMRMLNode*)", self.on_mri)
        self.ui.newCaseButton.connect("clicked(bool)", lambda _checked=False: self.on_new())
        self.ui.openCaseButton.connect("clicked(bool)", lambda _checked=False: self.on_open())
        for button in (self.ui.saveCaseButton, self.ui.saveMicroscopeButton):
            button.connect("clicked(bool)", lambda _checked=False: self.save())

    def refresh(self) -> None:
        p = self.parameters
        with quiet(self.ui.vesselsSelector):
            self.ui.vesselsSelector.setCurrentNode(p.vesselsNode)
        self._show_segments(p)
        for name, watch in self._watches.items():
            watch.watch(getattr(p, name), *NODE_EVENTS)
        folder = p.casePath
        self.ui.caseFolderLabel.text = Path(folder).name if folder else _("none")
        self.ui.caseFolderLabel.toolTip = folder
        reason = ""
        if self._saving:
            reason = _("The case is being saved.")
        elif self._keeping.working:
            reason = _("The MRI is being added to the case.")
        elif self.session.waiting(p):
            reason = self.session.waiting(p)
        elif self._saved() and self.session.scan_to_keep(p) is None:
            reason = _("The case is saved; nothing has changed since.")
        elif self.panel.busy():
            reason = _("A run is going on in this case; wait until it has ended, or cancel it.")
        elif not folder:
            reason = _("Choose a folder for the case with New.")
        elif self.panel.recorded.problem and not os.path.isfile(Path(folder) / MANIFEST_NAME):  # it is missed there
            reason = self.step.text
        elif p.vesselsNode is None and self.session.case(p) is None:
            reason = _("Choose the vessel model first.")
        for button in (self.ui.saveCaseButton, self.ui.saveMicroscopeButton):
            allow(button, reason, _(SAVE_HINT))

    def _saved(self) -> bool:
        """Whether the case holds all that anything is made from."""
        return all(self.panel.steps[name].state is StepState.DONE for name in ("case", "microscope"))

    def close(self) -> None:
        self._showing.stop()
        self._keeping.stop()
        for watch in self._watches.values():
            watch.watch(None)
        if self._saving:
            self._saving.stop()
            self._saving = None

    def _show_segments(self, p) -> None:
        node = p.vesselsNode
        is_segmentation = node is not None and node.IsA("vtkMRMLSegmentationNode")
        self.ui.segmentSelector.visible = is_segmentation
        self.ui.segmentLabel.visible = is_segmentation
        if not is_segmentation:
            return
        segmentation = node.GetSegmentation()
        ids = [segmentation.GetNthSegmentID(i) for i in range(segmentation.GetNumberOfSegments())]
        names = [segmentation.GetSegment(i).GetName() for i in ids]
        selector = self.ui.segmentSelector
        with quiet(selector):
            if [selector.itemText(i) for i in range(selector.count)] != names:
                selector.clear()
                selector.addItems(names)
            selector.currentIndex = ids.index(p.vesselsSegmentId) if p.vesselsSegmentId in ids else -1

    def on_vessels(self, node) -> None:
        p = self.parameters
        if not changed(p, "vesselsNode", node):
            return
        if node is not None and node.IsA("vtkMRMLSegmentationNode"):
            segmentation = node.GetSegmentation()
            ids = [segmentation.GetNthSegmentID(i) for i in range(segmentation.GetNumberOfSegments())]
            named = [i for i in ids if "vessel" in segmentation.GetSegment(i).GetName().lower()]
            # Of the segmentation before, maybe: Slicer calls the segments of each Segment_1, Segment_2.
            kept = [i for i in ids if i == p.vesselsSegmentId]
            changed(p, "vesselsSegmentId", (named or kept or ids or [""])[0])

    def on_segment(self, index: int) -> None:
        p = self.parameters
        node = p.vesselsNode if p else None
        if node is not None and node.IsA("vtkMRMLSegmentationNode") and index >= 0:
            changed(p, "vesselsSegmentId", node.GetSegmentation().GetNthSegmentID(index))

    def on_mri(self, node) -> None:
        if node is not None and self.parameters is not None and not self.panel.loading:
            self._showing.start(shown_in_slices(node))

    def show_scan(self) -> None:
        self._showing.start(self.showing_scan())

    def showing_scan(self, before=None) -> Iterator[None]:
        """Show the MRI of a case that was opened, a view at each step, or at least not `before`, another case's."""
        if self.parameters.mriVolume:
            yield from shown_in_slices(self.parameters.mriVolume, fit=True)
        elif before is not None:
            yield from shown_in_slices(None, instead_of=before)

    def on_new(self, folder: str = "") -> None:
        """Choose where the case will be; it is written when it is saved."""
        if not folder:
            start = str(Path(self.parameters.casePath).parent) if self.parameters.casePath else str(Path.home())
            folder = qt.QFileDialog.getSaveFileName(
                slicer.util.mainWindow(), _("Folder of the new case"), str(Path(start) / _("New case"))
            )
        if folder:
            self.panel.open_folder(folder)

    def on_open(self, folder: str = "") -> None:
        if not folder:
            start = str(Path(self.parameters.casePath).parent) if self.parameters.casePath else str(Path.home())
            folder = qt.QFileDialog.getExistingDirectory(slicer.util.mainWindow(), _("Open a case"), start)
        if not folder:
            return
        if not (Path(folder) / MANIFEST_NAME).is_file():
            slicer.util.errorDisplay(
                _(
                    "{folder} is not the folder of a case: it holds no {name}. Choose another, or make one with New."
                ).format(folder=folder, name=MANIFEST_NAME)
            )
            return
        self.panel.open_folder(folder, take_over=True)

    def save(self) -> None:
        """Write the case, in a process of its own. A case that is there already is kept under another name."""
        p = self.parameters
        if self._saved():
            self._keep_scan()
            return
        problems = self.session.problems_of_new_case(p, p.casePath)
        if problems:
            self._tell(problems)
            return
        folder = Path(p.casePath)
        if (folder / MANIFEST_NAME).is_file() and not slicer.util.confirmOkCancelDisplay(
            _(
                "Models or microscope differ from those of the saved case, so all that was made from it has to be made "
                "again.\n\nThe case is saved anew; the old one is kept beside it, as {name}."
            ).format(name=_kept_name(folder).name)
        ):
            return
        exported = Path(tempfile.mkdtemp(prefix="expected-appearances-"))
        try:
            options = self.session.export_inputs(p, exported)
        except InputError as error:
            shutil.rmtree(exported, ignore_errors=True)
            self._tell(error.problems)
            return
        # Made beside the old case and put in its place when it is whole.
        made = folder
        if (folder / MANIFEST_NAME).is_file():
            made = folder.with_name(f".{folder.name}.new")
            shutil.rmtree(made, ignore_errors=True)
        command, environment = library_command("ExpectedAppearancesLib", "new", str(made), *options)

        def done(code: int, output: str) -> None:
            self._saving = None
            shutil.rmtree(exported, ignore_errors=True)
            for name, title in EXPORTED.items():  # the user knows the nodes, not the files in between
                output = output.replace(str(exported / name), _(title))
            if code:
                self._tell(problems_in(output))
            else:
                self._put_in_place(made, folder)
            self.panel.refresh_soon()

        self._saving = Child(command, done, environment)
        self.panel.refresh_soon()

    @property
    def saving(self) -> bool:
        return self._saving is not None or self._keeping.working

    def _put_in_place(self, made: Path, folder: Path) -> None:
        problems = []
        try:
            if made != folder:
                refuse_if_occupied(folder)  # what goes on there would write into the new case
                if (folder / OWN_TEXTURES).is_dir():
                    shutil.copytree(folder / OWN_TEXTURES, made / OWN_TEXTURES)
                kept = _kept_name(folder)
                folder.rename(kept)
                try:
                    made.rename(folder)
                except OSError:
                    kept.rename(folder)
                    raise
        except InputError as error:
            problems = error.problems
        except OSError as error:
            text = _("{folder}: could not be replaced ({error}); close what uses it, and save again.")
            problems = [text.format(folder=folder, error=error)]
        if problems:
            shutil.rmtree(made, ignore_errors=True)
            self._tell(problems)
            return
        if Path(self.parameters.casePath) == folder:  # else another case was opened meanwhile
            self.panel.open_folder(str(folder))
            self._keep_scan()

    def _keep_scan(self) -> None:
        """Add the chosen MRI to the case, where it is not in it."""
        self._keeping.start(self._keep_in_pieces())
        self.panel.refresh_soon()

    def _keep_in_pieces(self) -> Iterator[None]:
        p = self.parameters
        try:
            identity = self.session.scan_to_keep(p)
            if identity is not None:
                yield from keeping_scan(self.session.case(p), p.mriVolume, identity)
        except InputError as error:
            self._tell(error.problems)
        self.panel.refresh_soon()

    def _tell(self, problems: list[str]) -> None:
        slicer.util.errorDisplay(
            _("The case is not saved yet:") + "\n\n" + "\n\n".join(problems), windowTitle=_("Case")
        )


class MicroscopeSection(Section):
    name = "microscope"
    title = "Microscope"

    def setup(self) -> None:
        # Its own signal is not sent for a path that is emptied, nor for another kind of file than it asks for.
        self.ui.calibrationPathEdit.findChild("QLineEdit").connect("textChanged(QString)", self.on_path)

    def refresh(self) -> None:
        p = self.parameters
        from_file = p.cameraSource.value == "file"
        self.ui.calibrationRow.visible = from_file
        self.ui.viewRow.visible = not from_file
        if self.ui.calibrationPathEdit.currentPath != p.calibrationPath:
            self.ui.calibrationPathEdit.currentPath = p.calibrationPath
        try:
            camera = self.session.camera(p)
        except InputError:
            self.ui.microscopeSummary.visible = False
            return
        at_mm = p.viewedAtMm if not from_file else 300.0
        lens = _(", lens distortion corrected") if camera.is_distorted else ""
        self.ui.microscopeSummary.text = _(
            "{width} × {height} px; sees {wide:.0f} × {high:.0f} mm at {at:.0f} mm{lens}"
        ).format(
            width=camera.width,
            height=camera.height,
            wide=at_mm * camera.width / camera.fx,
            high=at_mm * camera.height / camera.fy,
            at=at_mm,
            lens=lens,
        )
        self.ui.microscopeSummary.visible = True

    def on_path(self, _path=None) -> None:
        changed(self.parameters, "calibrationPath", self.ui.calibrationPathEdit.currentPath)


def shown_in_slices(volume, fit: bool = False, instead_of=None) -> Iterator[None]:
    """Show a volume, or none, behind all slice views, one at each step: Slicer takes a tenth of a second for each.

    instead_of: only where this one is shown."""
    manager = slicer.app.layoutManager()
    for name in manager.sliceViewNames() if manager else ():
        if volume is not None and volume.GetScene() is None:  # removed meanwhile
            return
        widget = manager.sliceWidget(name)
        composite = widget.mrmlSliceCompositeNode()
        if instead_of is None or composite.GetBackgroundVolumeID() == instead_of.GetID():
            composite.SetBackgroundVolumeID(volume.GetID() if volume is not None else None)
        yield
        if fit:
            widget.sliceController().fitSliceToBackground()
            yield


def _kept_name(folder: Path) -> Path:
    name = f"{folder.name} until {time.strftime('%Y-%m-%d %H.%M')}"
    names = itertools.chain([name], (f"{name} ({number})" for number in itertools.count(2)))
    return next(kept for kept in map(folder.with_name, names) if not kept.exists())
