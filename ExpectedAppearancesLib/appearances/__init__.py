"""S_Theta: expected appearances, made by one of these methods (appearances.stage)."""

METHODS = ("surface", "image")
