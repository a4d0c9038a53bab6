"""How far each disturbance of a frame moves the pose, and whether such frames are refused."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence

import numpy as np

from ..errors import InputError
from ..geometry.camera import Camera
from ..geometry.pose import transform
from ..registration.confidence import GOOD_ADD_MM
from ..registration.footage import read_frame_rgb
from ..registration.poses_file import Frame
from ..registration.predictor import fitted_camera
from .metrics import FrameErrors, add_accuracy, frame_errors, reliability, summary
from .overlays import sheet, with_caption
from .perturbations import FrameState, Perturbation, perturbations


def choose(frames: Sequence[Frame], count: int, seed: int) -> list[Frame]:
    """At most `count` of the frames, drawn evenly over their styles; the same for the same seed."""
    rng = np.random.default_rng([seed, 41])
    by_style: dict[str | None, list[Frame]] = {}
    for i in rng.permutation(len(frames)):
        by_style.setdefault(frames[i].style, []).append(frames[i])
    piles = [by_style[style] for style in sorted(by_style, key=str)]
    longest = max(map(len, piles), default=0)
    in_turn = [pile[k] for k in range(longest) for pile in piles if k < len(pile)]
    return in_turn[:count]


def robustness_table(
    vertices_mm: np.ndarray,
    camera: Camera,
    frames: Sequence[Frame],
    predictor_of: Callable[[str | None], object],
    model: str,
    count: int = 80,
    seed: int = 0,
    progress: Callable[[float, str], None] = lambda _fraction, _message: None,
    rows: Sequence[Perturbation] | None = None,
) -> dict:
    """{"model", "frames", "seed", "undisturbed": metrics, "rows": [{"kind", "strength", "metrics"}], "reliability"}.

    frames: with known poses; `count` of them are used. predictor_of(style): what registers frames of that style. model:
    says in words what that is. metrics: as one entry of metrics.json, and accepted_add_below_3mm, the share of accepted
    frames with ADD < 3 mm (None where none is accepted). reliability: of all frames whose image is disturbed, which a
    good model is sure of to all degrees; None where no image is.
    """
    chosen = choose(frames, count, seed)
    if not chosen:
        raise InputError("robustness: no frames to disturb; give a poses file with frames of the textures.")
    states = [_state(frame, camera, vertices_mm) for frame in chosen]
    wanted = [Perturbation("undisturbed", "", lambda state, _rng: (state.image, state.camera))]
    wanted += perturbations() if rows is None else rows
    done, judged = [], []
    for k, perturbation in enumerate(wanted):
        predicted = []
        for i, (frame, state) in enumerate(zip(chosen, states)):
            # One generator for all strengths of a kind, so that strengths differ in nothing else.
            rng = np.random.default_rng([seed, i, zlib.crc32(perturbation.kind.encode())])
            image, told = perturbation.apply(state, rng)
            predicted.append(predictor_of(frame.style).predict(image, told))
            if image is not state.image:
                judged.append((frame, predicted[-1]))
        done.append(_figures(vertices_mm, chosen, predicted))
        progress((k + 1) / len(wanted), f"robustness: {perturbation.kind} {perturbation.strength}".rstrip())
    table = [{"kind": p.kind, "strength": p.strength, "metrics": m} for p, m in zip(wanted[1:], done[1:])]
    worth = reliability([p.confidence for _, p in judged], _errors(vertices_mm, *zip(*judged))) if judged else None
    of_all = {"model": model, "frames": len(chosen), "seed": seed}
    return of_all | {"undisturbed": done[0], "rows": table, "reliability": worth}


def example_sheet(frame: Frame, camera: Camera, vertices_mm: np.ndarray, seed: int = 0) -> np.ndarray:
    """uint8 RGB: the frame, then the strongest disturbance of each kind that changes the image, with captions."""
    state = _state(frame, camera, vertices_mm)
    strongest = {p.kind: p for p in perturbations()}
    tiles = [with_caption(state.image, "undisturbed")]
    for kind, perturbation in strongest.items():
        image, told = perturbation.apply(state, np.random.default_rng([seed, 0, zlib.crc32(kind.encode())]))
        if told == state.camera:
            tiles.append(with_caption(image, f"{kind}, {perturbation.strength}"))
    return sheet(tiles)


def _state(frame: Frame, camera: Camera, vertices_mm: np.ndarray) -> FrameState:
    image = read_frame_rgb(frame.image)
    own = fitted_camera(camera, image.shape[1], image.shape[0])
    depth_mm = float(transform(frame.camera_from_world, vertices_mm.mean(axis=0)[None])[0, 2])
    return FrameState(image, own, own.fx / depth_mm)


def _figures(vertices_mm: np.ndarray, frames: Sequence[Frame], predicted: Sequence) -> dict:
    errors = _errors(vertices_mm, frames, predicted)
    below = add_accuracy(errors.select(errors.accepted), GOOD_ADD_MM)
    return summary(errors) | {"accepted_add_below_3mm": below}


def _errors(vertices_mm: np.ndarray, frames: Sequence[Frame], predicted: Sequence) -> FrameErrors:
    return frame_errors(
        vertices_mm,
        [frame.camera_from_world for frame in frames],
        [prediction.camera_from_world for prediction in predicted],
        [prediction.accepted for prediction in predicted],
    )
