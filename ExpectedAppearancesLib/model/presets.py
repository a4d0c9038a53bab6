"""Presets of P_Omega: what is trained, on what, for how long."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace


@dataclass(frozen=True)
class Preset:
    """estimator: 'regression' (the paper's network) or 'dense' (surface coordinates, then PnP).

    size_px: side of the square network input. fresh: new views in each batch; the others are drawn from the last
    `remembered` views, since rendering on a CPU costs as much as training does. minutes: the schedule ends at `steps`
    or at this time, whichever is first. fresh_poses: every new view has a pose of its own. varied: whether views differ
    in more than pose, texture and elastic deformation, which is all that the paper's do. negatives: share of views
    that show something else, for which no surface may be found. reads: what the regression sees: 'image', or vessels as
    a U-Net segments them, their 'probability' or the thresholded 'mask' (ProbSEG and BinSEG, Haouchine et al. 2022).
    """

    name: str
    estimator: str
    size_px: int
    steps: int
    batch: int
    fresh: int
    minutes: float
    learning_rate: float
    final_learning_rate: float
    width: float = 1.0
    fresh_poses: bool = True
    varied: bool = True
    negatives: float = 0.06
    elastic_px: float = 2.0
    validation_views: int = 192
    validate_every: int = 150
    remembered: int = 4000
    reads: str = "image"

    def to_dict(self) -> dict:
        return asdict(self)


PRESETS = {
    "quick": Preset("quick", "dense", 128, 3000, 24, 8, 26.0, 2e-3, 2e-5),
    "best": Preset("best", "dense", 192, 6000, 24, 8, 90.0, 2e-3, 2e-5, validate_every=250),
    # 200 epochs of about 1,500 images, batch 8 (the paper's section 2.3); training sets the steps from the images.
    "paper": Preset(
        "paper",
        "regression",
        128,
        37500,
        8,
        8,
        720.0,
        1e-3,
        1e-4,
        fresh_poses=False,
        varied=False,
        negatives=0.0,
        validate_every=500,
    ),
}
# The rivals: the paper's network at its own size, on vessel masks half as large as the image that is segmented.
_rival = replace(PRESETS["paper"], size_px=256, width=0.5)
PRESETS["probseg"] = replace(_rival, name="probseg", reads="probability")
PRESETS["binseg"] = replace(_rival, name="binseg", reads="mask")
PAPER_EPOCHS = 200
