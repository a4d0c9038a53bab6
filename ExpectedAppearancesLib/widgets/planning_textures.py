"""Section Textures: photographs of cortex with their labels, seen, added, labelled and removed."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import qt
import slicer
from slicer.i18n import tr as _

from .. import files
from ..case.case import MANIFEST_NAME
from ..errors import InputError
from ..textures import thumbnails
from ..textures.library import (
    LABELS_SUFFIX,
    copy_textures,
    is_shipped,
    list_textures,
    shipped_textures_folder,
)
from .planning_case import OWN_TEXTURES
from .planning_labelling import Labelling
from .planning_qt import Child, allow, library_command
from .planning_section import Section, changed
from .refreshing import quiet

READING_MODULE = "ExpectedAppearancesLib.textures.thumbnails"


class TexturesSection(Section):
    name = "textures"
    title = "Textures"

    def setup(self) -> None:
        ui = self.ui
        self._child: Child | None = None
        self._pictures: dict[tuple, str] = {}  # version of a texture -> path of its thumbnail
        self._listed: list | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="expected-appearances-")
        self.labelling = Labelling(self.panel)
        ui.texturesList.setIconSize(qt.QSize(thumbnails.THUMBNAIL_PX, thumbnails.THUMBNAIL_PX))
        ui.texturesPathEdit.connect("currentPathChanged(QString)", self.on_path)
        ui.shippedButton.connect("clicked(bool)", lambda _checked=False: self.on_shipped())
        ui.addPhotographButton.connect("clicked(bool)", lambda _checked=False: self.on_add())
        ui.removeTextureButton.connect("clicked(bool)", lambda _checked=False: self.on_remove())
        ui.texturesList.connect("itemSelectionChanged()", self.panel.refresh_soon)
        self.button.connect("contentsCollapsed(bool)", lambda _collapsed: self.panel.refresh_soon())

    def refresh(self) -> None:
        p, ui = self.parameters, self.ui
        shipped = not p.texturesPath
        path = str(shipped_textures_folder()) if shipped else p.texturesPath
        if ui.texturesPathEdit.currentPath != path:
            with quiet(ui.texturesPathEdit):
                ui.texturesPathEdit.currentPath = path
        allow(
            ui.shippedButton, _("The shipped textures are chosen.") if shipped else "", _("Use the shipped textures.")
        )
        allow(ui.addPhotographButton, self.labelling.reason, _("Add a photograph of cortex and label its vessels."))
        reason = ""
        if shipped:
            reason = _("The shipped textures cannot be removed. Choose a folder of your own.")
        elif self._of_another_case():
            reason = _("These are the textures of another case. Open that one to remove any of them.")
        elif not ui.texturesList.selectedItems():
            reason = _("Click on a texture first.")
        allow(ui.removeTextureButton, reason, _("Delete the texture and its labels from the folder."))
        self.labelling.refresh()
        found = self.session.texture_files(p)
        versions = [version for version, *_rest in found.values()]
        # Opening the module must not load OpenCV: textures are read when they are looked at or compared with.
        wanted = not self.button.collapsed or self.panel.recorded.index is not None
        if wanted and versions != self._listed:
            self._listed = versions
            self._read(found)

    def leave(self) -> None:
        self._stop_reading()
        self._listed = None

    def close(self) -> None:
        self.leave()
        self.labelling.stop()

    def _read(self, found: dict) -> None:
        """List the textures once those that are new have been read, in a process of its own."""
        self._stop_reading()
        known = self.session
        new = [
            (name, image, labels)
            for name, (version, image, labels) in found.items()
            if version not in known.texture_digests and version not in known.texture_problems
        ]
        if not new:
            self._show(found)
            return
        folder = Path(tempfile.mkdtemp(dir=self._folder.name))
        thumbnails.ask_for(folder, new)
        command, environment = library_command(READING_MODULE, str(folder))

        def done(_code: int, _output: str) -> None:
            self._child = None
            made = thumbnails.answer(folder)
            for name, image, _labels in new:
                version, told = found[name][0], made.get(name)
                if told is None:  # without OpenCV: the pictures alone
                    known.texture_digests[version], self._pictures[version] = "", str(image)
                elif "problem" in told:
                    known.texture_problems[version] = told["problem"]
                else:
                    known.texture_digests[version], self._pictures[version] = told["sha256"], told["thumbnail"]
            self._show(found)

        self._child = Child(command, done, environment)

    def _stop_reading(self) -> None:
        if self._child is not None:
            self._child.stop()
            self._child = None

    def _show(self, found: dict) -> None:
        known = self.session
        self.ui.texturesList.clear()
        for name, (version, *_rest) in found.items():
            item = qt.QListWidgetItem(name)
            if version in self._pictures:
                item.setIcon(qt.QIcon(self._pictures[version]))
            if version in known.texture_problems:
                item.setToolTip(known.texture_problems[version])
                item.setText(f"{name} !")
            else:
                item.setToolTip(_("{name}: vessels outlined in green").format(name=name))
            item.setData(qt.Qt.UserRole, name)
            self.ui.texturesList.addItem(item)
        self.panel.refresh_soon()

    def on_path(self, _path=None) -> None:
        path = self.ui.texturesPathEdit.currentPath
        changed(self.parameters, "texturesPath", "" if not path or is_shipped(path) else path)

    def on_shipped(self) -> None:
        changed(self.parameters, "texturesPath", "")

    def on_add(self, path: str = "") -> None:
        """Choose a photograph; it is labelled in the Segment Editor, and then saved as NAME.png, NAME.labels.png."""
        if not path:
            path = qt.QFileDialog.getOpenFileName(
                slicer.util.mainWindow(),
                _("Photograph of cortex"),
                str(Path.home()),
                _("Images (*.png *.jpg *.jpeg *.tif *.tiff)"),
            )
        if not path or not self._own_folder():
            return
        folder = self.session.textures_folder(self.parameters)
        # Windows and macOS do not tell A from a; labels.png would be the label map of all textures that have none.
        taken = {name.lower() for name in list_textures(folder)} | {"labels"}
        name = stem = "".join(c if c.isalnum() or c in "-_" else "_" for c in Path(path).stem) or "photograph"
        number = 2
        while name.lower() in taken:
            name, number = f"{stem}-{number}", number + 1
        self.labelling.start(name, Path(path), folder)

    def _own_folder(self) -> bool:
        """A folder that photographs can be added to: the chosen one, else one in the case, with the textures that ship
        or that are another case's."""
        p = self.parameters
        if p.texturesPath and not self._of_another_case():
            writable = os.path.isdir(p.texturesPath) and os.access(p.texturesPath, os.W_OK)
            if not writable:  # told now, not after the labelling
                text = _("{folder}: you may not write into it. Choose a folder of your own, or the shipped textures.")
                slicer.util.errorDisplay(text.format(folder=p.texturesPath))
            return writable
        case = self.session.case(p)
        if case is None:
            slicer.util.errorDisplay(
                _("Choose a folder for your textures first, or save the case: then they go there.")
            )
            return False
        folder = case.folder / OWN_TEXTURES
        if not folder.is_dir():
            try:
                copy_textures(self.session.textures_folder(p), folder)
            except InputError as error:
                slicer.util.errorDisplay(str(error))
                return False
        changed(p, "texturesPath", str(folder))
        return True

    def _of_another_case(self) -> bool:
        """Whether the chosen textures lie in a case that is not the one that is open, as after New."""
        p = self.parameters
        case = os.path.dirname(os.path.realpath(p.texturesPath))
        return os.path.isfile(os.path.join(case, MANIFEST_NAME)) and case != os.path.realpath(p.casePath)

    def on_remove(self) -> None:
        folder = self.session.textures_folder(self.parameters)
        names = [item.data(qt.Qt.UserRole) for item in self.ui.texturesList.selectedItems()]
        listed = list_textures(folder)
        if (
            not names
            or not self.parameters.texturesPath
            or not slicer.util.confirmYesNoDisplay(
                _("Delete {names} with labels from {folder}?").format(names=", ".join(names), folder=folder)
            )
        ):
            return
        try:
            with files.writing(folder):
                for name in names:
                    image, _labels = listed.get(name, (None, None))
                    for path in (image, folder / f"{name}{LABELS_SUFFIX}"):
                        if path is not None:
                            path.unlink(missing_ok=True)
        except InputError as error:
            slicer.util.errorDisplay(str(error))
        self.panel.refresh_soon()
