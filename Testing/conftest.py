"""Fixtures that several test files share."""

from __future__ import annotations

import pytest


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
