"""The texture library: what it reads, what it refuses, and the textures that ship."""

from __future__ import annotations

import errno
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.interpreter import library_environment
from ExpectedAppearancesLib.masks.labels import VESSELS
from ExpectedAppearancesLib.textures import generate, thumbnails
from ExpectedAppearancesLib.textures.library import (
    Texture,
    copy_textures,
    list_textures,
    read_library,
    read_texture,
    shipped_textures_folder,
)

CORTEX_TEXTURES = Path(__file__).parents[2] / "shared/data/cortex/textures"


def photo(value: int = 100, size: int = 64) -> np.ndarray:
    image = np.full((size, size, 3), value, np.uint8)
    image[..., 0] = 200  # red differs from blue, so swapped channels are seen
    return image


def label_map(size: int = 64) -> np.ndarray:
    labels = np.ones((size, size), np.uint8)
    labels[:, size // 2 :] = 2
    return labels


def add(folder: Path, name: str, image=None, labels=None) -> None:
    files.write_png(folder / f"{name}.png", photo() if image is None else image)
    files.write_png(folder / f"{name}.labels.png", label_map() if labels is None else labels)


def test_reads_image_and_labels_of_each(tmp_path):
    add(tmp_path, "b10")
    add(tmp_path, "b9", labels=np.fliplr(label_map()))
    textures = read_library(tmp_path)
    assert [t.name for t in textures] == ["b9", "b10"]
    assert textures[1].image[0, 0].tolist() == [200, 100, 100]
    np.testing.assert_array_equal(textures[0].labels, np.fliplr(label_map()))
    np.testing.assert_array_equal(textures[1].labels, label_map())


def test_one_label_map_serves_all_but_an_own_one_wins(tmp_path):
    files.write_png(tmp_path / "labels.png", label_map())
    files.write_png(tmp_path / "shared.png", photo())
    add(tmp_path, "own", labels=label_map().T)
    own, shared = read_library(tmp_path)
    np.testing.assert_array_equal(shared.labels, label_map())
    np.testing.assert_array_equal(own.labels, label_map().T)


def test_excluded_textures_are_left_out_and_not_even_checked(tmp_path):
    add(tmp_path, "good")
    files.write_png(tmp_path / "bad.png", photo())
    assert [t.name for t in read_library(tmp_path, exclude=["bad"])] == ["good"]


def test_reports_all_problems_at_once_with_the_file_of_each(tmp_path):
    few = np.ones((64, 64), np.uint8)
    few[:10, :10] = 2  # 100 px of vessels
    foreign = label_map()
    foreign[0, 0] = 7
    files.write_png(tmp_path / "nolabels.png", photo())
    add(tmp_path, "size", labels=label_map(32))
    add(tmp_path, "few", labels=few)
    add(tmp_path, "foreign", labels=foreign)
    files.write_png(tmp_path / "deep.png", photo())
    cv2.imwrite(str(tmp_path / "deep.labels.png"), label_map().astype(np.uint16) * 256)
    add(tmp_path, "damaged")
    (tmp_path / "damaged.png").write_bytes((tmp_path / "damaged.png").read_bytes()[:20])
    with pytest.raises(InputError) as error:
        read_library(tmp_path, exclude=["nosuch"])
    expected = {
        "nosuch": "cannot be excluded",
        "nolabels.png": "no label map",
        "size.png": "64 x 64 px but",
        "few.labels.png": "only 100 px of vessels",
        "foreign.labels.png": "value(s) 7",
        "deep.labels.png": "holds the value 512",
        "damaged.png": "not an image",
    }
    assert len(error.value.problems) == len(expected)
    for name, text in expected.items():
        assert any(name in problem and text in problem for problem in error.value.problems), (
            name,
            error.value.problems,
        )


def test_a_bad_shared_label_map_is_reported_once(tmp_path):
    (tmp_path / "labels.png").write_bytes(b"not a png")
    for name in "abc":
        files.write_png(tmp_path / f"{name}.png", photo())
    with pytest.raises(InputError) as error:
        read_library(tmp_path)
    assert len(error.value.problems) == 1


@pytest.mark.parametrize("make", [lambda folder: folder / "missing", lambda folder: folder])
def test_refuses_missing_and_empty_folders(tmp_path, make):
    with pytest.raises(InputError, match=r"not found|holds no textures"):
        read_library(make(tmp_path))


def test_refuses_to_exclude_everything(tmp_path):
    add(tmp_path, "only")
    with pytest.raises(InputError, match="every texture is excluded"):
        read_library(tmp_path, exclude=["only"])


@pytest.mark.skipif(not CORTEX_TEXTURES.is_dir(), reason="the cortex data set is not on this machine")
def test_reads_the_textures_of_the_cortex_case():
    textures = read_library(CORTEX_TEXTURES)
    assert len(textures) == 11
    assert all(t.image.shape == (512, 512, 3) and t.labels.shape == (512, 512) for t in textures)


def test_shipped_textures_show_both_tissues_in_different_colours():
    textures = read_library(shipped_textures_folder())
    assert len(textures) >= 8
    parenchyma_rgb = []
    for texture in textures:
        assert texture.image.shape == (512, 512, 3)
        assert set(np.unique(texture.labels).tolist()) == {1, 2}
        assert 0.05 <= (texture.labels == VESSELS).mean() <= 0.25, texture.name
        means = [texture.image[texture.labels == label].mean(axis=0) for label in (1, 2)]
        assert np.linalg.norm(means[0] - means[1]) > 30, texture.name
        # Cortex is warm: swapped channels would make it blue.
        assert means[0][0] > means[0][2] + 10, texture.name
        parenchyma_rgb.append(means[0])
    distances = np.linalg.norm(np.array(parenchyma_rgb)[:, None] - parenchyma_rgb, axis=-1)
    assert distances[np.triu_indices(len(textures), 1)].min() > 8  # no two look alike


def test_a_shipped_texture_is_what_the_generator_makes():
    shipped = {texture.name: texture for texture in read_library(shipped_textures_folder())}
    assert set(shipped) == set(generate.PALETTES)
    made = generate.make_texture("dusk")
    # OpenCV builds round differently: single pixels may flip at the rims.
    assert (made.labels != shipped["dusk"].labels).mean() < 1e-4
    off = np.abs(made.image.astype(int) - shipped["dusk"].image).max(axis=-1)
    assert (off > 1).mean() < 1e-3


def test_another_seed_paints_other_veins():
    first, _ = generate.grow_veins(np.random.default_rng([0, 4]))
    other, _ = generate.grow_veins(np.random.default_rng([1, 4]))
    assert first.shape != other.shape or not np.allclose(first, other)


def test_generate_writes_each_palette_for_the_given_seed(tmp_path, monkeypatch):
    asked = []

    def make(name, seed):
        asked.append((name, seed))
        return Texture(name, photo(), label_map())

    monkeypatch.setattr(generate, "make_texture", make)
    generate.generate(tmp_path, seed=5)
    assert asked == [(name, 5) for name in sorted(generate.PALETTES)]
    textures = read_library(tmp_path)
    assert {texture.name for texture in textures} == set(generate.PALETTES)
    np.testing.assert_array_equal(textures[0].image, photo())


def test_thumbnails_and_digests_are_made_by_a_process_of_its_own(tmp_path):
    """As the planning panel asks for them: 3D Slicer's process must not load OpenCV while a run goes on."""
    shipped = list_textures(shipped_textures_folder())
    image, labels = shipped["apricot"]
    folder = tmp_path / "Fälle"
    thumbnails.ask_for(
        folder, [("apricot", image, labels), ("bare", image, None), ("gone", tmp_path / "x.png", labels)]
    )
    assert thumbnails.answer(folder) == {}
    command = [sys.executable, "-m", "ExpectedAppearancesLib.textures.thumbnails", str(folder)]
    subprocess.run(command, check=True, env=library_environment())
    made = thumbnails.answer(folder)
    assert made["apricot"]["sha256"] == read_texture("apricot", image, labels).sha256
    shown = files.read_image_rgb(made["apricot"]["thumbnail"])
    assert shown.shape == (84, 84, 3) and (shown == thumbnails.OUTLINE_RGB).all(axis=2).any()
    assert "label map" in made["bare"]["problem"] and "x.png" in made["gone"]["problem"]


def test_shipped_textures_are_copied_whole_or_not_at_all(tmp_path, monkeypatch):
    shipped, copied, usual = shipped_textures_folder(), [], shutil.copyfile

    def full_disk(source, target):
        copied.append(source)
        if len(copied) == 3:
            raise OSError(errno.ENOSPC, "No space left on device")
        usual(source, target)

    monkeypatch.setattr(shutil, "copyfile", full_disk)
    with pytest.raises(InputError, match="textures: cannot be written"):
        copy_textures(shipped_textures_folder(), tmp_path / "textures")
    assert not any(tmp_path.iterdir())
    copy_textures(shipped_textures_folder(), tmp_path / "textures")
    assert list_textures(tmp_path / "textures").keys() == list_textures(shipped).keys()
