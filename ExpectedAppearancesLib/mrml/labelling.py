"""A photograph in the scene, with a segmentation that starts from a proposed label map, and the labels back from it."""

from __future__ import annotations

import numpy as np

from ..masks.labels import BACKGROUND, PARENCHYMA, VESSELS
from .vtk_data import image_data, vtk_matrix

PIXEL_MM = 0.1  # any size will do; this one suits the brushes of the Segment Editor
# Segments by the label they stand for; what is in none of them is parenchyma.
SEGMENTS = {VESSELS: ("Vessels", (0.82, 0.13, 0.15)), BACKGROUND: ("Outside of the cortex", (0.2, 0.3, 0.6))}


def add_photograph(scene, name: str, image_rgb: np.ndarray, labels: np.ndarray) -> dict:
    """Nodes 'colour' (what is looked at), 'grey' (what the Segment Editor works on) and 'segmentation'.

    image_rgb uint8 (H, W, 3), labels uint8 (H, W). The picture lies in an axial plane and is seen upright there.
    """
    colour = scene.AddNewNodeByClass("vtkMRMLVectorVolumeNode", name)
    grey = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", f"{name} (green)")
    for node, pixels in ((colour, image_rgb), (grey, image_rgb[..., 1])):
        node.SetIJKToRASMatrix(vtk_matrix(np.diag([-PIXEL_MM, -PIXEL_MM, PIXEL_MM, 1.0])))
        node.SetAndObserveImageData(image_data(pixels))
        node.CreateDefaultDisplayNodes()
        if node.GetDisplayNode():
            node.GetDisplayNode().SetAutoWindowLevel(False)
            node.GetDisplayNode().SetWindowLevelMinMax(0, 255)
    segmentation = scene.AddNewNodeByClass("vtkMRMLSegmentationNode", f"{name} labels")
    segmentation.CreateDefaultDisplayNodes()
    segmentation.SetSourceRepresentationToBinaryLabelmap()
    segmentation.SetReferenceImageGeometryParameterFromVolumeNode(grey)
    for label, (title, rgb) in SEGMENTS.items():
        _add_segment(segmentation, grey, labels == label, title, rgb)
    return {"colour": colour, "grey": grey, "segmentation": segmentation}


def labels_of(nodes: dict) -> np.ndarray:
    """uint8 (H, W) labels of the segmentation as it is now; where segments overlap, vessels win."""
    import slicer

    width, height, _ = nodes["grey"].GetImageData().GetDimensions()
    labels = np.full((height, width), PARENCHYMA, np.uint8)
    segmentation = nodes["segmentation"].GetSegmentation()
    for label in (BACKGROUND, VESSELS):
        title = SEGMENTS[label][0]
        # One that was deleted and made anew has the title and no more.
        identifier = title if segmentation.GetSegment(title) else segmentation.GetSegmentIdBySegmentName(title)
        if identifier:
            labels[_segment_mask(slicer, nodes, identifier, (height, width))] = label
    return labels


def _add_segment(segmentation_node, volume, mask: np.ndarray, title: str, rgb) -> None:
    """Its id is its first title: the user may give it another one."""
    import slicer

    image = slicer.vtkOrientedImageData()
    image.ShallowCopy(image_data(mask.astype(np.uint8)))
    image.SetImageToWorldMatrix(_matrix_of(volume))
    segment = slicer.vtkSegment()
    segment.SetName(title)
    segment.SetColor(*rgb)
    segment.AddRepresentation(slicer.vtkSegmentationConverter.GetSegmentationBinaryLabelmapRepresentationName(), image)
    segmentation_node.GetSegmentation().AddSegment(segment, title)


def _segment_mask(slicer, nodes: dict, identifier: str, shape: tuple[int, int]) -> np.ndarray:
    """bool (H, W) of one segment, on the grid of the picture."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    segment = nodes["segmentation"].GetSegmentation().GetSegment(identifier)
    name = slicer.vtkSegmentationConverter.GetSegmentationBinaryLabelmapRepresentationName()
    found = np.zeros(shape, bool)
    image = segment.GetRepresentation(name)
    if image is None or image.IsEmpty():
        return found
    # Segments are cropped to what they hold, and several may share one image with a value for each.
    on_grid = slicer.vtkOrientedImageData()
    reference = slicer.vtkOrientedImageData()
    reference.ShallowCopy(nodes["grey"].GetImageData())
    reference.SetImageToWorldMatrix(_matrix_of(nodes["grey"]))
    slicer.vtkOrientedImageDataResample.ResampleOrientedImageToReferenceOrientedImage(image, reference, on_grid)
    values = vtk_to_numpy(on_grid.GetPointData().GetScalars()).reshape(shape)
    return values == segment.GetLabelValue()


def _matrix_of(volume):
    from vtkmodules.vtkCommonMath import vtkMatrix4x4

    matrix = vtkMatrix4x4()
    volume.GetIJKToRASMatrix(matrix)
    return matrix
