"""Case folders: whole or absent, and honest about what they hold."""

from __future__ import annotations

import errno
import hashlib
import json
import os
from pathlib import Path

import numpy as np
import pytest

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.case.meshes import Mesh, declared_space, read_mesh, write_vtp
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.geometry.camera import Camera, write_camera

CAMERA = Camera(320, 240, 500.0, 430.0, 120.0, 140.0, (0.1, 0.0, 0.0, 0.0, 0.0))


def patch(size_mm=40.0, centre_mm=(60.0, 40.0, 50.0)) -> Mesh:
    """A curved square of 2 x 10 x 10 triangles."""
    grid = np.linspace(-0.5, 0.5, 11)
    x, y = np.meshgrid(grid, grid)
    vertices = np.stack([x, y, -(x**2 + y**2) / 4], axis=-1).reshape(-1, 3) * size_mm + centre_mm
    corner = (np.arange(10)[:, None] * 11 + np.arange(10)).ravel()
    triangles = np.concatenate([corner[:, None] + [0, 1, 11], corner[:, None] + [1, 12, 11]])
    return Mesh(vertices, triangles)


@pytest.fixture
def inputs(tmp_path) -> dict[str, Path]:
    folder = tmp_path / "Eingaben für Fall 1"
    paths = {name: folder / f"{name}.vtp" for name in ("vessels", "cortex")} | {"camera": folder / "camera.json"}
    write_vtp(paths["vessels"], patch(30.0))
    write_vtp(paths["cortex"], patch(60.0))
    write_camera(paths["camera"], CAMERA)
    return paths


def create(folder, inputs, **kwargs) -> Case:
    return Case.create(folder, inputs["vessels"], inputs["cortex"], inputs["camera"], **kwargs)


def everything_in(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*")}


def test_a_new_case_opens_with_what_went_in_even_after_it_moved(tmp_path, inputs):
    create(tmp_path / "Fall ä", inputs, space="RAS")
    assert everything_in(tmp_path / "Fall ä") == {"case.json", "camera.json", "vessels.vtp", "cortex.vtp"}
    (tmp_path / "Fall ä").rename(tmp_path / "moved")
    case = Case.open(tmp_path / "moved")
    assert case.space == "RAS" and case.camera == CAMERA
    assert declared_space(tmp_path / "moved" / "cortex.vtp") == "RAS"  # so that 3D Slicer loads it as RAS
    assert np.array_equal(case.vessels.vertices_mm, patch(30.0).vertices_mm)
    assert np.array_equal(case.cortex.triangles, patch(60.0).triangles)
    assert case.poses_path == tmp_path / "moved" / "poses" / "poses.json"
    entry = case.manifest["inputs"]["vessels"]
    assert entry["sha256"] == hashlib.sha256((tmp_path / "moved" / entry["file"]).read_bytes()).hexdigest()
    assert case.manifest["versions"]["numpy"] == np.__version__


def test_a_case_without_cortex_and_with_a_camera_from_the_field_of_view(tmp_path, inputs):
    camera = Camera.from_field_of_view(640, 480, 60.0, 300.0)
    (tmp_path / "case").mkdir()  # empty: allowed
    Case.create(tmp_path / "case", inputs["vessels"], None, camera)
    case = Case.open(tmp_path / "case")
    assert case.cortex is None and case.space == "LPS"
    assert case.camera.without_distortion() == camera


def test_an_empty_folder_is_filled_and_not_replaced(tmp_path, inputs, monkeypatch):
    """`new .` left the shell in a folder that was no more, and a link to another disk could not be taken."""
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / ".4711.part").mkdir()  # of a run that was killed
    (tmp_path / "link").symlink_to(tmp_path / "here", target_is_directory=True)
    monkeypatch.chdir(tmp_path / "here")
    same = os.stat(".").st_ino
    allowed = os.access  # one may own a folder in another that is the administrator's
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path and allowed(path, mode))
    create(tmp_path / "link", inputs)
    assert Case.open(Path(".")).folder == tmp_path / "here" and os.stat(tmp_path / "here").st_ino == same
    assert set(os.listdir(".")) == {"vessels.vtp", "cortex.vtp", "camera.json", "case.json", ".4711.part"}


def test_each_file_that_may_not_be_read_is_a_problem_of_its_own(tmp_path, inputs, monkeypatch):
    """Of many frames or meshes only the first was named, with the advice to free some space."""
    import cv2  # noqa: F401 - from the disk, too, which is refused below

    def refused(*_arguments, **_named):
        raise PermissionError(errno.EACCES, "Permission denied")

    create(tmp_path / "case", inputs)
    with pytest.raises(InputError) as caught:
        Case.open(tmp_path / "case", refused)
    assert len(caught.value.problems) == 3
    monkeypatch.setattr(Path, "read_bytes", refused)
    monkeypatch.setattr("builtins.open", refused)
    for read in (files.read_image_rgb, files.read_label_map, lambda path: read_mesh(path, "mesh")):
        with pytest.raises(InputError, match=r"vessels\.vtp: cannot be read \(Permission denied\)"):
            read(inputs["vessels"])


def test_record_merges_and_keeps_what_others_recorded(tmp_path, inputs):
    first = create(tmp_path / "case", inputs)
    second = Case.open(tmp_path / "case")
    first.record("render", seed=3, poses=100)
    second.record("train", seed=4)
    second.record("render", poses=200)
    stages = Case.open(tmp_path / "case").manifest["stages"]
    assert (stages["render"]["seed"], stages["render"]["poses"], stages["train"]["seed"]) == (3, 200, 4)


def test_all_problems_at_once_and_nothing_written(tmp_path, inputs):
    write_vtp(inputs["cortex"], patch(0.03, (0, 0, 0)))
    inputs["camera"].write_text(json.dumps(CAMERA.to_dict() | {"cx": 900}), encoding="utf-8")
    before = everything_in(tmp_path)
    with pytest.raises(InputError) as caught:
        Case.create(tmp_path / "case", tmp_path / "none.vtp", inputs["cortex"], inputs["camera"], "XYZ")
    text = "\n".join(caught.value.problems)
    assert len(caught.value.problems) == 4
    assert all(words in text for words in ("none.vtp: vessel mesh not found", "metres", "principal point", "'XYZ'"))
    assert everything_in(tmp_path) == before


def test_a_folder_with_content_is_left_alone(tmp_path, inputs):
    (tmp_path / "case").mkdir()
    (tmp_path / "case" / "thesis.txt").write_text("years of work", encoding="utf-8")
    with pytest.raises(InputError, match="not empty"):
        create(tmp_path / "case", inputs)
    assert everything_in(tmp_path / "case") == {"thesis.txt"}
    with pytest.raises(InputError, match="is a file"):
        create(inputs["camera"], inputs)


@pytest.mark.parametrize(
    ("centre_mm", "words"), [((-60.0, -40.0, 50.0), "LPS and the other"), ((60.0, 40.0, 250.0), "same patient")]
)
def test_cortex_far_from_vessels(tmp_path, inputs, centre_mm, words):
    write_vtp(inputs["cortex"], patch(60.0, centre_mm))
    with pytest.raises(InputError, match=words):
        create(tmp_path / "case", inputs)


def test_vessels_that_could_never_be_in_view(tmp_path, inputs):
    narrow = Camera.from_field_of_view(640, 480, 4.0, 300.0)
    with pytest.raises(InputError, match=r"vessels\.vtp: the vessels \(43 mm across\) could never be in view"):
        Case.create(tmp_path / "case", inputs["vessels"], None, narrow)


def test_space_that_contradicts_the_header(tmp_path, inputs):
    text = inputs["vessels"].read_text(encoding="ascii")
    inputs["vessels"].write_text(text.replace(">", ">\n<!-- 3D Slicer output. SPACE=RAS -->", 1), encoding="ascii")
    with pytest.raises(InputError, match="give --space RAS"):
        create(tmp_path / "case", inputs, space="LPS")
    create(tmp_path / "case", inputs, space="RAS")


@pytest.mark.parametrize("full_at", ["vessels.vtp", "camera.json", "case.json"])
def test_full_disk_leaves_nothing_behind(tmp_path, inputs, monkeypatch, full_at):
    write_bytes = Path.write_bytes

    def fill_up(path, data):
        if Path(full_at).stem in path.name:
            write_bytes(path, data[: len(data) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        return write_bytes(path, data)

    before = everything_in(tmp_path)
    monkeypatch.setattr(Path, "write_bytes", fill_up)
    with pytest.raises(InputError, match="No space left") as caught:
        create(tmp_path / "case", inputs)
    assert str(tmp_path / "case" / full_at) in str(caught.value)
    assert everything_in(tmp_path) == before


def test_a_disk_that_is_nearly_full_is_refused_beforehand(tmp_path, inputs, monkeypatch):
    monkeypatch.setattr(files.shutil, "disk_usage", lambda _folder: _Usage)
    with pytest.raises(InputError, match="3 MB free"):
        create(tmp_path / "case", inputs)


class _Usage:
    free = 3 * 2**20


def test_a_folder_that_cannot_be_written(tmp_path, inputs, monkeypatch):
    """Simulated: whoever runs tests as root may write everywhere."""
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    with pytest.raises(InputError, match="nothing can be written here"):
        create(tmp_path / "case", inputs)


def test_a_drive_that_is_not_there_is_refused(tmp_path, inputs, monkeypatch):
    """On Windows even the root of a path may be missing, such as that of a drive that was pulled out."""
    looked = []
    monkeypatch.setattr(Path, "is_dir", lambda path: False)

    def is_missing(path):
        looked.append(path)
        assert len(looked) < 100, "looks for ever"
        return False

    monkeypatch.setattr(Path, "exists", is_missing)
    with pytest.raises(InputError, match="nothing can be written here"):
        create(tmp_path / "case", inputs)


def test_a_file_is_on_the_disk_before_it_takes_the_place_of_the_one_before(tmp_path, monkeypatch):
    """XFS and NTFS write names before contents: a loss of power left an empty case.json."""
    done, fsync, replace = [], os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda number: (done.append(os.fstat(number).st_ino), fsync(number)))
    monkeypatch.setattr(os, "replace", lambda a, b: (done.append(("renamed", os.stat(a).st_ino)), replace(a, b)))
    files.write_json(tmp_path / "a.json", {})
    inode = (tmp_path / "a.json").stat().st_ino
    assert done == [inode, ("renamed", inode)]


def test_a_file_that_somebody_reads_is_replaced_when_he_has_done(tmp_path, monkeypatch):
    """Windows takes no file away from who reads it: a training ended where the panel looked at its checkpoint."""
    path, replace, times = tmp_path / "a.json", os.replace, iter([1, 1, 0])
    path.write_text("old")

    def read_by_another(source, target):
        if next(times, 1):
            raise PermissionError(errno.EACCES, "Access is denied")
        replace(source, target)

    monkeypatch.setattr(files.os, "replace", read_by_another)
    files.write_json(path, {"new": 1})
    assert json.loads(path.read_text()) == {"new": 1} and [p.name for p in tmp_path.iterdir()] == ["a.json"]
    monkeypatch.setattr(files, "READERS_TAKE_S", 0.05)
    with pytest.raises(InputError, match=r"a\.json: cannot be written \(Access is denied\)"):
        files.write_json(path, {"new": 2})
    assert json.loads(path.read_text()) == {"new": 1}


def test_record_on_a_full_disk_keeps_the_manifest(tmp_path, inputs, monkeypatch):
    case = create(tmp_path / "case", inputs)
    before = (tmp_path / "case" / "case.json").read_bytes()

    def no_space(_path, _data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", no_space)
    with pytest.raises(InputError, match=r"case\.json"):
        case.record("render", seed=1)
    assert (tmp_path / "case" / "case.json").read_bytes() == before


def changed_manifest(folder: Path, **values) -> None:
    manifest = json.loads((folder / "case.json").read_text(encoding="utf-8")) | values
    (folder / "case.json").write_text(json.dumps(manifest), encoding="utf-8")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"format_version": 2}, "format version 2, newer than 1"),
        ({"format_version": "1"}, "newer"),
        ({"format": "something else"}, "not the manifest of a case"),
        ({"inputs": {}}, "lacks its space, inputs or stages"),
        ({"space": "RSA"}, "lacks its space"),
        ({"inputs": {"vessels": 1, "camera": 2}}, "lacks"),
    ],
)
def test_manifests_that_cannot_be_used(tmp_path, inputs, values, words):
    create(tmp_path / "case", inputs)
    changed_manifest(tmp_path / "case", **values)
    with pytest.raises(InputError, match=words) as caught:
        Case.open(tmp_path / "case")
    assert "case.json" in str(caught.value)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.95])
def test_truncated_manifest(tmp_path, inputs, share):
    create(tmp_path / "case", inputs)
    path = tmp_path / "case" / "case.json"
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    with pytest.raises(InputError, match=r"case\.json"):
        Case.open(tmp_path / "case")


def test_inputs_that_changed_or_vanished_are_all_named(tmp_path, inputs):
    create(tmp_path / "case", inputs)
    write_vtp(tmp_path / "case" / "vessels.vtp", patch(31.0))
    (tmp_path / "case" / "cortex.vtp").unlink()
    with pytest.raises(InputError) as caught:
        Case.open(tmp_path / "case")
    assert len(caught.value.problems) == 2
    assert "vessels.vtp" in str(caught.value) and "SHA-256" in str(caught.value)
    assert "cortex.vtp" in str(caught.value) and "missing" in str(caught.value)


def test_a_folder_that_is_no_case(tmp_path):
    with pytest.raises(InputError, match="make one with `new`"):
        Case.open(tmp_path)
