"""A coloured frame and a line of text over a view: whether what it shows may be trusted, seen from across the room."""

from __future__ import annotations

EDGE_PX = 6.0


class Banner:
    """Draws over a vtkRenderer. Nothing of it is in the scene; `remove` takes it away."""

    def __init__(self, renderer):
        import vtk

        self._renderer = renderer
        self._text = vtk.vtkTextActor()
        self._text.GetPositionCoordinate().SetCoordinateSystemToNormalizedViewport()
        self._text.SetPosition(0.5, 0.975)
        style = self._text.GetTextProperty()
        style.SetJustificationToCentered()
        style.SetVerticalJustificationToTop()
        style.SetBold(True)
        style.SetFontSize(18)
        style.SetColor(1, 1, 1)
        style.SetBackgroundOpacity(0.85)
        points = vtk.vtkPoints()
        for x, y in ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0)):
            points.InsertNextPoint(x, y, 0)
        lines = vtk.vtkCellArray()
        lines.InsertNextCell(5, range(5))
        square = vtk.vtkPolyData()
        square.SetPoints(points)
        square.SetLines(lines)
        viewport = vtk.vtkCoordinate()
        viewport.SetCoordinateSystemToNormalizedViewport()
        mapper = vtk.vtkPolyDataMapper2D()
        mapper.SetInputData(square)
        mapper.SetTransformCoordinate(viewport)
        self._edge = vtk.vtkActor2D()
        self._edge.SetMapper(mapper)
        self._edge.GetProperty().SetLineWidth(2 * EDGE_PX)
        self._put_on_top()
        self._said: tuple | None = None

    def say(self, text: str, rgb: tuple[float, float, float]) -> bool:
        """Show text (may be '') on the colour. True when that changed, and the view must be drawn again."""
        on_top = self._renderer.GetViewProps().GetLastProp() is self._text
        if not on_top:  # outlines came to the view since, and are drawn across the words
            self.remove()
            self._put_on_top()
        if on_top and self._said == (text, rgb):
            return False
        self._said = (text, rgb)
        self._text.SetInput(text or " ")
        self._text.SetVisibility(bool(text))
        self._text.GetTextProperty().SetBackgroundColor(*rgb)
        self._edge.GetProperty().SetColor(*rgb)
        return True

    def _put_on_top(self) -> None:
        for actor in (self._edge, self._text):
            self._renderer.AddViewProp(actor)

    def remove(self) -> None:
        for actor in (self._edge, self._text):
            self._renderer.RemoveViewProp(actor)
