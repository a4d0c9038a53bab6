"""A photograph that becomes a texture: read and written in a process of its own, for which a panel does not wait.

`python -m ExpectedAppearancesLib.textures.photograph read PHOTOGRAPH FOLDER` writes FOLDER/photograph.npy, reduced to
what synthesis uses, and FOLDER/labels.npy, the proposed labels;
`... keep FOLDER TEXTURES NAME` makes NAME.png and NAME.labels.png of the two where they are a texture.
What is wrong is printed, a problem to a line that begins with "  - ".
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from .. import files
from ..errors import InputError
from .library import LABELS_SUFFIX, check_texture
from .proposal import propose_labels

LARGEST_SIDE_PX = 1024  # synthesis uses no more
IMAGE, LABELS = "photograph.npy", "labels.npy"


def read(photograph: Path, folder: Path) -> None:
    """Raises InputError where the file is no picture, ImportError where a package is missing."""
    import cv2

    image_rgb = files.read_image_rgb(photograph)
    scale = LARGEST_SIDE_PX / max(image_rgb.shape[:2])
    if scale < 1:
        image_rgb = cv2.resize(image_rgb, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    np.save(folder / IMAGE, image_rgb)
    np.save(folder / LABELS, propose_labels(image_rgb))


def keep(folder: Path, textures: Path, name: str) -> None:
    """Raises InputError with everything that keeps the two from being a texture."""
    image_rgb, labels = (np.load(folder / part, allow_pickle=False) for part in (IMAGE, LABELS))
    image_path, labels_path = textures / f"{name}.png", textures / f"{name}{LABELS_SUFFIX}"
    problems = check_texture(image_path, image_rgb, labels_path, labels)
    if problems:
        raise InputError(problems)
    # Labels first: a photograph without labels would make the whole folder unusable.
    files.write_png(labels_path, labels)
    files.write_png(image_path, image_rgb)


def main(argv: list[str]) -> int:
    try:
        if argv[0] == "read":
            read(Path(argv[1]), Path(argv[2]))
        else:
            keep(Path(argv[1]), Path(argv[2]), argv[3])
    except ImportError as error:
        print(f"  - The Python package {error.name} is missing: install it in Settings and help.")
        return 1
    except InputError as error:
        print("\n".join(f"  - {problem}" for problem in error.problems))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
