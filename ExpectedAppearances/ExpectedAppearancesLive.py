"""Module of 3D Slicer that shows the vessels of a case in the microscope's picture, frame by frame."""

import sys
from pathlib import Path
from typing import Annotated

import slicer
import vtk
from slicer.i18n import tr as _
from slicer.i18n import translate
from slicer.parameterNodeWrapper import WithinRange, parameterNodeWrapper
from slicer.ScriptedLoadableModule import (
    ScriptedLoadableModule,
    ScriptedLoadableModuleLogic,
    ScriptedLoadableModuleTest,
    ScriptedLoadableModuleWidget,
)
from slicer.util import VTKObservationMixin

# An installed package has the library beside this file; a source tree has it in the folder above.
if not (Path(__file__).resolve().parent / "ExpectedAppearancesLib").is_dir():
    _root = str(Path(__file__).resolve().parents[1])
    if _root not in sys.path:
        sys.path.append(_root)


class ExpectedAppearancesLive(ScriptedLoadableModule):
    """Description of the module."""

    def __init__(self, parent):
        ScriptedLoadableModule.__init__(self, parent)
        parent.title = _("Expected Appearances Live")
        parent.categories = [translate("qSlicerAbstractCoreModule", "IGT")]
        parent.dependencies = ["Cameras", "Markups", "Sequences"]
        parent.contributors = ["ExpectedAppearances developers"]
        parent.helpText = _(
            "Registers the pictures of a surgical microscope to the preoperative models of a case, one by one as they "
            "come, and shows the vessels where they are; or says why not. Train the case first in the module "
            "<i>Expected Appearances</i>. Not for clinical use. See the "
            '<a href="https://github.com/ExpectedAppearances/SlicerExpectedAppearances">documentation</a>.'
        )
        parent.acknowledgementText = _(
            "Method: N. Haouchine, R. Dorent, P. Juvekar, E. Torio, W. M. Wells III, T. Kapur, A. J. Golby, "
            "S. Frisken: Learning Expected Appearances for Intraoperative Registration during Neurosurgery, "
            "MICCAI 2023. This is an independent implementation."
        )
        slicer.app.connect("startupCompleted()", registerSampleData)


def registerSampleData():
    """Put the generated phantom into Slicer's Sample Data module."""
    import SampleData

    icon = Path(__file__).resolve().parent / "Resources" / "Icons" / "ExpectedAppearancesLive.png"
    SampleData.SampleDataLogic.registerCustomSampleDataSource(
        category="Expected Appearances",
        sampleName="ExpectedAppearancesLivePhantom",
        uris="",  # nothing is downloaded, but Slicer 5.8 counts them
        thumbnailFileName=str(icon),
        customDownloader=lambda _source=None: runSample(),
    )


def runSample():
    """Open this module and run it on the generated phantom; True when it runs."""
    from ExpectedAppearancesLib.widgets.live_sample import run_sample

    widget = slicer.util.getModuleWidget("ExpectedAppearancesLive")
    if slicer.util.mainWindow():
        slicer.util.selectModule("ExpectedAppearancesLive")
    else:
        widget.enter()
    return run_sample(widget.panel)


@parameterNodeWrapper
class ExpectedAppearancesLiveParameterNode:
    """What the user chose; paths are text, since an empty pathlib.Path would be shown and saved as '.'.

    cameraJson: intrinsics of the last frame, so that a view through the camera can be set up again: a 3D view's window
    centre is saved with no scene.
    """

    casePath: str = ""
    sourceKind: str = "path"
    sourcePath: str = ""
    device: str = "0"
    sourceNode: slicer.vtkMRMLVolumeNode
    cameraPath: str = ""
    cameraJson: str = ""
    cropBorders: bool = False
    flipRows: bool = False
    repeat: bool = False
    onlyNew: bool = False
    rateHz: Annotated[float, WithinRange(0.1, 100)] = 25.0
    longestPx: Annotated[int, WithinRange(256, 4096)] = 960
    staleMs: Annotated[int, WithinRange(50, 60000)] = 500
    steady: bool = False
    outline: bool = True
    fill: bool = True
    fillOpacity: Annotated[float, WithinRange(0, 1)] = 0.35
    box: bool = False
    mriVolume: slicer.vtkMRMLScalarVolumeNode
    limitMb: Annotated[int, WithinRange(64, 65536)] = 2048
    browser: slicer.vtkMRMLNode


class ExpectedAppearancesLiveWidget(ScriptedLoadableModuleWidget, VTKObservationMixin):
    """Hands what Slicer says on to the panel."""

    def __init__(self, parent=None):
        ScriptedLoadableModuleWidget.__init__(self, parent)
        VTKObservationMixin.__init__(self)
        self.logic = self.panel = None
        self._parameterNode = None

    def setup(self):
        from ExpectedAppearancesLib.widgets.live_panel import LivePanel

        ScriptedLoadableModuleWidget.setup(self)
        uiWidget = slicer.util.loadUI(self.resourcePath("UI/ExpectedAppearancesLive.ui"))
        self.layout.addWidget(uiWidget)
        self.ui = slicer.util.childWidgetVariables(uiWidget)
        uiWidget.setMRMLScene(slicer.mrmlScene)
        self.logic = ExpectedAppearancesLiveLogic()
        self.panel = LivePanel(self.ui, self.logic.controller)
        self.addObserver(slicer.mrmlScene, slicer.mrmlScene.StartCloseEvent, self.onSceneStartClose)
        self.addObserver(slicer.mrmlScene, slicer.mrmlScene.EndCloseEvent, self.onSceneEndClose)
        self.addObserver(slicer.mrmlScene, slicer.mrmlScene.EndImportEvent, self.onSceneEndClose)
        self.setParameterNode(self.logic.getParameterNode())
        if self.parent.isEntered:  # reloaded while it was shown
            self.panel.enter()

    def cleanup(self):
        self.setParameterNode(None)
        self.removeObservers()
        if self.panel:
            self.panel.close()

    def enter(self):
        # Not at each visit: Slicer 5.8 lets go of no parameters that were ever bound, and each would hear every change.
        if self._parameterNode is None:
            self.setParameterNode(self.logic.getParameterNode())
        self.panel.refresh()  # a model may have been trained meanwhile
        self.panel.enter()

    def exit(self):
        self.panel.leave()

    def onReload(self):
        self.panel.close()
        for name in [name for name in sys.modules if name.split(".")[0] == "ExpectedAppearancesLib"]:
            del sys.modules[name]
        ScriptedLoadableModuleWidget.onReload(self)

    def onSceneStartClose(self, _caller, _event):
        self.setParameterNode(None)
        self.panel.scene_closed()

    def onSceneEndClose(self, _caller, _event):
        self.setParameterNode(self.logic.getParameterNode())
        if self.parent.isEntered:
            self.panel.enter()

    def setParameterNode(self, parameterNode):
        if self._parameterNode:
            self.removeObserver(self._parameterNode, vtk.vtkCommand.ModifiedEvent, self.onParameterNodeModified)
        self._parameterNode = parameterNode
        self.panel.set_parameter_node(parameterNode)
        if parameterNode:
            self.addObserver(parameterNode, vtk.vtkCommand.ModifiedEvent, self.onParameterNodeModified)

    def onParameterNodeModified(self, _caller=None, _event=None):
        self.panel.refresh()


class ExpectedAppearancesLiveLogic(ScriptedLoadableModuleLogic):
    """Gives scripts the controller, which does the work and knows no Qt."""

    def __init__(self):
        from ExpectedAppearancesLib.mrml.live_controller import LiveController

        ScriptedLoadableModuleLogic.__init__(self)
        self.controller = LiveController(slicer.mrmlScene)

    def getParameterNode(self):
        return ExpectedAppearancesLiveParameterNode(super().getParameterNode())


class ExpectedAppearancesLiveTest(ScriptedLoadableModuleTest):
    """Runs in Slicer; its cases are with the panel."""

    def setUp(self):
        slicer.mrmlScene.Clear()

    def runTest(self):
        from ExpectedAppearancesLib.widgets.live_selftest import CASES

        for case in CASES:
            self.setUp()
            case(self)
            self.delayDisplay(f"{case.__name__} passed")
