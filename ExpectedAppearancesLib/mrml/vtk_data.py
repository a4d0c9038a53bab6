"""Between numpy arrays and the VTK objects that nodes hold."""

from __future__ import annotations

import numpy as np


def vtk_matrix(matrix: np.ndarray):
    """vtkMatrix4x4 of a 4x4 array."""
    from vtkmodules.vtkCommonMath import vtkMatrix4x4

    result = vtkMatrix4x4()
    result.DeepCopy(np.asarray(matrix, float).ravel().tolist())
    return result


def array_of(matrix) -> np.ndarray:
    """4x4 array of a vtkMatrix4x4."""
    return np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])


def image_data(pixels: np.ndarray):
    """vtkImageData of one slice from pixels (H, W) or (H, W, C), in memory of its own; row 0 of the image is row j = 0
    of the volume: no flip."""
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData

    height, width = pixels.shape[:2]
    data = vtkImageData()
    data.SetDimensions(width, height, 1)
    scalars = numpy_to_vtk(np.ascontiguousarray(pixels).reshape(height * width, -1), deep=True)
    scalars.SetName("ImageScalars")
    data.GetPointData().SetScalars(scalars)
    return data


def set_image(volume, image: np.ndarray) -> None:
    """New pixels uint8 (H, W, C) for a volume of one slice: into its own memory where the size is the same."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    height, width, components = image.shape
    data = volume.GetImageData()
    scalars = data.GetPointData().GetScalars() if data is not None else None
    same = scalars is not None and data.GetDimensions() == (width, height, 1)
    if same and scalars.GetNumberOfComponents() == components and scalars.GetDataTypeSize() == 1:
        vtk_to_numpy(scalars).reshape(-1, components)[:] = image.reshape(-1, components)
        scalars.Modified()
        data.Modified()
        return
    volume.SetAndObserveImageData(image_data(image))


def line_polydata(points_mm: np.ndarray, lines: np.ndarray):
    """vtkPolyData of points (P, 3) and lines (E, 2), in memory of its own."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    points = vtkPoints()
    points.SetData(numpy_to_vtk(np.ascontiguousarray(points_mm, np.float64), deep=True))
    cells = vtkCellArray()
    cells.SetData(
        numpy_to_vtkIdTypeArray(np.arange(0, 2 * len(lines) + 1, 2, dtype=np.int64), deep=True),
        numpy_to_vtkIdTypeArray(np.ascontiguousarray(lines.ravel(), np.int64), deep=True),
    )
    polydata = vtkPolyData()
    polydata.SetPoints(points)
    polydata.SetLines(cells)
    return polydata
