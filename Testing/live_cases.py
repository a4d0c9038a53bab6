"""What the tests of the live panel in a scene share."""

from __future__ import annotations

import time

import numpy as np

from ExpectedAppearancesLib.demo.phantom import CAMERA
from ExpectedAppearancesLib.geometry.displacement import add_mm
from ExpectedAppearancesLib.live.choice import Choice, SourceKind

SMALL = CAMERA.resized(320, 240)


def node_with(scene, image):
    """A vector volume as an OpenIGTLink connector makes it: no geometry, pixels only."""
    node = scene.AddNewNodeByClass("vtkMRMLVectorVolumeNode", "Stream")
    send(node, image)
    return node


def send(node, image):
    from ExpectedAppearancesLib.mrml.vtk_data import set_image

    set_image(node, image)


def choice_of(phantom, **values) -> Choice:
    return Choice(**({"case_path": str(phantom.case.folder), "kind": SourceKind.NODE, "node_name": "Stream"} | values))


def wait_for(controller, condition, timeout_s=60.0):
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        status = controller.tick(0.005)
        if condition(status):
            return status
    raise AssertionError(f"did not happen: {controller.status}")


def add_of(phantom, true, predicted) -> float:
    return float(add_mm(phantom.case.vessels.vertices_mm, true[None], predicted[None])[0])


def camera_to_ras_of(node) -> np.ndarray:
    from vtk import vtkMatrix4x4

    matrix = vtkMatrix4x4()
    node.GetMatrixTransformToParent(matrix)
    return np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])


def shown_pixels(live) -> np.ndarray:
    from ExpectedAppearancesLib.mrml.live_stream import pixels_of

    return pixels_of(live.frame.GetImageData())


def record(controller, scene, phantom, model, images):
    """A recording of `images`, and what was predicted for each."""
    from ExpectedAppearancesLib.mrml import live_record

    stream = node_with(scene, images[0])
    controller.start(choice_of(phantom, stale_s=60), model=model)
    wait_for(controller, lambda s: s.new)
    controller.start_recording()
    poses = []
    for image in images:
        send(stream, image)
        prediction = wait_for(controller, lambda s: s.new).result.prediction
        poses.append(prediction)
    controller.stop()
    browser = live_record.recordings(scene)[-1]
    return browser, poses
