import json
import os
import shutil
import subprocess
import sys
import time
from collections import Counter

import numpy as np
import pytest
from cases import dome, texture, write_inputs

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.appearances import claims, store
from ExpectedAppearancesLib.appearances.claims import ClaimLost, Claims
from ExpectedAppearancesLib.appearances.stage import synthesize_case
from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.case.meshes import Mesh, write_vtp
from ExpectedAppearancesLib.cli import main
from ExpectedAppearancesLib.errors import CancelledError, InputError
from ExpectedAppearancesLib.geometry.camera import Camera, write_camera
from ExpectedAppearancesLib.masks.renderer import MaskRenderer
from ExpectedAppearancesLib.masks.stage import read_rendered, render_case
from ExpectedAppearancesLib.poses.craniotomy import find_craniotomy
from ExpectedAppearancesLib.textures.library import list_textures, shipped_textures_folder


def records(folder) -> list[str]:
    """Every image that was finished, as often as it was."""
    lines = [line for path in folder.glob("finished/*.jsonl") for line in path.read_text().splitlines() if line]
    return [json.loads(line)["image"] for line in lines]


@pytest.fixture
def case(tmp_path):
    paths = write_inputs(tmp_path)
    case = Case.create(tmp_path / "case", paths["vessels.vtp"], paths["cortex.vtp"], paths["camera.json"])
    render_case(case, lambda *_: None, poses=3)
    return case


@pytest.mark.parametrize("method", ["surface", "image"])
def test_a_killed_synthesis_goes_on_and_ends_as_if_it_had_not_been(case, method):
    textures = [texture("a"), texture("b", (200, 180, 40))]

    def cancel_in_second(fraction, _message):
        if fraction > 0.6:
            raise CancelledError("stop")

    with pytest.raises(CancelledError):  # one by one; together afterwards, which must not matter
        synthesize_case(case, textures, cancel_in_second, method, size_px=48, iterations=4, batch=1)
    with pytest.raises(InputError, match="not finished"):
        store.read_appearances(case, method)
    folder = store.folder_of(case, method)
    kept = {p.name: p.stat().st_mtime_ns for p in folder.glob("*.png") if "labels" not in p.name}
    assert kept
    synthesize_case(case, textures, lambda *_: None, method, size_px=48, iterations=4)
    _, resumed = store.read_appearances(case, method)
    assert len(resumed) == (2 if method == "surface" else 3)
    for name, stamp in kept.items():
        assert (folder / name).stat().st_mtime_ns == stamp
    images = {a.image_path.name: files.read_image_rgb(a.image_path) for a in resumed}
    for path in (*folder.glob("finished/*"), folder / "index.json"):
        path.unlink()
    synthesize_case(case, textures, lambda *_: None, method, size_px=48, iterations=4)
    for appearance in store.read_appearances(case, method)[1]:
        np.testing.assert_array_equal(files.read_image_rgb(appearance.image_path), images[appearance.image_path.name])


def test_a_changed_texture_or_axis_is_not_passed_over(case):
    def made(textures):
        synthesize_case(case, textures, lambda *_: None, "surface", size_px=32, iterations=1)
        return {a.style: a.image_path.stat().st_mtime_ns for a in store.read_appearances(case, "surface")[1]}

    first = made([texture("a"), texture("b")])
    assert made([texture("a"), texture("b")]) == first
    second = made([texture("a"), texture("b", (10, 200, 10))])
    assert second["a"] == first["a"] and second["b"] != first["b"]
    render_case(case, lambda *_: None, 3, craniotomy=find_craniotomy(case.vessels, normal=[0.3, 0, 1]))
    third = made([texture("a"), texture("b", (10, 200, 10))])
    assert third["a"] != second["a"] and third["b"] != second["b"]


def test_label_maps_of_an_interrupted_drawing_are_not_taken_for_the_views_of_the_poses_before(case):
    def cancel_in_last(fraction, _message):
        if fraction > 0.9:
            raise CancelledError("stop")

    with pytest.raises(CancelledError):
        render_case(case, cancel_in_last, poses=4, seed=1)
    assert len(list(case.masks_folder.glob("*.png"))) == 4
    with pytest.raises(InputError, match="run `render`"):
        synthesize_case(case, [texture("a")], lambda *_: None, "image", size_px=32, iterations=1)
    render_case(case, lambda *_: None, poses=4, seed=1)
    assert len(read_rendered(case)) == 4


def test_a_label_map_that_a_loss_of_power_left_empty_is_drawn_again(case):
    """The very command that it was made by said that all were there."""
    lost = case.masks_folder / "00002.png"
    whole = lost.read_bytes()
    for left in (b"", whole[: len(whole) // 2]):
        lost.write_bytes(left)
        render_case(case, lambda *_: None, poses=3)
        assert lost.read_bytes() == whole


def test_vessels_that_the_cortex_hides_in_all_views_are_told_before_hours_of_work(tmp_path):
    """As those of a scan below the surface of the dura or the head."""
    paths = write_inputs(tmp_path)
    above = dome()
    write_vtp(paths["cortex.vtp"], Mesh(above.vertices_mm + np.array([0, 0, 4.0]), above.triangles))
    case = Case.create(tmp_path / "case", paths["vessels.vtp"], paths["cortex.vtp"], paths["camera.json"])
    with pytest.raises(InputError, match="none of the label maps shows a vessel"):
        render_case(case, lambda *_: None, poses=2)
    with pytest.raises(InputError, match="run `render`"):
        read_rendered(case)
    with pytest.raises(InputError, match="circular field: 33"):  # percent left no circle, and 0 blamed the cortex
        render_case(case, lambda *_: None, poses=2, circular_field=33)


def test_appearances_smaller_than_the_frames_show_what_a_camera_of_their_size_sees(tmp_path):
    """Label maps of a microscope's frames, made small a whole half pixel aside, would teach poses that are off."""
    paths = write_inputs(tmp_path)
    write_camera(paths["camera.json"], Camera(640, 360, 960.0, 960.0, 330.0, 170.0))
    case = Case.create(tmp_path / "case", paths["vessels.vtp"], paths["cortex.vtp"], paths["camera.json"])
    render_case(case, lambda *_: None, poses=3)
    synthesize_case(case, [texture("a")], lambda *_: None, "image", size_px=72, iterations=1)
    _, appearances = store.read_appearances(case, "image")
    with MaskRenderer(case.vessels, case.cortex, appearances[0].camera) as renderer:
        for appearance in appearances:
            seen = renderer.render(appearance.camera_from_world)
            assert (files.read_label_map(appearance.labels_path) != seen).mean() < 0.005


def test_paper_preset_makes_every_pose_with_every_texture(case):
    textures = [texture("a"), texture("b")]
    synthesize_case(case, textures, lambda *_: None, "image", size_px=32, iterations=1, every_texture=True)
    _, appearances = store.read_appearances(case, "image")
    assert len(appearances) == 6 and {a.style for a in appearances} == {"a", "b"}


def test_a_synthesis_killed_by_the_system_loses_no_finished_image(case, tmp_path):
    for name in "abcdef":
        files.write_png(tmp_path / "textures" / f"{name}.png", texture(name, size=96).image)
    files.write_png(tmp_path / "textures" / "labels.png", texture(size=96).labels)
    arguments = [str(case.folder), "--textures", str(tmp_path / "textures"), "--size", "48", "--iterations", "8"]
    process = subprocess.Popen([sys.executable, "-m", "ExpectedAppearancesLib", "synthesize", *arguments])
    folder = store.folder_of(case, "surface")
    deadline = time.monotonic() + 120
    while not (folder / "b-0.png").is_file() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.kill()
    process.wait()
    kept = set(records(folder))
    assert kept and not store.read_index(case, "surface")["done"]
    stamps = {name: (folder / name).stat().st_mtime_ns for name in kept}
    assert main(["synthesize", *arguments]) == 0
    assert len(store.read_appearances(case, "surface")[1]) == 6
    assert {name: (folder / name).stat().st_mtime_ns for name in kept} == stamps


def test_what_a_kill_left_half_written_is_made_again(case):
    textures = [texture("a"), texture("b")]
    synthesize_case(case, textures, lambda *_: None, "surface", size_px=32, iterations=1)
    folder = store.folder_of(case, "surface")
    whole = {name: (folder / name).read_bytes() for name in ("a-0.png", "b-0.png")}
    record = folder / "finished" / "a-00000.jsonl"
    record.write_bytes(record.read_bytes()[:-20])
    (folder / "b-0.png").write_bytes(whole["b-0.png"][:-9])
    synthesize_case(case, textures, lambda *_: None, "surface", size_px=32, iterations=1)
    assert {name: (folder / name).read_bytes() for name in whole} == whole
    _, appearances = store.read_appearances(case, "surface")
    assert {a.style for a in appearances} == {"a", "b"}


def test_gram_distance_is_in_the_index_the_sheet_and_the_output(case, tmp_path, capsys):
    files.write_png(tmp_path / "textures" / "a.png", texture(size=96).image)
    files.write_png(tmp_path / "textures" / "labels.png", texture(size=96).labels)
    arguments = [str(case.folder), "--textures", str(tmp_path / "textures"), "--size", "48", "--iterations", "2"]
    assert main(["synthesize", *arguments]) == 0
    assert Case.open(case.folder).manifest["stages"]["synthesize"]["textures_folder"] == str(tmp_path / "textures")
    (item,) = store.read_index(case, "surface")["items"]
    assert set(item["gram_distance_by_class"]) == {"parenchyma", "vessels"}
    assert item["gram_distance"] == pytest.approx(sum(item["gram_distance_by_class"].values()), abs=2e-4)
    assert f"parenchyma {item['gram_distance_by_class']['parenchyma']:.3f}" in capsys.readouterr().out
    sheet = files.read_image_rgb(store.folder_of(case, "surface") / "contact_sheet.png")
    assert (sheet[:22] < 128).any() and (sheet[22:44, :400] < 128).any()  # the lines with the figures


def test_the_shipped_textures_are_not_taken_for_a_folder_of_the_users_own(case):
    """The panel names them as any other folder; opened again, it would add photographs to them, and remove some."""
    shipped = shipped_textures_folder()
    named = ["--textures", str(shipped), "--exclude", *list(list_textures(shipped))[1:]]
    assert main(["synthesize", str(case.folder), *named, "--size", "32", "--iterations", "1"]) == 0
    assert Case.open(case.folder).manifest["stages"]["synthesize"]["textures_folder"] == ""


def test_a_claim_has_one_holder_until_it_is_released(tmp_path):
    first = Claims(tmp_path).take("a-00000")
    assert first and Claims(tmp_path).take("a-00000") is None
    assert Claims(tmp_path).take("a-00001") is not None
    first.check()
    first.release()
    assert Claims(tmp_path).take("a-00000") is not None


def test_a_claim_of_a_dead_process_is_taken_over_once(tmp_path):
    script = (
        "import os, sys; from ExpectedAppearancesLib.appearances.claims import Claims; "
        "assert Claims(sys.argv[1]).take('a'); print('held', flush=True); sys.stdin.read()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", script, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout.readline().strip() == b"held"
    assert Claims(tmp_path).take("a") is None
    process.kill()
    process.wait()
    process.stdin.close()
    process.stdout.close()
    heirs = [Claims(tmp_path).take("a") for _ in range(3)]
    assert [heir is not None for heir in heirs] == [True, False, False]


def test_the_copy_of_a_folder_is_not_held_by_who_works_on_the_original(tmp_path):
    """Copied while a synthesis went on, a case could not be worked on until that had ended, without a word."""
    original = tmp_path / "original"
    assert Claims(original).take("a")
    shutil.copytree(original, tmp_path / "copy")
    assert Claims(tmp_path / "copy").take("a") and Claims(original).take("a") is None
    original.rename(tmp_path / "moved")
    assert Claims(tmp_path / "moved").take("a") is None


def test_a_silent_holder_on_another_machine_is_given_up_and_told_so(tmp_path, monkeypatch):
    monkeypatch.setattr(claims, "_own_identity", lambda: {"machine": "other", "pid": 1, "started": 0.0})
    holder = Claims(tmp_path).take("a")
    monkeypatch.undo()
    here = Claims(tmp_path)
    assert here.take("a") is None
    clock = time.monotonic() + claims.STALE_S - 1
    monkeypatch.setattr(claims.time, "monotonic", lambda: clock)
    assert here.take("a") is None
    os.utime(tmp_path / "a.0.json", ns=(1, 1))  # a sign of life, whatever its clock says
    clock += 10
    assert here.take("a") is None
    clock += claims.STALE_S + 1
    heir = here.take("a")
    assert heir is not None
    with pytest.raises(ClaimLost, match="taken over"):
        holder.keep()
    here.withdraw("a")
    with pytest.raises(ClaimLost, match="cancelled"):
        heir.check()


def test_two_runs_on_one_case_share_the_work(case, tmp_path):
    for name in "abcd":
        files.write_png(tmp_path / "textures" / f"{name}.png", texture(name, size=96).image)
    files.write_png(tmp_path / "textures" / "labels.png", texture(size=96).labels)
    arguments = [str(case.folder), "--textures", str(tmp_path / "textures"), "--size", "48", "--iterations", "6"]
    command = [sys.executable, "-m", "ExpectedAppearancesLib", "synthesize", *arguments]
    processes = [subprocess.Popen(command) for _ in range(2)]
    assert [process.wait(timeout=300) for process in processes] == [0, 0]
    folder = store.folder_of(case, "surface")
    assert Counter(records(folder)) == {f"{name}-0.png": 1 for name in "abcd"}
    assert len(store.read_appearances(case, "surface")[1]) == 4
    assert not list(folder.glob("claims/*"))
