"""Surface of a large segment, made by 3D Slicer's own converter in a process of its own: it takes seconds.

The scene's thread copies the segment's voxels to a file, a piece at a time, and reads the surface back.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ..case.meshes import Mesh
from ..errors import InputError
from .vtk_data import array_of

PIECE_VOXELS = 2_000_000
LABELMAP, SURFACE = "Binary labelmap", "Closed surface"


class SegmentSurfaces:
    """The surface of the segment that was chosen last, asked for and taken when it comes.

    ask: puts a question to who makes surfaces; the answer to it is to be handed to `take`.
    """

    def __init__(self, ask: Callable[[dict], None]):
        self._ask = ask
        self._asked: tuple | None = None  # version of the segment whose surface was asked for
        self._taken: tuple = (None, None, None)  # version, surface, error

    def wanted(self, node, segment_id: str) -> bool:
        """Whether the segment has no surface yet, here or in the scene, and could have one."""
        return labelmap_of(node, segment_id) is not None and self._taken[0] != _version(node, segment_id)

    def to_ask(self, node, segment_id: str) -> bool:
        """Whether it is still to be asked for."""
        return self.wanted(node, segment_id) and self._asked != _version(node, segment_id)

    def asking(self, node, segment_id: str, folder: Path) -> Iterator[None]:
        """Write the segment's voxels into `folder`, a piece at each step, and ask."""
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkCommonMath import vtkMatrix4x4

        self._asked = None  # what an older question is answered with is no longer wanted
        version, image, matrix = _version(node, segment_id), labelmap_of(node, segment_id), vtkMatrix4x4()
        value = node.GetSegmentation().GetSegment(segment_id).GetLabelValue()
        voxels = vtk_to_numpy(image.GetPointData().GetScalars()).reshape(image.GetDimensions()[::-1])
        image.GetImageToWorldMatrix(matrix)
        question = {
            "version": list(version),
            "voxels": str(folder / "voxels.bin"),
            "extent": list(image.GetExtent()),
            "image_to_world": array_of(matrix).ravel().tolist(),
            "conversion": node.GetSegmentation().SerializeAllConversionParameters(),
            "name": node.GetName(),
        }
        planes = max(1, PIECE_VOXELS // max(1, voxels[0].size))
        try:
            with open(question["voxels"], "wb") as stream:
                for k in range(0, len(voxels), planes):
                    stream.write((voxels[k : k + planes] == value).tobytes())
                    yield
        except OSError:  # the disk is full
            self._taken = (version, None, None)
            return
        self._asked = version
        self._ask(question)

    def take(self, question: dict, answer: dict) -> None:
        """The answer; nothing becomes of one that is not the newest."""
        version = tuple(question["version"])
        if version != self._asked:
            return
        if "problem" in answer:
            self._taken = (version, None, InputError(answer["problem"]))
            return
        # Without an answer, where the process has failed, the surface is made in the scene's thread.
        self._taken = (version, None, None)
        if "answer" in answer:
            with contextlib.suppress(OSError):
                self._taken = (version, surface_of(answer["answer"]), None)

    def forget(self) -> None:
        """Nothing that was asked for will come."""
        self._asked, self._taken = None, (None, None, None)

    def made(self, node, segment_id: str) -> Mesh | None:
        """The segment's surface in its own RAS mm, where it was taken. Raises InputError where none could be made."""
        version, surface, error = self._taken
        if labelmap_of(node, segment_id) is None or version != _version(node, segment_id):
            return None
        if error is not None:
            raise error
        return surface


def segment_version(node, segment_id: str) -> tuple:
    """Changes with what a segment is drawn as, with its surface, and with how one is to be made of it."""
    segmentation = node.GetSegmentation()
    segment = segmentation.GetSegment(segment_id) if segment_id else None
    if segment is None:
        return (0, 0, "")
    parts = (segment.GetRepresentation(name) for name in (segmentation.GetSourceRepresentationName(), SURFACE))
    return (*(part.GetMTime() if part else 0 for part in parts), segmentation.SerializeAllConversionParameters())


def _version(node, segment_id: str) -> tuple:
    return (node.GetID(), segment_id, *segment_version(node, segment_id))


def labelmap_of(node, segment_id: str):
    """vtkOrientedImageData that a surface has to be made of; None where there is a surface already, or no labelmap."""
    if node is None or not node.IsA("vtkMRMLSegmentationNode"):
        return None
    segmentation = node.GetSegmentation()
    segment = segmentation.GetSegment(segment_id) if segment_id else None
    if segment is None or segmentation.GetSourceRepresentationName() != LABELMAP or segment.GetRepresentation(SURFACE):
        return None
    image = segment.GetRepresentation(LABELMAP)
    return image if image is not None and image.GetPointData().GetScalars() is not None else None


def surface_of(answer: list) -> Mesh:
    """In the segmentation's own coordinates, RAS mm."""
    return Mesh(*(np.load(path, allow_pickle=False) for path in answer))


def answering() -> Callable[[dict], list]:
    """The function that answers: paths of the surface's vertices and triangles."""
    try:
        import vtkSegmentationCore as core  # in Slicer's Python
    except ImportError:
        import slicer as core

    core.vtkSegmentationConverterFactory.GetInstance().RegisterConverterRule(
        core.vtkBinaryLabelmapToClosedSurfaceConversionRule()
    )
    return lambda asked: _answer(core, asked)


def _answer(core, asked: dict) -> list:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.util.vtkConstants import VTK_UNSIGNED_CHAR
    from vtkmodules.vtkCommonMath import vtkMatrix4x4

    image = core.vtkOrientedImageData()
    image.SetExtent(asked["extent"])
    image.AllocateScalars(VTK_UNSIGNED_CHAR, 1)
    vtk_to_numpy(image.GetPointData().GetScalars())[:] = np.fromfile(asked["voxels"], np.uint8)
    matrix = vtkMatrix4x4()
    matrix.DeepCopy(asked["image_to_world"])
    image.SetImageToWorldMatrix(matrix)
    segment = core.vtkSegment()
    segment.SetName("vessels")
    segment.AddRepresentation(LABELMAP, image)
    segmentation = core.vtkSegmentation()
    segmentation.SetSourceRepresentationName(LABELMAP)
    segmentation.AddSegment(segment, "vessels")
    segmentation.DeserializeConversionParameters(asked["conversion"])
    if not segmentation.CreateRepresentation(SURFACE):
        raise InputError(no_surface(asked["name"]))
    mesh = Mesh.from_polydata(segment.GetRepresentation(SURFACE))
    paths = [str(Path(asked["voxels"]).with_name(f"{part}.npy")) for part in ("vertices", "triangles")]
    for path, array in zip(paths, (mesh.vertices_mm, mesh.triangles)):
        np.save(path, array)
    return paths


def no_surface(name: str) -> str:
    return f"{name}: no surface could be made of this segment; draw the vessels, or choose another segment."
