"""Frames that come over OpenIGTLink, and poses that go out: real messages on the loopback interface."""

from __future__ import annotations

import socket
import time

import numpy as np
import pytest

pyigtl = pytest.importorskip("pyigtl", reason="pyigtl is not installed")
slicer = pytest.importorskip("slicer")

from mrml_views import new_application  # noqa: E402
from test_live_controller import SMALL, add_of, camera_to_ras_of, choice_of, send, wait_for  # noqa: E402

from ExpectedAppearancesLib.demo.phantom import PhantomPainter, covered_frame, make_phantom  # noqa: E402
from ExpectedAppearancesLib.live.estimator import open_model  # noqa: E402
from ExpectedAppearancesLib.live.trust import Sight  # noqa: E402
from ExpectedAppearancesLib.mrml.live_controller import LiveController  # noqa: E402


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def link():
    """A server, as a frame grabber's program is one, and a client, as Slicer's connector is one."""
    port = free_port()
    server = pyigtl.OpenIGTLinkServer(port=port, local_server=True)
    client = pyigtl.OpenIGTLinkClient(host="127.0.0.1", port=port)
    end = time.monotonic() + 60
    while not (server.is_connected() and client.is_connected()):
        assert time.monotonic() < end, "no connection on the loopback interface"
        time.sleep(0.01)
    yield server, client
    client.stop()
    server.stop()


def passed_on(sender, receiver, message):
    """The message after it went over the wire."""
    sender.send_message(message, wait=True)
    received = receiver.wait_for_message(message.device_name, timeout=10)
    assert received is not None
    return received


def test_frames_of_a_stream_are_registered_and_their_poses_sent_back(link, tmp_path):
    server, client = link
    phantom = make_phantom(tmp_path / "case")
    scene, _logic = new_application()
    node = scene.AddNewNodeByClass("vtkMRMLVectorVolumeNode", "Stream")
    controller = LiveController(scene)
    poses = [phantom.pose(i / 7) for i in range(7)]
    with PhantomPainter(phantom, SMALL) as painter:
        images = [painter.paint(pose) for pose in poses]
    images[3] = covered_frame(1, SMALL)
    send(node, images[0])
    controller.start(choice_of(phantom, stale_s=60), model=open_model(phantom.case))
    wait_for(controller, lambda s: s.new)
    for i, image in enumerate(images):
        message = pyigtl.ImageMessage(image[np.newaxis], device_name="Stream")
        received = passed_on(server, client, message)
        send(node, np.ascontiguousarray(received.image[0]))  # what the connector does with a message
        status = wait_for(controller, lambda s: s.new)
        assert status.verdict.sight is (Sight.REFUSED if i == 3 else Sight.FOLLOWING)
        if i == 3:
            continue
        assert add_of(phantom, poses[i], status.result.prediction.camera_from_world) < 0.3
        matrix = camera_to_ras_of(controller.live.transform)
        back = passed_on(client, server, pyigtl.TransformMessage(matrix, device_name=f"CameraToRAS{i}"))
        np.testing.assert_allclose(back.matrix, matrix, atol=1e-3)
        expected = np.diag([-1.0, -1.0, 1.0, 1.0]) @ np.linalg.inv(status.result.prediction.camera_from_world)
        np.testing.assert_allclose(back.matrix, expected, atol=1e-3)
    controller.close()
