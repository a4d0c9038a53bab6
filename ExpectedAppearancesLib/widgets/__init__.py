"""The parts of the panels: the only place of the library that touches Qt, CTK and Slicer's widgets."""
