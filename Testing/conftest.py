"""Fixtures that several files of planning tests share."""

from __future__ import annotations

import cases
import pytest


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
