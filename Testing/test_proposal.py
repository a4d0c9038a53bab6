"""The first label map of a photograph, against pictures whose vessels are known."""

from __future__ import annotations

import numpy as np
import pytest

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.textures.library import list_textures, read_texture, shipped_textures_folder

pytest.importorskip("skimage")
from ExpectedAppearancesLib.textures import photograph as photographs
from ExpectedAppearancesLib.textures import proposal


def photograph(side=240):
    """Pink, with a dark curved vessel of 14 px, in a round field; and the vessel's mask."""
    y, x = np.mgrid[0:side, 0:side].astype(float)
    rng = np.random.default_rng(2)
    image = np.stack([np.full((side, side), v) for v in (215.0, 150.0, 140.0)], axis=-1)
    image += rng.normal(0, 4, (side, side, 1))
    vessel = np.abs(x - side / 2 - 25 * np.sin(y / 40)) < 7
    image[vessel] = (120, 30, 40)
    field = np.hypot(x - side / 2, y - side / 2) < 0.46 * side
    image[~field] = 4
    return image.clip(0, 255).astype(np.uint8), vessel & field, field


def test_vessel_is_found_and_the_rim_of_the_field_is_none():
    image, vessel, field = photograph()
    labels = proposal.propose_labels(image)
    assert labels.shape == vessel.shape and labels.dtype == np.uint8
    found = labels == 2
    assert (found & vessel).sum() / (found | vessel).sum() > 0.5
    assert (labels[~field] == 0).mean() > 0.98
    assert not found[~field].any()


def test_large_pictures_and_empty_ones():
    image, vessel, _field = photograph()
    large = np.kron(image, np.ones((5, 4, 1), np.uint8))
    labels = proposal.propose_labels(large)
    assert labels.shape == (1200, 960)
    assert (labels[::5, ::4] == 2)[vessel].mean() > 0.5
    assert (proposal.propose_labels(np.full((50, 60, 3), 180, np.uint8)) == 1).all()
    assert (proposal.propose_labels(np.zeros((50, 60, 3), np.uint8)) == 0).all()


def test_shipped_textures_vessels_are_mostly_found():
    name, (image, labels) = next(iter(list_textures(shipped_textures_folder()).items()))
    texture = read_texture(name, image, labels)
    found = proposal.propose_labels(texture.image) == 2
    known = texture.labels == 2
    assert (found & known).sum() / known.sum() > 0.4
    assert (found & known).sum() / found.sum() > 2 * known.mean()  # far better than chance


def test_a_photograph_is_read_in_a_size_for_synthesis_and_kept_as_a_texture(tmp_path, capsys):
    image, *_ = photograph(120)
    path, textures = tmp_path / "Foto ü.png", tmp_path / "textures"
    textures.mkdir()
    files.write_png(path, np.kron(image, np.ones((10, 20, 1), np.uint8)))
    assert photographs.main(["read", str(path), str(tmp_path)]) == 0
    small, labels = (np.load(tmp_path / name) for name in (photographs.IMAGE, photographs.LABELS))
    assert small.shape == (512, 1024, 3) and labels.shape == (512, 1024)
    assert photographs.main(["keep", str(tmp_path), str(textures), "Foto"]) == 0
    (name,) = list_textures(textures)
    texture = read_texture(name, *list_textures(textures)[name])
    np.testing.assert_array_equal(texture.labels, labels)
    np.testing.assert_array_equal(texture.image, small)

    np.save(tmp_path / photographs.LABELS, np.zeros((512, 1024), np.uint8))
    assert photographs.main(["keep", str(tmp_path), str(textures), "bare"]) == 1
    assert list(list_textures(textures)) == ["Foto"]
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  - ")]
    assert len(said) == 2 and "px of vessels" in said[1]
    path.write_text("no picture")
    assert photographs.main(["read", str(path), str(textures)]) == 1
    assert "Foto ü.png" in capsys.readouterr().out and not (textures / photographs.IMAGE).exists()
