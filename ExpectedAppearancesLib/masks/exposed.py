"""The part of the vessels that can be seen: what rises above the parenchyma."""

from __future__ import annotations

import numpy as np

from ..case.meshes import Mesh


def exposed_vessels(vessels: Mesh, parenchyma: Mesh, outward_axis: np.ndarray) -> Mesh:
    """`vessels` cut where they enter the parenchyma; all of them where nothing would be left. Both in world mm."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkFiltersCore import vtkClipPolyData, vtkImplicitPolyDataDistance

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
