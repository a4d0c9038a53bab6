"""The part of the vessels that can be seen: what rises above the parenchyma."""

from __future__ import annotations

import numpy as np

from ..case.meshes import Mesh


def exposed_vessels(vessels: Mesh, parenchyma: Mesh, outward_axis: np.ndarray) -> Mesh:
    """`vessels` cut where they enter the parenchyma, all of them where nothing would be left; their triangles face
    outwards. Both in world mm."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkFiltersCore import vtkClipPolyData, vtkImplicitPolyDataDistance

    vessels = _facing_outwards(vessels, outward_axis)
    surface = vtkImplicitPolyDataDistance()
    surface.SetInput(parenchyma.to_polydata())
    height_mm = np.array([surface.EvaluateFunction(vertex) for vertex in vessels.vertices_mm])
    # The sign follows the mesh's normals. Which way they point tells a place that is outside for certain: their mean
    # does not where the surface is closed, as a segment's is.
    if surface.EvaluateFunction(vessels.centroid_mm + outward_axis * vessels.radius_mm) < 0:
        height_mm = -height_mm
    if not (height_mm > 0).any():
        return vessels
    polydata = vessels.to_polydata()
    polydata.GetPointData().SetScalars(numpy_to_vtk(height_mm, deep=True))
    clip = vtkClipPolyData()
    clip.SetInputData(polydata)
    clip.SetValue(0.0)
    clip.Update()
    return Mesh.from_polydata(clip.GetOutput())


def _facing_outwards(vessels: Mesh, outward_axis: np.ndarray) -> Mesh:
    """With the triangles of each piece turned where they face inwards, as a mirroring leaves them: the border on the
    far side of such vessels would be taken for a part of the outline."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count, sides = len(vessels.vertices_mm), np.vstack([vessels.triangles[:, :2], vessels.triangles[:, 1:]])
    joined = coo_matrix((np.ones(len(sides), bool), sides.T), (count, count))
    pieces, piece_of_vertex = connected_components(joined, directed=False)
    piece = piece_of_vertex[vessels.triangles[:, 0]]
    # The volume inside, seen from below: where the surface is open there, what lies below it counts as well.
    below_mm = vessels.centroid_mm - outward_axis * vessels.radius_mm
    a, b, c = (vessels.vertices_mm[vessels.triangles[:, i]] - below_mm for i in range(3))
    is_inwards = np.bincount(piece, np.einsum("ij,ij->i", a, np.cross(b, c)), pieces)[piece] < 0
    return Mesh(vessels.vertices_mm, np.where(is_inwards[:, None], vessels.triangles[:, ::-1], vessels.triangles))
