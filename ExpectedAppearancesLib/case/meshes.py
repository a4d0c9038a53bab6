"""Triangle meshes in mm: read from the formats that segmentation tools write, checked, written as VTP."""

from __future__ import annotations

import os
import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .. import files
from ..errors import InputError

SMALLEST_EXTENT_MM = 1.0
LARGEST_EXTENT_MM = 2000.0
PLY_TYPES = dict(char="b", uchar="B", short="h", ushort="H", int="i", uint="I", float="f", double="d")
PLY_TYPES |= dict(int8="b", uint8="B", int16="h", uint16="H", int32="i", uint32="I", float32="f", float64="d")
SPACE_FIELD = "SPACE"
FORMATS = (".vtp", ".vtk", ".stl", ".ply", ".obj")


@dataclass(frozen=True, eq=False)
class Mesh:
    """vertices_mm (N, 3) float64 in the file's own space; triangles (F, 3) int64, indices of vertices."""

    vertices_mm: np.ndarray
    triangles: np.ndarray

    @property
    def centroid_mm(self) -> np.ndarray:
        """Mean of the vertices, (3,)."""
        return self.vertices_mm.mean(axis=0)

    @property
    def radius_mm(self) -> float:
        """Largest distance of a vertex from the centroid."""
        return float(np.linalg.norm(self.vertices_mm - self.centroid_mm, axis=1).max())

    def vertex_normals(self) -> np.ndarray:
        """Area-weighted unit normals, (N, 3); 0 for a vertex of no triangle."""
        a, b, c = (self.vertices_mm[self.triangles[:, i]] for i in range(3))
        face_normals = np.cross(b - a, c - a)  # length = 2 x area: the weight
        corners = self.triangles.ravel()
        repeated = np.repeat(face_normals, 3, axis=0)
        count = len(self.vertices_mm)
        normals = np.stack([np.bincount(corners, repeated[:, axis], count) for axis in range(3)], axis=1)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)

    @property
    def area_mm2(self) -> float:
        """Sum of the triangles' areas."""
        a, b, c = (self.vertices_mm[self.triangles[:, i]] for i in range(3))
        return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)

    def simplified(self, triangle_mm2: float) -> Mesh:
        """The surface in triangles of that mean area, by quadric error; itself where they are no smaller now."""
        from vtkmodules.vtkFiltersCore import vtkQuadricDecimation

        kept = self.area_mm2 / triangle_mm2 / max(len(self.triangles), 1)
        if kept >= 1:
            return self
        decimation = vtkQuadricDecimation()
        decimation.SetInputData(self.to_polydata())
        decimation.SetTargetReduction(1 - kept)
        decimation.Update()
        return Mesh.from_polydata(decimation.GetOutput())

    def to_polydata(self, normals: bool = True):
        """vtkPolyData of its own memory, with point normals unless nothing is lit."""
        from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
        from vtkmodules.vtkCommonCore import vtkPoints
        from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

        points = vtkPoints()
        points.SetData(numpy_to_vtk(np.ascontiguousarray(self.vertices_mm, np.float64), deep=True))
        offsets = np.arange(0, 3 * len(self.triangles) + 1, 3, dtype=np.int64)
        cells = vtkCellArray()
        cells.SetData(
            numpy_to_vtkIdTypeArray(offsets, deep=True),
            numpy_to_vtkIdTypeArray(np.ascontiguousarray(self.triangles.ravel(), np.int64), deep=True),
        )
        polydata = vtkPolyData()
        polydata.SetPoints(points)
        polydata.SetPolys(cells)
        if normals:
            array = numpy_to_vtk(self.vertex_normals().astype(np.float32), deep=True)
            array.SetName("Normals")
            polydata.GetPointData().SetNormals(array)
        return polydata

    @classmethod
    def from_polydata(cls, polydata) -> Mesh:
        """Triangles of a vtkPolyData; polygons and strips are split, lines and degenerate triangles dropped, and so are
        points of no triangle. Points at the same place become one vertex.

        Raises InputError when cells refer to points that do not exist.
        """
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkFiltersCore import vtkTriangleFilter

        if not polydata.GetNumberOfPoints():
            return cls(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
        for cells in (polydata.GetPolys(), polydata.GetStrips(), polydata.GetLines(), polydata.GetVerts()):
            corners = vtk_to_numpy(cells.GetConnectivityArray())
            if corners.size and not 0 <= corners.min() <= corners.max() < polydata.GetNumberOfPoints():
                raise InputError("a cell refers to a point that does not exist")
        splitter = vtkTriangleFilter()
        splitter.PassVertsOff()
        splitter.PassLinesOff()
        splitter.SetInputData(polydata)
        splitter.Update()
        vertices_mm = vtk_to_numpy(splitter.GetOutput().GetPoints().GetData()).astype(np.float64)
        triangles = vtk_to_numpy(splitter.GetOutput().GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64)
        is_first, first = _first_at_each_place(vertices_mm)
        triangles = (np.cumsum(is_first) - 1)[first[triangles]]
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (c != a)]
        # A mesh that was cut may keep the points of what was cut away: its middle and size would be those of all.
        is_used = np.zeros(is_first.sum(), bool)
        is_used[triangles] = True
        return cls(vertices_mm[is_first][is_used], (np.cumsum(is_used) - 1)[triangles])


def _first_at_each_place(vertices_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) whether a vertex is the first of those that lie where it lies, and (N,) which is.

    Files may give each triangle vertices of its own (.obj with a normal for each face), or those at creases: without
    neighbours every edge would be an outline, and the surface fall apart where it is simplified.
    """
    x, y, z = vertices_mm.T
    # Sorted by a number that is another one at another place, or merely not merged; three keys take ten times as long.
    order = np.argsort(x + 0.7548776662466927 * y + 0.5698402909980532 * z, kind="stable")
    is_new = np.append(True, (np.diff(vertices_mm[order], axis=0) != 0).any(axis=1))
    first = np.empty(len(order), np.int64)
    first[order] = order[is_new][np.cumsum(is_new) - 1]
    return first == np.arange(len(order)), first


def read_mesh(path: Path, what: str) -> Mesh:
    """Mesh of a .vtp, .vtk, .stl, .ply or .obj file; `what` ("vessel mesh") names it in messages. Raises InputError."""
    path = Path(path)
    if not os.path.isfile(path):
        raise InputError(f"{path}: {what} not found; check the path.")
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: {what} has an unknown format; save it as one of {', '.join(FORMATS)}.")
    with files.reading(path), open(path, "rb") as stream:
        stream.read(1)
    try:
        mesh = Mesh.from_polydata(_read_polydata(path))
    except InputError as error:
        raise InputError(
            f"{path}: {what} cannot be read, or is cut short ({error}); export it again as {path.suffix}."
        ) from error
    if not len(mesh.triangles):
        raise InputError(f"{path}: {what} has no triangles; export the surface model, not points or centrelines.")
    if not np.isfinite(mesh.vertices_mm).all():
        raise InputError(f"{path}: {what} has coordinates that are not numbers (NaN or infinite); export it again.")
    extent_mm = float(np.ptp(mesh.vertices_mm, axis=0).max())
    if extent_mm < SMALLEST_EXTENT_MM:
        raise InputError(
            f"{path}: {what} is only {extent_mm:.3g} mm wide, it looks like metres; scale it by 1000 to millimetres."
        )
    if extent_mm > LARGEST_EXTENT_MM:
        raise InputError(
            f"{path}: {what} is {extent_mm:.0f} mm wide, more than {LARGEST_EXTENT_MM:.0f} mm; "
            "it looks like micrometres or holds stray points. Scale it to millimetres, or remove them."
        )
    return mesh


def write_vtp(path: Path, mesh: Mesh, space: str | None = None) -> None:
    """Write `mesh` with point normals as VTK XML, whole or not at all. Raises InputError when it cannot.

    `space` ('LPS' or 'RAS') is written where 3D Slicer looks for it; without it Slicer takes LPS.
    """
    from vtkmodules.vtkCommonCore import vtkStringArray
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter

    polydata = mesh.to_polydata()
    if space:
        array = vtkStringArray()
        array.SetName(SPACE_FIELD)
        array.InsertNextValue(space)
        polydata.GetFieldData().AddArray(array)
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(polydata)
    # To memory: VTK reports a full disk only on the terminal. Base64 keeps the text ASCII.
    writer.SetDataModeToBinary()
    writer.WriteToOutputStringOn()
    writer.Write()
    files.write_bytes(Path(path), writer.GetOutputString().encode("ascii"))


def declared_space(path: Path) -> str | None:
    """'LPS' or 'RAS' where the file says so as 3D Slicer does, in its header or (.vtp) its field data; else None."""
    path = Path(path)
    try:
        with open(path, "rb") as stream:
            found = re.search(rb"SPACE=(LPS|RAS)", stream.read(2048))
        if found:
            return found.group(1).decode()
        is_vtp = path.suffix.lower() == ".vtp"
        array = _read_polydata(path).GetFieldData().GetAbstractArray(SPACE_FIELD) if is_vtp else None
    except (OSError, InputError):  # read_mesh reports these
        return None
    value = array.GetValue(0) if array and array.IsA("vtkStringArray") and array.GetNumberOfValues() else None
    return value if value in ("LPS", "RAS") else None


def _read_polydata(path: Path):
    from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow
    from vtkmodules.vtkIOGeometry import vtkOBJReader, vtkSTLReader
    from vtkmodules.vtkIOLegacy import vtkPolyDataReader
    from vtkmodules.vtkIOPLY import vtkPLYReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    suffix = path.suffix.lower()
    if suffix == ".ply":
        _check_ply_is_whole(path)
    elif suffix == ".stl":
        _check_stl_is_whole(path)
    if suffix in (".stl", ".ply"):
        _check_end_is_written(path)
    readers = (vtkXMLPolyDataReader, vtkPolyDataReader, vtkSTLReader, vtkPLYReader, vtkOBJReader)
    reader = dict(zip(FORMATS, readers))[suffix]()
    reader.SetFileName(os.fsencode(path))  # a name from an old archive may be no text
    # VTK reports trouble only as text in its output window, and then returns what it has got.
    usual_window, window = vtkOutputWindow.GetInstance(), vtkStringOutputWindow()
    usual_verbosity = vtkLogger.GetCurrentVerbosityCutoff()
    vtkOutputWindow.SetInstance(window)
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        reader.Update()
    finally:
        vtkLogger.SetStderrVerbosity(usual_verbosity)
        vtkOutputWindow.SetInstance(usual_window)
    messages = re.findall(
        r"^(?:ERROR|Warning|Generic Warning): In .*\n(?:vtk\w+ \(0x\w+\): )?(.+)", window.GetOutput(), re.MULTILINE
    )
    trouble = [m for m in messages if re.search("error|cannot|could not|premature|mismatch", m, re.IGNORECASE)]
    if trouble or "ERROR:" in window.GetOutput():
        raise InputError((trouble or messages or ["VTK reports an error"])[0].strip(" ."))
    return reader.GetOutput()


def _check_end_is_written(path: Path) -> None:
    """Raise InputError where zeros stand for the end, as a drive that was pulled out leaves a file: its triangles would
    be gone without a word. No whole file ends so: the last triangle would have no corners."""
    with open(path, "rb") as stream:
        stream.seek(max(0, stream.seek(0, os.SEEK_END) - 32))
        if not stream.read().strip(b"\0"):
            raise InputError("its end was never written")


def _check_stl_is_whole(path: Path) -> None:
    """Raise InputError when a binary STL file ends early: VTK 9.4, which Slicer has, returns a part without a word."""
    with open(path, "rb") as stream:
        head = stream.read(2048)
    if head.lstrip().startswith(b"solid") and b"facet" in head:
        return  # as text: VTK tells
    if len(head) < 84 or path.stat().st_size < 84 + 50 * struct.unpack_from("<I", head, 80)[0]:
        raise InputError("the file ends early")


def _check_ply_is_whole(path: Path) -> None:
    """Raise InputError when a PLY file ends early: vtkPLYReader then crashes, or returns a part without a word."""
    data = path.read_bytes()
    header, mark, body = data.partition(b"end_header")
    body = body.split(b"\n", 1)[1] if b"\n" in body else b""
    if not header.startswith(b"ply") or not mark:
        raise InputError("no complete PLY header")
    layout, elements = "", []
    try:
        for words in (line.split() for line in header.decode("ascii", "replace").splitlines()):
            if words[:1] == ["format"]:
                layout = words[1]
            elif words[:1] == ["element"]:
                elements.append((int(words[2]), []))
            elif words[:1] == ["property"]:
                types = words[2:4] if words[1] == "list" else words[1:2]
                elements[-1][1].append([PLY_TYPES[name] for name in types])
    except (IndexError, ValueError, KeyError) as error:
        raise InputError(f"PLY header is damaged ({error})") from error
    if layout == "ascii":
        whole = len([line for line in body.splitlines() if line.strip()]) >= sum(count for count, _ in elements)
    else:
        whole = _binary_ply_is_whole(body, elements, "<" if layout == "binary_little_endian" else ">")
    if not whole:
        raise InputError("the file ends early")


def _binary_ply_is_whole(body: bytes, elements: list, byte_order: str) -> bool:
    position = 0
    for count, properties in elements:
        if all(len(types) == 1 for types in properties):
            position += count * sum(struct.calcsize(types[0]) for types in properties)
            continue
        for _ in range(count):
            for first, *item in properties:
                if position + struct.calcsize(first) > len(body):
                    return False
                length = struct.unpack_from(byte_order + first, body, position)[0] if item else 0
                position += struct.calcsize(first) + (int(length) * struct.calcsize(item[0]) if item else 0)
    return position <= len(body)
