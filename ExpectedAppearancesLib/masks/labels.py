"""Label classes of masks and textures (the paper's c in {0, 1, 2})."""

BACKGROUND, PARENCHYMA, VESSELS = 0, 1, 2
CLASS_NAMES = ("background", "parenchyma", "vessels")  # by label
TISSUES = (PARENCHYMA, VESSELS)  # what a texture shows; the dark around the field is none
