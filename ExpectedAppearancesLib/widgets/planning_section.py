"""What the sections of the planning panel have in common."""

from __future__ import annotations

from slicer.i18n import tr as _

from ..planning.steps import STEPS, Step, StepState
from .planning_qt import SYMBOLS, show_status


class Section:
    """One collapsible part of the panel, for one step of the work.

    `panel` has: ui, parameters (None while there is no scene), session, steps, runs, scene, refresh_soon().
    """

    name = ""
    title = ""

    def __init__(self, panel):
        self.panel = panel
        self.ui = panel.ui
        self._title_shown = ""
        self.setup()

    @property
    def parameters(self):
        return self.panel.parameters

    @property
    def session(self):
        return self.panel.session

    def setup(self) -> None:
        """Connect the section's widgets; called once."""

    def refresh(self) -> None:
        """Show the parameters and the state; called after every change. Must be cheap."""

    def leave(self) -> None:
        """The module is left: stop what only makes sense while it is seen."""

    def close(self) -> None:
        """The scene or the module is closed: let go of every node."""

    @property
    def button(self):
        return getattr(self.ui, f"{self.name}Section")

    @property
    def step(self) -> Step:
        return self.panel.steps.get(self.name, Step(StepState.MISSING, ""))

    def reason_of(self, name: str) -> str:
        """What keeps the step of another section from being done, in whose name it is said."""
        return f"{_(self.panel.sections[name].title)}: {self.panel.steps[name].text}"

    def show_step(self) -> None:
        """The state in the section's title and in its status line."""
        step = self.step
        text = f"{SYMBOLS[step.state]}  {STEPS.index(self.name) + 1}. {_(self.title)}"
        if text != self._title_shown:
            self._title_shown = text
            self.button.text = text
        show_status(getattr(self.ui, f"{self.name}Status"), step)


class NodeWatch:
    """Calls `action` when any of the given events happens to one node."""

    def __init__(self, action):
        self._action = action
        self._node = None
        self._tags: list[int] = []

    def watch(self, node, *events) -> None:
        """Watch this node, in place of the one before; None for none."""
        if node is self._node:
            return
        if self._node is not None:
            for tag in self._tags:
                self._node.RemoveObserver(tag)
        self._node = node
        self._tags = [node.AddObserver(event, lambda *_event: self._action()) for event in events] if node else []


def changed(parameters, name: str, value) -> bool:
    """Set a parameter only where it differs: every write modifies the node and redraws the panel."""
    if parameters is None or getattr(parameters, name) == value:
        return False
    try:
        setattr(parameters, name, value)
    except ValueError:  # outside of the parameter's bounds
        return False
    return True
