"""Meshes read from every format, whole or refused."""

from __future__ import annotations

import numpy as np
import pytest
import vtk
from cases import dome

from ExpectedAppearancesLib.case.meshes import Mesh, declared_space, read_mesh, write_vtp
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.geometry.pose import look_at
from ExpectedAppearancesLib.geometry.silhouette import Silhouette

WRITERS = {
    "vtp": vtk.vtkXMLPolyDataWriter,
    "vtk": vtk.vtkPolyDataWriter,
    "stl": vtk.vtkSTLWriter,
    "ply": vtk.vtkPLYWriter,
    "obj": vtk.vtkOBJWriter,
}


def sphere(radius_mm=10.0, centre_mm=(30.0, -20.0, 5.0)):
    source = vtk.vtkSphereSource()
    source.SetRadius(radius_mm)
    source.SetCenter(*centre_mm)
    source.SetThetaResolution(24)
    source.SetPhiResolution(24)
    source.Update()
    return source.GetOutput()


def save(polydata, path, binary=True):
    writer = WRITERS[path.suffix[1:]]()
    writer.SetInputData(polydata)
    writer.SetFileName(str(path))
    if hasattr(writer, "SetFileTypeToBinary"):
        (writer.SetFileTypeToBinary if binary else writer.SetFileTypeToASCII)()
    assert writer.Write()
    return path


def polydata_of(points, lines=(), polygons=(), strips=()):
    polydata, vtk_points = vtk.vtkPolyData(), vtk.vtkPoints()
    for point in points:
        vtk_points.InsertNextPoint(*point)
    polydata.SetPoints(vtk_points)
    for setter, cells in (("SetLines", lines), ("SetPolys", polygons), ("SetStrips", strips)):
        array = vtk.vtkCellArray()
        for cell in cells:
            array.InsertNextCell(len(cell), cell)
        getattr(polydata, setter)(array)
    return polydata


SQUARE = [(0, 0, 0), (10, 0, 0), (10, 10, 0), (0, 10, 0)]


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("suffix", list(WRITERS))
def test_reads_each_format_in_mm_and_in_place(tmp_path, suffix, binary):
    polydata = sphere()
    mesh = read_mesh(save(polydata, tmp_path / f"Gefäße {binary}.{suffix}", binary), "vessel mesh")
    assert mesh.triangles.shape == (polydata.GetNumberOfPolys(), 3)
    assert mesh.vertices_mm.dtype == np.float64 and mesh.triangles.dtype == np.int64
    assert mesh.centroid_mm == pytest.approx([30, -20, 5], abs=1e-3)
    assert mesh.radius_mm == pytest.approx(10.0, abs=1e-3)
    # A closed surface that keeps its orientation has the volume of the (faceted) ball, positive.
    a, b, c = (mesh.vertices_mm[mesh.triangles[:, i]] - [30, -20, 5] for i in range(3))
    assert np.einsum("ij,ij->i", np.cross(a, b), c).sum() / 6 == pytest.approx(4 / 3 * np.pi * 1000, rel=0.05)


def test_normals_of_a_sphere_point_outwards():
    mesh = Mesh.from_polydata(sphere())
    outwards = (mesh.vertices_mm - [30, -20, 5]) / 10
    assert (mesh.vertex_normals() * outwards).sum(axis=1).min() > 0.999


def test_normals_are_weighted_by_area():
    """A large triangle facing z and a small one facing x share a vertex: areas 50 and 0.5 mm2."""
    vertices = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 1, 0], [0, 0, 1], [9, 9, 9]], float)
    normals = Mesh(vertices, np.array([[0, 1, 2], [0, 3, 4]])).vertex_normals()
    assert normals[0] == pytest.approx(np.array([0.5, 0, 50]) / np.hypot(0.5, 50))
    assert (normals[5] == 0).all()  # a vertex of no triangle: no division by zero


def test_vtp_keeps_every_digit(tmp_path):
    rng = np.random.default_rng(0)
    mesh = Mesh(rng.normal(0, 30, (18, 3)), rng.permutation(18).reshape(6, 3).astype(np.int64))
    write_vtp(tmp_path / "ä.vtp", mesh)
    back = read_mesh(tmp_path / "ä.vtp", "mesh")
    assert np.array_equal(back.vertices_mm, mesh.vertices_mm)
    assert np.array_equal(back.triangles, mesh.triangles)


def test_polydata_carries_normals_and_its_own_memory():
    mesh = Mesh.from_polydata(sphere())
    polydata = Mesh(mesh.vertices_mm.copy(), mesh.triangles.copy()).to_polydata()  # arrays die at once
    assert np.array_equal(Mesh.from_polydata(polydata).triangles, mesh.triangles)
    assert np.array_equal(Mesh.from_polydata(polydata).vertices_mm, mesh.vertices_mm)
    assert polydata.GetPointData().GetNormals().GetTuple3(7) == pytest.approx(mesh.vertex_normals()[7], abs=1e-6)


@pytest.mark.parametrize(
    "cells",
    [{"polygons": [(0, 1, 2, 3)]}, {"strips": [(0, 1, 3, 2)]}, {"polygons": [(0, 1, 2), (0, 2, 3), (1, 1, 2)]}],
    ids=["quad", "strip", "degenerate"],
)
def test_quads_and_strips_are_split_and_degenerate_triangles_dropped(tmp_path, cells):
    mesh = read_mesh(save(polydata_of(SQUARE, lines=[(0, 2)], **cells), tmp_path / "a.vtp"), "mesh")
    assert mesh.triangles.shape == (2, 3)
    a, b, c = (mesh.vertices_mm[mesh.triangles[:, i]] for i in range(3))
    assert np.cross(b - a, c - a)[:, 2].tolist() == [100.0, 100.0]  # both counter-clockwise, whole square


@pytest.mark.parametrize(
    ("polydata", "words"),
    [
        (polydata_of(SQUARE, lines=[(0, 1, 2)]), "no triangles"),
        (polydata_of([]), "no triangles"),
        (sphere(0.02, (0, 0, 0)), "metres"),
        (sphere(5000.0), "2000 mm"),
        (polydata_of([*SQUARE[:3], (float("nan"), 0, 0)], polygons=[(0, 1, 2), (0, 2, 3)]), "not numbers"),
        (polydata_of(SQUARE, polygons=[(0, 1, 9)]), "does not exist"),
    ],
    ids=["lines", "empty", "metres", "huge", "nan", "index"],
)
def test_unusable_meshes_are_refused(tmp_path, polydata, words):
    path = save(polydata, tmp_path / "a.vtp")
    with pytest.raises(InputError, match=words) as caught:
        read_mesh(path, "vessel mesh")
    assert str(path) in str(caught.value) and "vessel mesh" in str(caught.value)


@pytest.mark.parametrize("share", [0.0, 0.02, 0.3, 0.6, 0.9, 0.97])
@pytest.mark.parametrize("suffix", list(WRITERS))
def test_a_file_cut_short_is_never_taken_for_a_whole_one(tmp_path, capfd, suffix, share):
    for binary in (True, False):
        data = save(sphere(), tmp_path / f"whole.{suffix}", binary).read_bytes()
        path = tmp_path / f"cut.{suffix}"
        path.write_bytes(data[: int(len(data) * share)])
        with pytest.raises(InputError, match="cut"):
            read_mesh(path, "vessel mesh")
    assert capfd.readouterr().err == ""  # VTK's own messages stay off the terminal


@pytest.mark.parametrize("suffix", list(WRITERS))
def test_a_file_whose_second_half_was_never_written_is_refused(tmp_path, suffix):
    """A drive that is pulled out leaves zeros: half of the vessels would be gone without a word."""
    for binary in (True, False):
        data = save(sphere(), tmp_path / f"whole.{suffix}", binary).read_bytes()
        (tmp_path / f"zeros.{suffix}").write_bytes(data[: len(data) // 2].ljust(len(data), b"\0"))
        with pytest.raises(InputError, match=r"zeros\."):
            read_mesh(tmp_path / f"zeros.{suffix}", "vessel mesh")


def test_a_binary_stl_cut_short_is_refused_by_a_vtk_that_takes_it(tmp_path, monkeypatch):
    """As that of Slicer 5.8 does: of a vessel tree the first half was the whole."""
    from vtkmodules import vtkIOGeometry

    whole = save(sphere(), tmp_path / "whole.stl", True)
    half = tmp_path / "half.stl"
    half.write_bytes(whole.read_bytes()[:-50])
    reader = type(
        "Reader", (), {"SetFileName": lambda *_: None, "Update": lambda _: None, "GetOutput": lambda _: sphere()}
    )
    monkeypatch.setattr(vtkIOGeometry, "vtkSTLReader", reader)
    assert len(read_mesh(whole, "vessel mesh").triangles)
    with pytest.raises(InputError, match="cut"):
        read_mesh(half, "vessel mesh")


@pytest.mark.parametrize(("name", "words"), [("none.vtp", "not found"), ("scan.nii.gz", "unknown format")])
def test_missing_and_unknown_files(tmp_path, name, words):
    (tmp_path / "scan.nii.gz").write_bytes(b"x")
    with pytest.raises(InputError, match=words):
        read_mesh(tmp_path / name, "vessel mesh")


def test_space_is_read_from_the_header(tmp_path):
    for space in ("LPS", "RAS"):
        path = tmp_path / f"{space}.vtk"
        writer = vtk.vtkPolyDataWriter()
        writer.SetInputData(sphere())
        writer.SetHeader(f"3D Slicer output. SPACE={space}")
        writer.SetFileName(str(path))
        writer.Write()
        assert declared_space(path) == space
        write_vtp(tmp_path / f"{space}.vtp", Mesh.from_polydata(sphere()), space)
        assert declared_space(tmp_path / f"{space}.vtp") == space
        (tmp_path / f"{space}.vtp").rename(tmp_path / f"{space}-UPPER.VTP")
        assert declared_space(tmp_path / f"{space}-UPPER.VTP") == space
    assert declared_space(save(sphere(), tmp_path / "plain.vtk")) is None
    assert declared_space(save(sphere(), tmp_path / "plain.vtp")) is None
    assert declared_space(tmp_path / "none.vtp") is None


def test_3d_slicer_reads_the_space_that_was_written(tmp_path):
    """slicer-core loads a RAS file as it is and turns an LPS file into its own RAS."""
    slicer = pytest.importorskip("slicer", reason="slicer-core is not installed")
    if not hasattr(slicer, "vtkMRMLModelStorageNode"):
        pytest.skip("this slicer package has no MRML")
    for space, x_mm in (("RAS", 30.0), ("LPS", -30.0)):
        write_vtp(tmp_path / "a.vtp", Mesh.from_polydata(sphere()), space)
        node, storage = slicer.vtkMRMLModelNode(), slicer.vtkMRMLModelStorageNode()
        storage.SetFileName(str(tmp_path / "a.vtp"))
        assert storage.ReadData(node)
        assert Mesh.from_polydata(node.GetPolyData()).centroid_mm[0] == pytest.approx(x_mm, abs=1e-3)
        storage.SetFileName(str(tmp_path / "b.vtp"))
        storage.SetCoordinateSystem(storage.CoordinateSystemRAS)
        assert storage.WriteData(node)
        assert declared_space(tmp_path / "b.vtp") == "RAS"


def test_points_of_what_was_cut_away_are_no_vertices(tmp_path):
    """As some programs leave them where faces were deleted: a patch that was cut out of a head lay in its middle."""
    patch = dome(side_mm=20.0, cells=6)
    far = np.random.default_rng(0).normal(0.0, 90.0, (300, 3))
    polydata = Mesh(np.vstack([far, patch.vertices_mm]), patch.triangles + len(far)).to_polydata()
    mesh = read_mesh(save(polydata, tmp_path / "a.vtp"), "mesh")
    assert mesh.radius_mm == pytest.approx(patch.radius_mm)
    np.testing.assert_allclose(mesh.centroid_mm, patch.centroid_mm, atol=1e-6)
    np.testing.assert_allclose(mesh.vertices_mm[mesh.triangles], patch.vertices_mm[patch.triangles], atol=1e-5)


def test_a_simplified_surface_has_few_triangles_and_stays_where_it_was():
    """A sphere of 30 mm in triangles of 10 mm2: against the sphere itself, and its area."""
    source = vtk.vtkSphereSource()
    source.SetRadius(30)
    source.SetThetaResolution(200)
    source.SetPhiResolution(200)
    source.Update()
    fine = Mesh.from_polydata(source.GetOutput())
    assert fine.area_mm2 == pytest.approx(4 * np.pi * 900, rel=1e-3)
    coarse = fine.simplified(10.0)
    assert len(coarse.triangles) == pytest.approx(fine.area_mm2 / 10, rel=0.02) and len(fine.triangles) > 70_000
    middles = coarse.vertices_mm[coarse.triangles].mean(axis=1)
    assert np.abs(np.linalg.norm(middles, axis=1) - 30).max() < 0.3
    assert coarse.simplified(10.0 * coarse.area_mm2 / fine.area_mm2 / 1.1) is coarse


def test_triangles_with_vertices_of_their_own_are_one_surface(tmp_path):
    """An .obj file with a normal for each face: its outline was every edge, and simplified it fell apart."""
    whole = dome(side_mm=20.0, cells=12)
    a, b, c = (whole.vertices_mm[whole.triangles[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    lines = ["v {} {} {}".format(*v) for v in whole.vertices_mm] + ["vn {} {} {}".format(*n) for n in normals]
    lines += ["f " + " ".join(f"{v + 1}//{i + 1}" for v in t) for i, t in enumerate(whole.triangles)]
    (tmp_path / "dome.obj").write_text("\n".join(lines))
    mesh = read_mesh(tmp_path / "dome.obj", "mesh")
    assert len(mesh.vertices_mm) == len(whole.vertices_mm)
    np.testing.assert_allclose(mesh.vertices_mm[mesh.triangles], whole.vertices_mm[whole.triangles], atol=1e-5)
    above = look_at(np.array([0, 0, 90.0]), np.zeros(3), np.array([0, 1.0, 0]))
    assert len(Silhouette(mesh.vertices_mm, mesh.triangles).edges(above)) == 4 * 12
    assert mesh.simplified(5.0).area_mm2 == pytest.approx(whole.area_mm2, rel=0.05)
