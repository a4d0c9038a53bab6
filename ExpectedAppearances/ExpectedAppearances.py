"""Planning panel of 3D Slicer: from a segmented vessel model to a validated model of one patient."""

import sys
from enum import Enum
from pathlib import Path
from typing import Annotated

import slicer
import vtk
from slicer import vtkMRMLDisplayableNode, vtkMRMLModelNode, vtkMRMLScalarVolumeNode
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


class ExpectedAppearances(ScriptedLoadableModule):
    """Description of the module."""

    def __init__(self, parent):
        ScriptedLoadableModule.__init__(self, parent)
        parent.title = _("Expected Appearances")
        parent.categories = [translate("qSlicerAbstractCoreModule", "IGT")]
        parent.dependencies = []
        parent.contributors = ["ExpectedAppearances developers"]
        parent.helpText = _(
            "Plans the registration of a surgical microscope to preoperative MRI: from the surface model of the "
            "cortical vessels it makes expected appearances of the cortex, trains this patient's model on them, and "
            "says how accurate it is. Work through the sections from above; each says what it still needs. "
            "Not for clinical use. See the "
            '<a href="https://github.com/ExpectedAppearances/SlicerExpectedAppearances/blob/main/docs/planning.md">'
            "guide</a>."
        )
        parent.acknowledgementText = _(
            "Method: N. Haouchine, R. Dorent, P. Juvekar, E. Torio, W. M. Wells III, T. Kapur, A. J. Golby, "
            "S. Frisken: Learning Expected Appearances for Intraoperative Registration during Neurosurgery, "
            "MICCAI 2023. This is an independent implementation."
        )


class _Choice(Enum):
    """A choice in the panel: `value` is stored in settings and options, `label` is shown."""

    def label(self):
        return _(CHOICE_LABELS[type(self).__name__][self.name])


class CameraSource(_Choice):
    FILE = "file"
    VIEW = "view"


class CraniotomySource(_Choice):
    FITTED = "fitted"
    MARKED = "marked"
    RECORDED = "recorded"


class Method(_Choice):
    SURFACE = "surface"
    IMAGE = "image"


class TrainingPreset(_Choice):
    QUICK = "quick"
    BEST = "best"
    PAPER = "paper"


class StudyProtocols(_Choice):
    BOTH = "strict,loto"
    STRICT = "strict"


class WhenClosing(_Choice):
    ASK = "ask"
    DETACH = "detach"
    END = "end"


CHOICE_LABELS = {
    "CameraSource": {"FILE": "a calibration file", "VIEW": "field of view and distance"},
    "CraniotomySource": {
        "FITTED": "fitted to the models",
        "MARKED": "a point or curve on the cortex",
        "RECORDED": "as saved in the case",
    },
    "Method": {"SURFACE": "whole surface (recommended)", "IMAGE": "one image for each pose (as in the paper)"},
    "TrainingPreset": {
        "QUICK": "quick: for a processor",
        "BEST": "best: finer, takes longer",
        "PAPER": "paper: for comparison only",
    },
    "StudyProtocols": {
        "BOTH": "unseen textures: at unseen and at seen poses",
        "STRICT": "unseen textures at unseen poses: half the time",
    },
    "WhenClosing": {
        "ASK": "ask (on quitting, work goes on)",
        "DETACH": "work goes on and is found again",
        "END": "work is ended; what is finished is kept",
    },
}


@parameterNodeWrapper
class ExpectedAppearancesParameterNode:
    """What the user chose; saved with the scene. Paths are text, since an empty pathlib.Path would be saved as '.'."""

    vesselsNode: vtkMRMLDisplayableNode  # a model or a segmentation
    vesselsSegmentId: str = ""
    cortexModel: vtkMRMLModelNode
    mriVolume: vtkMRMLScalarVolumeNode
    casePath: str = ""
    savedCasePath: str = ""  # the folder, once it has held a case: where that is gone, it is missed

    cameraSource: CameraSource = CameraSource.FILE
    calibrationPath: str = ""
    fieldOfViewMm: Annotated[float, WithinRange(1, 1000)] = 40.0
    viewedAtMm: Annotated[float, WithinRange(10, 2000)] = 300.0
    imageWidthPx: Annotated[int, WithinRange(32, 8192)] = 1920
    imageHeightPx: Annotated[int, WithinRange(32, 8192)] = 1080

    craniotomySource: CraniotomySource = CraniotomySource.FITTED
    craniotomyNode: vtkMRMLDisplayableNode  # markups: a point list or a closed curve
    tiltMaxDeg: Annotated[float, WithinRange(0, 90)] = 70.0
    rollMaxDeg: Annotated[float, WithinRange(0, 180)] = 45.0
    distanceAuto: bool = True
    nearestMm: Annotated[float, WithinRange(1, 2000)] = 200.0
    farthestMm: Annotated[float, WithinRange(1, 2000)] = 400.0
    lateralAuto: bool = True
    lateralMm: Annotated[float, WithinRange(0, 100)] = 5.0
    inViewPercent: Annotated[float, WithinRange(0, 100)] = 60.0
    poseCount: Annotated[int, WithinRange(1, 10000)] = 100
    seed: int = 0
    showCameras: bool = True
    lookThrough: bool = False
    poseIndex: Annotated[int, WithinRange(0, 9999)] = 0

    texturesPath: str = ""  # empty: the textures that ship

    method: Method = Method.SURFACE
    sizePx: Annotated[int, WithinRange(32, 2048)] = 384
    iterations: Annotated[int, WithinRange(1, 1000)] = 28

    preset: TrainingPreset = TrainingPreset.QUICK
    device: str = "auto"  # or "cpu", or "cuda:N"
    minutes: Annotated[float, WithinRange(0.1, 10000)] = 26.0

    studyProtocols: StudyProtocols = StudyProtocols.BOTH
    acceptedAddLimitMm: Annotated[float, WithinRange(0.1, 100)] = 1.5
    acceptedRightLimitPercent: Annotated[float, WithinRange(0, 100)] = 97.0
    acceptedLimitPercent: Annotated[float, WithinRange(0, 100)] = 20.0

    whenClosing: WhenClosing = WhenClosing.ASK


class ExpectedAppearancesWidget(ScriptedLoadableModuleWidget, VTKObservationMixin):
    """The panel: loads the .ui and hands everything else to PlanningPanel."""

    def __init__(self, parent=None):
        ScriptedLoadableModuleWidget.__init__(self, parent)
        VTKObservationMixin.__init__(self)
        self.logic = None
        self.panel = None
        self._parameterNode = None
        self._guiTag = None

    def setup(self):
        ScriptedLoadableModuleWidget.setup(self)
        uiWidget = slicer.util.loadUI(self.resourcePath("UI/ExpectedAppearances.ui"))
        self.layout.addWidget(uiWidget)
        self.ui = slicer.util.childWidgetVariables(uiWidget)
        uiWidget.setMRMLScene(slicer.mrmlScene)

        from ExpectedAppearancesLib.widgets.planning_panel import PlanningPanel

        self.logic = ExpectedAppearancesLogic()
        self.panel = PlanningPanel(self.ui, self.logic.session, slicer.mrmlScene)
        scene = slicer.mrmlScene
        self.addObserver(scene, scene.StartCloseEvent, self.onSceneStartClose)
        self.addObserver(scene, scene.EndCloseEvent, self.onSceneEndClose)
        self.addObserver(scene, scene.EndImportEvent, self.onSceneEndImport)
        self.addObserver(scene, scene.NodeAboutToBeRemovedEvent, self.onNodeGoes)
        slicer.app.connect("aboutToQuit()", self.onQuit)
        self.initializeParameterNode()
        if self.parent.isEntered:  # reloaded while it was shown
            self.panel.enter()

    def cleanup(self):
        if self.panel is None:
            return
        slicer.app.disconnect("aboutToQuit()", self.onQuit)
        self.setParameterNode(None)
        self.panel.cleanup()
        self.removeObservers()

    def enter(self):
        # Not at each visit: Slicer 5.8 lets go of no parameters that were ever bound, and each would hear every change.
        if self._parameterNode is None:
            self.initializeParameterNode()
        self.panel.enter()

    def exit(self):
        self.panel.exit()

    def onReload(self):
        for name in [name for name in sys.modules if name.split(".")[0] == "ExpectedAppearancesLib"]:
            del sys.modules[name]
        ScriptedLoadableModuleWidget.onReload(self)

    def onSceneStartClose(self, _caller, _event):
        self.panel.closing_scene()
        self.setParameterNode(None)

    def onSceneEndClose(self, _caller, _event):
        self.initializeParameterNode()

    def onSceneEndImport(self, _caller, _event):
        self.initializeParameterNode()

    @vtk.calldata_type(vtk.VTK_OBJECT)
    def onNodeGoes(self, _caller, _event, node):
        self.panel.let_go(node)

    def onQuit(self):
        self.panel.quitting()

    def initializeParameterNode(self):
        self.setParameterNode(self.logic.getParameterNode())

    def setParameterNode(self, parameterNode):
        if self._parameterNode:
            self._parameterNode.disconnectGui(self._guiTag)
            self.removeObserver(self._parameterNode, vtk.vtkCommand.ModifiedEvent, self.onParameterNodeModified)
        self._parameterNode = parameterNode
        self.panel.set_parameters(parameterNode, lambda: self._connectGui(parameterNode))

    def _connectGui(self, parameterNode):
        self._guiTag = parameterNode.connectGui(self.ui)
        self.addObserver(parameterNode, vtk.vtkCommand.ModifiedEvent, self.onParameterNodeModified)

    def onParameterNodeModified(self, _caller=None, _event=None):
        self.panel.refresh_soon()


class ExpectedAppearancesLogic(ScriptedLoadableModuleLogic):
    """Parameters of the panel, and the session that works on them; knows no Qt."""

    def __init__(self):
        ScriptedLoadableModuleLogic.__init__(self)
        from ExpectedAppearancesLib.mrml.planning_session import PlanningSession

        self.session = PlanningSession()

    def getParameterNode(self):
        return ExpectedAppearancesParameterNode(super().getParameterNode())


class ExpectedAppearancesTest(ScriptedLoadableModuleTest):
    """The panel in a real Slicer; the tests themselves are in the library, beside what they test."""

    def setUp(self):
        slicer.mrmlScene.Clear()

    def runTest(self):
        from ExpectedAppearancesLib.widgets import planning_selftest

        for test in planning_selftest.TESTS:
            self.setUp()
            self.delayDisplay(test.__name__)
            test(self)
        self.delayDisplay("Test passed")
