"""One training of a study: a model in a folder of its own, trained on some of the case's appearances."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..appearances.store import Appearance
from ..errors import InputError, Problems
from ..registration.poses_file import read_poses

SAME_POSE = 1e-4  # largest difference between the entries (mm, or of a rotation matrix) of one pose written twice


@dataclass(frozen=True)
class Fold:
    """folder: where the model goes. exclude: textures left out. poses_path: a poses file; training repeats its poses
    (the paper's protocol) instead of drawing fresh ones. inner_texture: keep one texture for choosing the epoch;
    without it all that are not left out are trained on, and the epoch is chosen on poses alone."""

    folder: Path
    exclude: tuple[str, ...] = ()
    poses_path: Path | None = None
    inner_texture: bool = True

    def styles(self, method: str, appearances: list[Appearance]) -> list[str]:
        """Textures that may be used, sorted. Raises InputError with every reason why this fold cannot be trained."""
        known = {a.style for a in appearances}
        listed = ", ".join(sorted(known))
        problems = Problems()
        for style in sorted(set(self.exclude) - known):
            problems.add(f"--exclude: no expected appearance has the texture '{style}'; there are {listed}.")
        left = known - set(self.exclude)
        if not left:
            problems.add(f"--exclude: nothing is left to train on; keep at least one of {listed}.")
        if self.poses_path:
            with problems.collect():
                poses = known_poses(self.poses_path)
                if method == "image":  # a texture that is seen from none of them shows nothing to train or choose on
                    seen = {a.style for a in appearances if a.style in left and seen_from(a, poses)}
                    left = seen or left
                if method == "image" and not seen:
                    problems.add(
                        f"{self.poses_path}: no appearance was synthesised at any of its poses; synthesise them with "
                        "the method surface, which can be seen from any pose."
                    )
        problems.raise_if_any()
        return sorted(left)


def known_poses(path: Path) -> np.ndarray:
    """camera_from_world (N, 4, 4) of the frames of a poses file. Raises InputError when none has one."""
    _, frames = read_poses(path)
    poses = [frame.camera_from_world for frame in frames if frame.camera_from_world is not None]
    if not poses:
        raise InputError(f"{path}: none of its frames has a camera_from_world; give frames whose poses are known.")
    return np.stack(poses)


def seen_from(appearance: Appearance, poses: np.ndarray) -> bool:
    """Whether one of the poses (N, 4, 4) is the one that an appearance of method `image` was synthesised for."""
    return bool((np.abs(poses - appearance.camera_from_world).max(axis=(1, 2)) < SAME_POSE).any())
