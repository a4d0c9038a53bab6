"""The scan that a case was planned on: kept in the case as mri.nrrd, in world coordinates, and found again from there.

It is only looked at: nothing that is made from the case depends on it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from .. import files
from ..case.case import Case
from ..errors import InputError
from .vtk_data import array_of, vtk_matrix

MRI, FILE_NAME = "mri", "mri.nrrd"
ATTRIBUTE = "ExpectedAppearances.CaseMRI"  # of a volume node: the digest of the case's scan that it shows
COMPARED_VOXELS = 100_000
SAME_PLACE_MM = 0.01


def scan_identity(node) -> dict:
    """{"voxels_sha256", "places_ras_mm"}: what tells one scan, and where it lies in the world, from another.

    Takes some milliseconds however large the volume is: not every voxel is looked at.
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonMath import vtkMatrix4x4
    from vtkmodules.vtkCommonTransforms import vtkGeneralTransform

    image = node.GetImageData()
    if image is None or not image.GetNumberOfPoints():
        raise InputError(f"{node.GetName()}: holds no image; choose another MRI, or none.")
    size = image.GetDimensions()
    voxels = vtk_to_numpy(image.GetPointData().GetScalars()).reshape(-1)
    some = np.ascontiguousarray(voxels[:: max(1, len(voxels) // COMPARED_VOXELS)])
    digest = hashlib.sha256(repr((size, some.dtype.str)).encode() + some.tobytes()).hexdigest()
    matrix, to_world = vtkMatrix4x4(), vtkGeneralTransform()
    node.GetIJKToRASMatrix(matrix)
    if node.GetParentTransformNode():
        node.GetParentTransformNode().GetTransformToWorld(to_world)
    lattice = np.stack(np.meshgrid(*([0.0, n / 2, n - 1.0] for n in size)), axis=-1).reshape(-1, 3)
    places = [to_world.TransformPoint(matrix.MultiplyPoint((*ijk, 1.0))[:3]) for ijk in lattice]
    return {"voxels_sha256": digest, "places_ras_mm": np.round(places, 4).tolist()}


def placement(node) -> list[float]:
    """IJK to RAS, row by row, without the transforms above the node."""
    from vtkmodules.vtkCommonMath import vtkMatrix4x4

    matrix = vtkMatrix4x4()
    node.GetIJKToRASMatrix(matrix)
    return array_of(matrix).ravel().tolist()


def is_scan_of(case: Case, identity: dict) -> bool:
    """Whether a volume of this identity is the scan that the case keeps, as it was chosen or as its file has it."""
    return _is_known(case, identity) and (case.folder / _entry(case)["file"]).is_file()


def keeping_scan(case: Case, node, identity: dict) -> Iterator[None]:
    """Write the volume into the case, all transforms applied, and its identity into case.json; a piece at each step.

    The node itself stays as it is. Closed before its end it leaves the case as it was. Raises InputError where the disk
    is full or the node holds no image.
    """
    path = case.folder / FILE_NAME
    files.require_space(case.folder, node.GetImageData().GetActualMemorySize() / 1024 + 5)
    name = node.GetName()
    source = node.GetStorageNode().GetFileName() if node.GetStorageNode() else None
    hardened = _hardened(node)
    yield
    with files.replacing(path) as temporary:
        storage = _storage(hardened.GetScene(), temporary)
        storage.SetUseCompression(0)  # to write a scan takes tens of milliseconds, to compress it seconds
        if not storage.WriteData(hardened):
            raise InputError(f"{path}: the MRI cannot be written; free some space or choose another folder.")
        yield
        # As it is read: readers may turn the order of the voxels.
        read = hardened.GetScene().AddNewNodeByClass("vtkMRMLScalarVolumeNode")
        if not _storage(hardened.GetScene(), temporary).ReadData(read):
            raise InputError(f"{path}: the MRI cannot be kept with the case; save the case without one.")
        kept = scan_identity(read)
        yield
    entry = {"file": FILE_NAME, "name": name, "source": source or None}
    case.attach(MRI, entry | {"identities": [identity] if _same(identity, kept) else [identity, kept]})
    if node.GetScene() is not None:
        node.SetAttribute(ATTRIBUTE, kept["voxels_sha256"])


def scan_of(scene, case: Case):
    """The case's scan in the scene: the volume that is there already, else read from the case; None without one.

    Raises InputError when the file cannot be read.
    """
    entry = _entry(case)
    if not entry:
        return None
    digests = {identity["voxels_sha256"] for identity in entry["identities"]}
    for i in range(scene.GetNumberOfNodesByClass("vtkMRMLScalarVolumeNode")):
        node = scene.GetNthNodeByClass(i, "vtkMRMLScalarVolumeNode")
        # Volumes that were never a case's are not looked into: there may be many.
        if node.GetAttribute(ATTRIBUTE) in digests and _is_known(case, scan_identity(node)):
            return node
    path = case.folder / entry["file"]
    if not path.is_file():
        raise InputError(f"{path}: the MRI of the case is missing; restore it, or choose the MRI again and save.")
    node = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", entry.get("name") or "MRI")
    storage = _storage(scene, path)
    if not storage.ReadData(node):
        scene.RemoveNode(node)
        scene.RemoveNode(storage)
        raise InputError(f"{path}: the MRI of the case is damaged; choose the MRI again and save the case.")
    node.SetAndObserveStorageNodeID(storage.GetID())
    node.CreateDefaultDisplayNodes()
    node.SetAttribute(ATTRIBUTE, entry["identities"][-1]["voxels_sha256"])
    return node


def scan_to_show(scene, case: Case, chosen):
    """What the live panel shows: what the user chose, else the case's scan. That of another case is not kept."""
    entry = _entry(case)
    digests = {identity["voxels_sha256"] for identity in entry.get("identities", [])}
    if chosen is not None and (not chosen.GetAttribute(ATTRIBUTE) or chosen.GetAttribute(ATTRIBUTE) in digests):
        return chosen
    return scan_of(scene, case)


def _entry(case: Case) -> dict:
    entry = case.manifest.get("attachments", {}).get(MRI)
    return entry if isinstance(entry, dict) and {"file", "identities"} <= entry.keys() else {}


def _is_known(case: Case, identity: dict) -> bool:
    return any(_same(identity, known) for known in _entry(case).get("identities", []))


def _same(first: dict, second: dict) -> bool:
    return first["voxels_sha256"] == second["voxels_sha256"] and bool(
        np.allclose(first["places_ras_mm"], second["places_ras_mm"], rtol=0, atol=SAME_PLACE_MM)
    )


def _hardened(node):
    """A copy in a scene of its own, in world coordinates; one that is bent or sheared is resampled: files and Slicer's
    readers know grids of right angles only."""
    import slicer
    from vtkmodules.vtkCommonMath import vtkMatrix4x4
    from vtkmodules.vtkCommonTransforms import vtkGeneralTransform, vtkMatrixToLinearTransform

    scene = slicer.vtkMRMLScene()
    copy = scene.AddNewNodeByClass("vtkMRMLScalarVolumeNode", node.GetName())
    copy.kept_alive = scene
    image = node.GetImageData().NewInstance()
    image.ShallowCopy(node.GetImageData())
    copy.SetAndObserveImageData(image)
    placed, parent = np.reshape(placement(node), (4, 4)), node.GetParentTransformNode()
    if parent is not None and not parent.IsTransformToWorldLinear():
        to_world = vtkGeneralTransform()
        parent.GetTransformToWorld(to_world)
        copy.SetIJKToRASMatrix(vtk_matrix(placed))
        copy.ApplyNonLinearTransform(to_world)
        return copy
    if parent is not None:
        matrix = vtkMatrix4x4()
        parent.GetMatrixTransformToWorld(matrix)
        placed = array_of(matrix) @ placed
    grid = _right_angled(placed)
    copy.SetIJKToRASMatrix(vtk_matrix(grid))
    if not np.allclose(grid, placed, rtol=0, atol=1e-4):
        shear = vtkMatrixToLinearTransform()
        shear.SetInput(vtk_matrix(placed @ np.linalg.inv(grid)))
        copy.ApplyNonLinearTransform(shear)
    return copy


def _right_angled(ijk_to_ras: np.ndarray) -> np.ndarray:
    """The grid of right angles, with the same spacing and origin, that is nearest to this one (4x4)."""
    axes = ijk_to_ras[:3, :3]
    spacing = np.linalg.norm(axes, axis=0)
    u, _, vt = np.linalg.svd(axes / spacing)
    grid = ijk_to_ras.copy()
    grid[:3, :3] = u @ vt * spacing
    return grid


def _storage(scene, path: Path):
    storage = scene.AddNewNodeByClass("vtkMRMLVolumeArchetypeStorageNode")
    storage.SetFileName(str(path))
    return storage
