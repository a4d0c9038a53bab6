"""Fixtures that several test files share."""

from __future__ import annotations

import errno
import os
import signal

import cases
import pytest


def pytest_sessionstart():
    """A shell without job control starts what it puts in the background with Ctrl+C ignored, and its children too."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def phantom(tmp_path_factory):
    from ExpectedAppearancesLib.demo.phantom import make_phantom

    return make_phantom(tmp_path_factory.mktemp("phantom") / "case")


@pytest.fixture(scope="session")
def model(phantom):
    from ExpectedAppearancesLib.live.estimator import open_model

    return open_model(phantom.case)


@pytest.fixture(scope="session")
def frames(phantom):
    """Twelve poses and their frames; from one to the next the camera moves by centimetres."""
    from live_cases import SMALL

    from ExpectedAppearancesLib.demo.phantom import PhantomPainter

    poses = [phantom.pose(i / 12) for i in range(12)]
    with PhantomPainter(phantom, SMALL) as painter:
        return poses, [painter.paint(pose) for pose in poses]


@pytest.fixture
def vanish(monkeypatch):
    """A function that lets a folder answer as one of a mounted network drive does whose connection is lost."""
    gone, stat, scandir = [], os.stat, os.scandir

    def refused(usual):
        def answer(path, *arguments, **named):
            if any(str(path).startswith(str(folder)) for folder in gone):
                raise OSError(errno.ENOTCONN, "Transport endpoint is not connected", str(path))
            return usual(path, *arguments, **named)

        return answer

    monkeypatch.setattr(os, "stat", refused(stat))
    monkeypatch.setattr(os, "scandir", refused(scandir))
    yield gone.append
    gone.clear()


@pytest.fixture
def scene():
    """Slicer's real scene, with the logics that colours and segmentations need."""
    pytest.importorskip("slicer")
    from planning_scene import new_scene

    return new_scene()


@pytest.fixture
def planned(scene, tmp_path):
    """Session and parameters with models chosen, under a transform; and the folder of their files."""
    from planning_scene import add_model, add_transform, parameters, turned

    from ExpectedAppearancesLib.mrml.planning_session import PlanningSession

    paths = cases.write_inputs(tmp_path)
    parent = add_transform(scene, turned())
    nodes = [add_model(scene, cases.vessels()), add_model(scene, cases.dome(), "Cortex")]
    for node in nodes:
        node.SetAndObserveTransformNodeID(parent.GetID())
    return PlanningSession(), parameters(
        vesselsNode=nodes[0], cortexModel=nodes[1], calibrationPath=str(paths["camera.json"])
    )
