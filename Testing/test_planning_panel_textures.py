"""The planning panel with stand-ins for Qt and Slicer: photographs, textures and appearances."""

from __future__ import annotations

from panels import in_the_panel


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

Path.unlink = planning_textures.copy_textures.__globals__["shutil"].copyfile = refused
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


def test_a_folder_that_may_not_be_looked_into_is_told(tmp_path):
    """Of a share, or guarded by macOS: the system's error came from every look at the textures, and nothing went on."""
    in_the_panel(
        """
import os
from pathlib import Path

def refused(*_):
    raise PermissionError(1, "Operation not permitted")

panel.parameters.texturesPath = sys.argv[2]
Path.iterdir = os.listdir = os.scandir = refused
panel.refresh()
step = panel.steps["textures"]
assert step.state.value == "missing" and "Operation not permitted" in step.text and sys.argv[2] in step.text, step
""",
        tmp_path,
    )


def test_the_textures_of_the_case_before_stay_as_they_are(tmp_path):
    """Chosen still after New: a photograph for the second patient went to the first one's, and Remove deleted those."""
    for patient in ("first", "second"):
        (tmp_path / patient).mkdir()
        (tmp_path / patient / "case.json").touch()
    own = tmp_path / "first" / "textures"
    own.mkdir()
    (own / "a.png").write_bytes(b"a")
    in_the_panel(
        """
from pathlib import Path
from ExpectedAppearancesLib.widgets import planning_labelling, planning_textures
planning_labelling.Child = MagicMock()
planning_textures.slicer.util = MagicMock()
first, second = (Path(sys.argv[2]) / name for name in ("first", "second"))
textures, p = panel.sections["textures"], panel.parameters
panel.ui.texturesList.selectedItems.return_value = [MagicMock(data=lambda role: "a")]
panel.session.case = lambda p: MagicMock(folder=Path(p.casePath))
panel.ui.removeTextureButton.enabled = True
for case, reason in ((first, ""), (second, "another case")):
    p.texturesPath, p.casePath = str(first / "textures"), str(case)
    textures.labelling._name = ""
    textures.refresh()
    assert panel.ui.removeTextureButton.enabled == (not reason), case
    assert reason in panel.ui.removeTextureButton.toolTip
    textures.on_add("/photographs/b.png")
    assert textures.labelling._textures == case / "textures", textures.labelling._textures
    assert p.texturesPath == str(case / "textures")
    assert (case / "textures" / "a.png").read_bytes() == b"a"
""",
        tmp_path,
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
