"""Module of 3D Slicer that shows registered microscope frames on the models of their case."""

import importlib.util
import logging
import sys
from pathlib import Path

import numpy as np
import slicer
import vtk
from slicer.i18n import tr as _
from slicer.i18n import translate
from slicer.parameterNodeWrapper import parameterNodeWrapper
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

# On every node that the panel adds: "frame", or "case:" and the folder of the case.
SHOWN_ATTRIBUTE = "ExpectedAppearances.Shown"
SHOWN_FRAME = "frame"


class ExpectedAppearances(ScriptedLoadableModule):
    """Description of the module."""

    def __init__(self, parent):
        ScriptedLoadableModule.__init__(self, parent)
        parent.title = _("Expected Appearances")
        parent.categories = [translate("qSlicerAbstractCoreModule", "IGT")]
        parent.dependencies = []
        parent.contributors = ["ExpectedAppearances developers"]
        parent.helpText = _(
            "Shows microscope frames that the command <i>register</i> has registered to the preoperative models of a "
            "case: the frame on its image plane, the camera's frustum and the predicted outline of the vessels. "
            "Frames that the registration refused are not shown. Not for clinical use. See the "
            '<a href="https://github.com/ExpectedAppearances/SlicerExpectedAppearances">documentation</a>.'
        )
        parent.acknowledgementText = _(
            "Method: N. Haouchine, R. Dorent, P. Juvekar, E. Torio, W. M. Wells III, T. Kapur, A. J. Golby, "
            "S. Frisken: Learning Expected Appearances for Intraoperative Registration during Neurosurgery, "
            "MICCAI 2023. This is an independent implementation."
        )


@parameterNodeWrapper
class ExpectedAppearancesParameterNode:
    """What the user chose; paths are text, since an empty pathlib.Path would be shown and saved as '.'."""

    casePath: str = ""
    posesPath: str = ""
    frameIndex: int = 0


class ExpectedAppearancesWidget(ScriptedLoadableModuleWidget, VTKObservationMixin):
    """The panel: chooses, and says why it cannot show."""

    def __init__(self, parent=None):
        ScriptedLoadableModuleWidget.__init__(self, parent)
        VTKObservationMixin.__init__(self)
        self.logic = None
        self._parameterNode = None
        self._parameterNodeGuiTag = None

    def setup(self):
        ScriptedLoadableModuleWidget.setup(self)
        uiWidget = slicer.util.loadUI(self.resourcePath("UI/ExpectedAppearances.ui"))
        self.layout.addWidget(uiWidget)
        self.ui = slicer.util.childWidgetVariables(uiWidget)
        uiWidget.setMRMLScene(slicer.mrmlScene)
        self.logic = ExpectedAppearancesLogic()

        self.ui.casePathLineEdit.connect("currentPathChanged(QString)", self.onPathChanged)
        self.ui.posesPathLineEdit.connect("currentPathChanged(QString)", self.onPathChanged)
        self.ui.showButton.connect("clicked(bool)", self.onShow)
        self.addObserver(slicer.mrmlScene, slicer.mrmlScene.StartCloseEvent, self.onSceneStartClose)
        self.addObserver(slicer.mrmlScene, slicer.mrmlScene.EndCloseEvent, self.onSceneEndClose)
        self.initializeParameterNode()

    def cleanup(self):
        self.setParameterNode(None)
        self.removeObservers()

    def enter(self):
        self.initializeParameterNode()

    def exit(self):
        self.setParameterNode(None)

    def onReload(self):
        for name in [name for name in sys.modules if name.split(".")[0] == "ExpectedAppearancesLib"]:
            del sys.modules[name]
        ScriptedLoadableModuleWidget.onReload(self)

    def onSceneStartClose(self, _caller, _event):
        self.setParameterNode(None)

    def onSceneEndClose(self, _caller, _event):
        self.logic.hideAll()
        if self.parent.isEntered:
            self.initializeParameterNode()

    def initializeParameterNode(self):
        self.setParameterNode(self.logic.getParameterNode())

    def setParameterNode(self, parameterNode):
        if self._parameterNode:
            self._parameterNode.disconnectGui(self._parameterNodeGuiTag)
            self.removeObserver(self._parameterNode, vtk.vtkCommand.ModifiedEvent, self.onParameterNodeModified)
        self._parameterNode = parameterNode
        if self._parameterNode:
            self._parameterNodeGuiTag = self._parameterNode.connectGui(self.ui)
            self.addObserver(self._parameterNode, vtk.vtkCommand.ModifiedEvent, self.onParameterNodeModified)
            self.onParameterNodeModified()

    def onPathChanged(self, _path=None):
        if not self._parameterNode:
            return
        casePath, posesPath = self.ui.casePathLineEdit.currentPath, self.ui.posesPathLineEdit.currentPath
        # What is shown does not belong to the new choice.
        if casePath != self._parameterNode.casePath:
            self.logic.hideAll()
        elif posesPath != self._parameterNode.posesPath:
            self.logic.hideFrame()
        self._parameterNode.casePath = casePath
        self._parameterNode.posesPath = posesPath

    def onParameterNodeModified(self, _caller=None, _event=None):
        casePath, posesPath = self._parameterNode.casePath, self._parameterNode.posesPath
        for lineEdit, path in ((self.ui.casePathLineEdit, casePath), (self.ui.posesPathLineEdit, posesPath)):
            if lineEdit.currentPath != path:
                wasBlocked = lineEdit.blockSignals(True)
                lineEdit.currentPath = path
                lineEdit.blockSignals(wasBlocked)
        problem = self.logic.problem(casePath, posesPath)
        if not problem:
            self.ui.frameSpinBox.setRange(0, self.logic.frameCount(posesPath) - 1)
        self.ui.frameSpinBox.enabled = not problem
        self.ui.showButton.enabled = not problem
        self.ui.showButton.toolTip = problem or _("Show the frame in the 3D view and in the Red slice view.")
        self.ui.statusLabel.text = problem or self.logic.message

    def onShow(self):
        parameters = self._parameterNode
        # Unexpected errors are shown and logged; expected ones come back as text.
        with slicer.util.tryWithErrorDisplay(_("The frame could not be shown."), waitCursor=True):
            self.logic.show(parameters.casePath, parameters.posesPath, parameters.frameIndex)
        self.ui.statusLabel.text = self.logic.message


class ExpectedAppearancesLogic(ScriptedLoadableModuleLogic):
    """Checks what was chosen and shows one frame; knows no Qt."""

    def __init__(self):
        ScriptedLoadableModuleLogic.__init__(self)
        self.message = ""  # what the last show() has to tell the user
        self._posesRead = None  # (path, time of change), frames: the panel asks again at each change

    def getParameterNode(self):
        return ExpectedAppearancesParameterNode(super().getParameterNode())

    def problem(self, casePath, posesPath):
        """Why nothing can be shown, or ''."""
        from ExpectedAppearancesLib.errors import InputError

        if not casePath:
            return _("Choose a case folder.")
        if not (Path(casePath) / "case.json").is_file():
            return _("{path} is not a case folder: it holds no case.json.").format(path=casePath)
        if not posesPath:
            return _("Choose the poses.json that the command register wrote.")
        try:
            self._readPoses(posesPath)
        except InputError as error:
            return str(error)
        if importlib.util.find_spec("cv2") is None:
            return _(
                "OpenCV is not installed in this Slicer. Install it in the Python console with "
                "slicer.util.pip_install('opencv-python-headless')."
            )
        return ""

    def frameCount(self, posesPath):
        return len(self._readPoses(posesPath)[1])

    def show(self, casePath, posesPath, index):
        """Show one frame in the place of the last; `message` says what was done. True if the frame is shown.

        A frame that registration refused is not shown, and neither is one with an error: nothing old stays.
        """
        from ExpectedAppearancesLib.case.case import Case
        from ExpectedAppearancesLib.errors import ExpectedAppearancesError

        self.hideFrame()
        shown = False
        try:
            camera, frames = self._readPoses(posesPath)
            if not 0 <= index < len(frames):
                self.message = _("There is no frame {index}; the poses file has {count}.").format(
                    index=index, count=len(frames)
                )
                return False
            frame = frames[index]
            names = {"index": index, "name": frame.image.name}
            if not frame.accepted:
                self.message = _("Frame {index} ({name}) was refused by the registration and is not shown.").format(
                    **names
                )
                return False
            case = Case.open(casePath)
            self._showCase(case)
            self._showFrame(case, camera or case.camera, frame)
            self.message = _("Frame {index} ({name}) is shown.").format(**names)
            shown = True
        except ExpectedAppearancesError as error:
            logging.warning("Expected Appearances: %s", error)
            self.message = str(error)
        finally:
            if not shown:
                self._removeShown(lambda mark: mark == SHOWN_FRAME)
        return shown

    def hideFrame(self):
        self.message = ""
        self._removeShown(lambda mark: mark == SHOWN_FRAME)

    def hideAll(self):
        self.message = ""
        self._removeShown(lambda _mark: True)

    def _showCase(self, case):
        from ExpectedAppearancesLib.mrml import scene

        key = "case:" + case.folder.as_posix()
        self._removeShown(lambda mark: mark.startswith("case:") and mark != key)
        if key not in self._shown().values():
            self._addMarked(key, lambda: scene.add_case_models(slicer.mrmlScene, case))

    def _showFrame(self, case, camera, frame):
        from ExpectedAppearancesLib import files
        from ExpectedAppearancesLib.geometry.pose import camera_to_ras
        from ExpectedAppearancesLib.geometry.silhouette import Silhouette
        from ExpectedAppearancesLib.mrml import scene

        image = files.read_image_rgb(frame.image)
        camera = camera.resized(image.shape[1], image.shape[0])
        pose = frame.camera_from_world
        plane_mm = scene.plane_depth_mm(case.vessels, pose)
        cameraToRas = camera_to_ras(pose, case.space)
        silhouette = Silhouette(case.vessels.vertices_mm, case.vessels.triangles)

        def add():
            parent = scene.add_camera_transform(slicer.mrmlScene, cameraToRas)
            volume = scene.add_frame(slicer.mrmlScene, image, camera, plane_mm, parent)
            scene.add_frustum(slicer.mrmlScene, camera, plane_mm, parent)
            scene.add_outline(slicer.mrmlScene, silhouette, pose, plane_mm, parent)
            return volume

        volume = self._addMarked(SHOWN_FRAME, add)
        self._lookAtFrame(volume, camera, plane_mm, cameraToRas)

    def _lookAtFrame(self, volume, camera, plane_mm, cameraToRas):
        """Turn the Red slice, where there is one, to the image plane, and draw it in 3D."""
        from ExpectedAppearancesLib.mrml import scene

        sliceNode = slicer.mrmlScene.GetNodeByID("vtkMRMLSliceNodeRed")
        compositeNode = slicer.mrmlScene.GetNodeByID("vtkMRMLSliceCompositeNodeRed")
        if sliceNode is None or compositeNode is None:
            return
        planeToCamera = np.diag([1.0, -1.0, -1.0, 1.0])  # the slice's y points up, the camera's down
        # Slice views sample at the corners of their pixels: with this pixel at the origin the frame stays sharp.
        planeToCamera[:, 3] = scene.camera_from_pixel(camera, plane_mm) @ [
            camera.width / 2,
            camera.height / 2 - 1,
            0,
            1,
        ]
        slicer.util.updateVTKMatrixFromArray(sliceNode.GetSliceToRAS(), cameraToRas @ planeToCamera)
        sliceNode.UpdateMatrices()
        width, height = plane_mm * camera.width / camera.fx, plane_mm * camera.height / camera.fy
        viewWidth, viewHeight = sliceNode.GetDimensions()[:2]
        # The whole frame in the view, with square pixels whatever the view's shape.
        mmPerPixel = max(width / max(viewWidth, 1), height / max(viewHeight, 1))
        sliceNode.SetFieldOfView(mmPerPixel * viewWidth, mmPerPixel * viewHeight, sliceNode.GetFieldOfView()[2])
        sliceNode.SetSliceVisible(True)
        compositeNode.SetBackgroundVolumeID(volume.GetID())

    def _addMarked(self, mark, add):
        """Run `add` and mark all nodes that it added, display nodes too, also when it fails."""
        before = {node.GetID() for node in self._nodes()}
        try:
            return add()
        finally:
            for node in self._nodes():
                if node.GetID() not in before:
                    node.SetAttribute(SHOWN_ATTRIBUTE, mark)

    def _removeShown(self, matches):
        for node, mark in self._shown().items():
            if matches(mark) and slicer.mrmlScene.IsNodePresent(node):
                slicer.mrmlScene.RemoveNode(node)

    def _shown(self):
        marks = {node: node.GetAttribute(SHOWN_ATTRIBUTE) for node in self._nodes()}
        return {node: mark for node, mark in marks.items() if mark}

    def _nodes(self):
        collection = slicer.mrmlScene.GetNodes()
        return [collection.GetItemAsObject(i) for i in range(collection.GetNumberOfItems())]

    def _readPoses(self, posesPath):
        from ExpectedAppearancesLib.registration.poses_file import read_poses

        path = Path(posesPath)
        version = (posesPath, path.stat().st_mtime_ns if path.is_file() else None)
        if self._posesRead is None or self._posesRead[0] != version:
            self._posesRead = (version, read_poses(path))
        return self._posesRead[1]


class ExpectedAppearancesTest(ScriptedLoadableModuleTest):
    """Clicks through the panel on empty input and on a generated case."""

    def setUp(self):
        slicer.mrmlScene.Clear()

    def runTest(self):
        self.setUp()
        self.test_panelSaysWhyItIsDisabled()
        self.setUp()
        self.test_showsAcceptedFramesOnly()

    def test_panelSaysWhyItIsDisabled(self):
        widget = slicer.util.getModuleWidget("ExpectedAppearances")
        if slicer.util.mainWindow(verbose=False):
            slicer.util.selectModule("ExpectedAppearances")
        else:
            widget.enter()
        widget.ui.casePathLineEdit.currentPath = ""
        widget.ui.posesPathLineEdit.currentPath = ""
        self.assertFalse(widget.ui.showButton.enabled)
        self.assertEqual(widget.ui.statusLabel.text, _("Choose a case folder."))

        folder = Path(slicer.app.temporaryPath)
        widget.ui.casePathLineEdit.currentPath = str(folder)
        self.assertFalse(widget.ui.showButton.enabled)
        self.assertIn("case.json", widget.ui.statusLabel.text)
        widget.ui.casePathLineEdit.currentPath = ""

    def test_showsAcceptedFramesOnly(self):
        if importlib.util.find_spec("cv2") is None:
            self.delayDisplay("Skipped: OpenCV is not installed in this Slicer.")
            return
        import tempfile

        with tempfile.TemporaryDirectory() as folder:
            self._showGeneratedCase(Path(folder))
        self.delayDisplay("Test passed")

    def _showGeneratedCase(self, folder):
        casePath, posesPath = _writeTinyCase(folder)
        logic = ExpectedAppearancesLogic()
        self.assertEqual(logic.problem(casePath, posesPath), "")
        self.assertEqual(logic.frameCount(posesPath), 2)

        for _repeat in range(2):
            self.assertTrue(logic.show(casePath, posesPath, 0), logic.message)
            self.assertEqual(self._frameVolumes(), 1)
        self.assertFalse(logic.show(casePath, posesPath, 1))
        self.assertIn("refused.png", logic.message)
        self.assertEqual(self._frameVolumes(), 0)

    def _frameVolumes(self):
        return slicer.mrmlScene.GetNumberOfNodesByClass("vtkMRMLVectorVolumeNode")


def _writeTinyCase(folder):
    """A sphere seen from 300 mm, in an accepted and a refused frame; paths of the case and of its poses."""
    from ExpectedAppearancesLib import files
    from ExpectedAppearancesLib.case.case import Case
    from ExpectedAppearancesLib.case.meshes import Mesh, write_vtp
    from ExpectedAppearancesLib.geometry.camera import Camera
    from ExpectedAppearancesLib.geometry.pose import look_at
    from ExpectedAppearancesLib.registration.poses_file import write_poses

    source = vtk.vtkSphereSource()
    source.SetRadius(15.0)
    source.Update()
    write_vtp(folder / "sphere.vtp", Mesh.from_polydata(source.GetOutput()))
    camera = Camera(64, 48, 90.0, 90.0, 33.0, 22.0)
    case = Case.create(folder / "case", folder / "sphere.vtp", None, camera)
    pose = look_at(np.array([0.0, 0.0, 300.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    frames = []
    for name, accepted in (("accepted.png", True), ("refused.png", False)):
        files.write_png(folder / name, np.full((48, 64, 3), 128, np.uint8))
        frames.append({"image": folder / name, "camera_from_world": pose, "accepted": accepted})
    write_poses(folder / "poses.json", camera, frames)
    return str(case.folder), str(folder / "poses.json")
