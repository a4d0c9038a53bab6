"""Changes of the scene that belong together are drawn together."""

from __future__ import annotations

import functools


def at_once(method):
    """Nothing is drawn before the method is through; its object gives the context for that as `drawing_held()`.

    A busy Slicer draws a view at the first change of a node already: a frame with the pose before it. It then draws
    that view again at each of the next changes, which holds the GUI up.
    """

    @functools.wraps(method)
    def whole(self, *args, **kwargs):
        with self.drawing_held():
            return method(self, *args, **kwargs)

    return whole
