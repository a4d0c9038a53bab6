"""Both panels, opened in a fresh interpreter with stand-ins for Qt and Slicer."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]

STAND_INS = """
import sys, types
from unittest.mock import MagicMock

class Stub(types.ModuleType):
    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return MagicMock()

slicer = sys.modules["slicer"] = Stub("slicer")
for name in ("i18n", "util", "parameterNodeWrapper", "ScriptedLoadableModule"):
    sys.modules["slicer." + name] = Stub("slicer." + name)
sys.modules["slicer.i18n"].tr = lambda text: text
sys.modules["slicer.parameterNodeWrapper"].parameterNodeWrapper = lambda cls: cls
base = sys.modules["slicer.ScriptedLoadableModule"]
for name in ("", "Logic", "Widget", "Test"):
    members = {"__init__": lambda self, parent=None: None}
    setattr(base, "ScriptedLoadableModule" + name, type("Base" + name, (), members))
sys.modules["slicer.util"].VTKObservationMixin = type("Mixin", (), {})
for name in ("qt", "ctk"):
    sys.modules[name] = Stub(name)
sys.path.insert(0, sys.argv[1])
"""

OPEN_THE_PANEL = (
    STAND_INS
    + """
import ExpectedAppearances as module
logic = module.ExpectedAppearancesLogic()
from ExpectedAppearancesLib.widgets.planning_panel import PlanningPanel
panel = PlanningPanel(MagicMock(), logic.session, MagicMock())
parameters = module.ExpectedAppearancesParameterNode()
for name in ("vesselsNode", "cortexModel", "mriVolume", "craniotomyNode"):
    setattr(parameters, name, None)
panel.set_parameters(parameters, lambda: None)
panel.enter()
"""
)

OPEN_THE_LIVE_PANEL = (
    STAND_INS
    + """
import ExpectedAppearancesLive as module
from ExpectedAppearancesLib.widgets.live_panel import LivePanel

def parameter_node():
    node = module.ExpectedAppearancesLiveParameterNode()
    node.sourceNode = node.mriVolume = node.browser = None
    node.connectGui = node.disconnectGui = MagicMock()
    return node

controller = MagicMock(running=False)
panel = LivePanel(MagicMock(), controller)
panel.set_parameter_node(parameter_node())
"""
)


def in_the_panel(code: str, *arguments) -> str:
    """Run `code` where `panel`, the planning one, is open; what it asserts must hold. Returns what it printed."""
    return _ran(OPEN_THE_PANEL + code, *arguments)


def in_the_live_panel(code: str, *arguments) -> str:
    """The same with the live panel, whose `controller` is a stand-in too."""
    return _ran(OPEN_THE_LIVE_PANEL + code, *arguments)


def _ran(code: str, *arguments) -> str:
    command = [sys.executable, "-c", code, str(ROOT / "ExpectedAppearances"), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
