"""Slice and 3D views of slicer-core, off-screen, for tests: scene, application logic, displayable managers; no Qt."""

from __future__ import annotations

import tempfile

import numpy as np

THREE_D_MANAGERS = (
    "vtkMRMLCameraDisplayableManager",
    "vtkMRMLViewDisplayableManager",
    "vtkMRMLModelDisplayableManager",
)


def new_application():
    """An empty scene and its application logic. The order of the calls matters to Slicer."""
    import slicer
    import vtk

    scene = slicer.vtkMRMLScene()
    logic = slicer.vtkSlicerApplicationLogic()
    logic.SetMRMLScene(scene)
    logic.GetColorLogic().SetMRMLScene(scene)
    logic.GetColorLogic().AddDefaultColorNodes()  # without them volumes have no colours
    logic.SetSliceLogics(vtk.vtkCollection())
    logic.SetViewLogics(vtk.vtkCollection())
    slicer.vtkMRMLThreeDViewDisplayableManagerFactory.GetInstance().SetMRMLApplicationLogic(logic)
    slicer.vtkMRMLSliceViewDisplayableManagerFactory.GetInstance().SetMRMLApplicationLogic(logic)
    sequences = slicer.vtkSlicerSequencesLogic()  # makes its node classes known to the scene
    sequences.SetMRMLScene(scene)
    logic.sequences = sequences
    remote = slicer.vtkMRMLRemoteIOLogic()  # where bundles within bundles are unpacked
    remote.GetCacheManager().SetRemoteCacheDirectory(tempfile.mkdtemp(prefix="scene-cache-"))
    remote.SetMRMLScene(scene)
    remote.AddDataIOToScene()
    io = slicer.vtkDataIOManagerLogic()
    io.SetMRMLApplicationLogic(logic)
    io.SetAndObserveDataIOManager(remote.GetDataIOManager())
    logic.remote, logic.io = remote, io
    slicer.vtkMRMLSliceNode.AddDefaultSliceOrientationPresets(scene, True)
    return scene, logic


class _View:
    def _open(self, size, factory, application, managers, node_maker):
        import slicer
        import vtk

        self.renderer = vtk.vtkRenderer()
        self.window = vtk.vtkRenderWindow()
        self.window.SetOffScreenRendering(1)
        self.window.SetMultiSamples(0)
        self.window.SetSize(*size)
        self.window.AddRenderer(self.renderer)
        self._interactor = vtk.vtkRenderWindowInteractor()  # displayable managers need one
        self._interactor.SetRenderWindow(self.window)
        self._interactor.Initialize()
        factory.SetMRMLApplicationLogic(application)
        for name in managers:
            if not factory.IsDisplayableManagerRegistered(name):
                factory.RegisterDisplayableManager(name)
        self.node = node_maker()
        self.group = slicer.vtkMRMLDisplayableManagerGroup()
        self.group.SetRenderer(self.renderer)
        self.group.Initialize(factory, self.renderer)
        self.group.SetMRMLDisplayableNode(self.node)

    def pixels(self) -> np.ndarray:
        """uint8 RGB (H, W, 3) of the view, drawn anew; row 0 on top."""
        import vtk
        from vtk.util.numpy_support import vtk_to_numpy

        self.window.Render()
        data = vtk.vtkUnsignedCharArray()
        width, height = self.window.GetSize()
        self.window.GetPixelData(0, 0, width - 1, height - 1, 0, data, 0)
        return vtk_to_numpy(data).reshape(height, width, 3)[::-1].copy()


class SliceView(_View):
    def __init__(self, scene, application, name, size):
        import slicer
        import vtk

        self.logic = slicer.vtkMRMLSliceLogic()
        self.logic.SetMRMLApplicationLogic(application)
        application.GetSliceLogics().AddItem(self.logic)
        self.logic.SetMRMLScene(scene)
        factory = slicer.vtkMRMLSliceViewDisplayableManagerFactory.GetInstance()
        managers = ("vtkMRMLModelSliceDisplayableManager",)
        self._open(size, factory, application, managers, lambda: self.logic.AddSliceNode(name))
        self.renderer.GetActiveCamera().ParallelProjectionOn()
        self.logic.ResizeSliceNode(*size)
        # Slicer's own view blends the layers; slicer-core has none, so its blend is drawn behind the models.
        mapper = vtk.vtkImageMapper()
        mapper.SetColorWindow(255)
        mapper.SetColorLevel(127.5)
        mapper.SetInputConnection(self.logic.GetImageDataConnection())
        self._image = vtk.vtkActor2D()
        self._image.SetMapper(mapper)
        self._image.GetProperty().SetDisplayLocationToBackground()

    @property
    def composite(self):
        return self.logic.GetSliceCompositeNode()

    def draw_layers(self) -> None:
        """Call once layers are chosen: before, the blend has no image."""
        self._image.GetMapper().SetInputConnection(self.logic.GetImageDataConnection())
        if not self.renderer.HasViewProp(self._image):
            self.renderer.AddViewProp(self._image)


class ThreeDView(_View):
    def __init__(self, scene, application, name, size):
        import slicer

        self.logic = slicer.vtkMRMLViewLogic()
        self.logic.SetMRMLApplicationLogic(application)
        application.GetViewLogics().AddItem(self.logic)
        self.logic.SetMRMLScene(scene)
        factory = slicer.vtkMRMLThreeDViewDisplayableManagerFactory.GetInstance()
        self._open(size, factory, application, THREE_D_MANAGERS, lambda: self.logic.AddViewNode(name))
        self.node.SetBoxVisible(False)
        self.node.SetAxisLabelsVisible(False)

    @property
    def camera_node(self):
        return self.group.GetDisplayableManagerByClassName("vtkMRMLCameraDisplayableManager").GetCameraNode()
