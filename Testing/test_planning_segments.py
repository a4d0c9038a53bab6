"""Vessels that are a segment: their surface, made in a process of its own, on slicer-core's scene."""

from __future__ import annotations

import time

import numpy as np
import pytest

from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.planning.steps import Step, StepState
from ExpectedAppearancesLib.runs.worker import Worker

slicer = pytest.importorskip("slicer")
import vtk  # noqa: E402 (after the skip)
from planning_scene import add_transform, turned  # noqa: E402
from vtk.util.numpy_support import vtk_to_numpy  # noqa: E402

from ExpectedAppearancesLib.mrml import planning  # noqa: E402
from ExpectedAppearancesLib.mrml.segment_surface import SegmentSurfaces, answering  # noqa: E402


def test_the_surface_of_a_segment_comes_from_a_process_and_an_outdated_one_never(scene, planned, tmp_path):
    session, p = planned
    image = slicer.vtkOrientedImageData()
    image.SetExtent(3, 14, -2, 9, 0, 11)
    image.SetSpacing(2.0, 1.0, 0.5)
    image.SetOrigin(5.0, -7.0, 11.0)
    image.AllocateScalars(vtk.VTK_UNSIGNED_CHAR, 1)
    voxels = vtk_to_numpy(image.GetPointData().GetScalars()).reshape(12, 12, 12)
    voxels[:] = 0
    voxels[3:8, 3:7, 3:9] = 1
    node = scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "S")
    node.CreateDefaultDisplayNodes()
    segment_id = node.AddSegmentFromBinaryLabelmapRepresentation(image, "vessels", [1.0, 0.0, 0.0])
    node.SetAndObserveTransformNodeID(add_transform(scene, turned()).GetID())
    expected = planning.world_mesh(node, segment_id)
    p.vesselsSegmentId, p.vesselsNode = segment_id, node

    asked: list[dict] = []
    worker, session.surfaces = Worker("surfaces"), SegmentSurfaces(asked.append)

    def answered() -> tuple[dict, dict]:
        list(session.surfaces.asking(node, segment_id, tmp_path))
        worker.ask(asked[-1])
        end = time.monotonic() + 300
        while not (found := worker.poll()):
            assert time.monotonic() < end
            time.sleep(0.02)
        return found

    def draw() -> None:
        segment = node.GetSegmentation().GetSegment(segment_id)
        segment.GetRepresentation(node.GetSegmentation().GetSourceRepresentationName()).Modified()

    try:
        assert session.steps(p)["case"] == Step(StepState.RUNNING, "The surface of the segment is being made.")
        with pytest.raises(InputError, match="is being made"):
            session.mesh(p, "vessels")
        first = answered()
        assert not session.surfaces.to_ask(node, segment_id)
        session.surfaces.take(*first)
        made = session.mesh(p, "vessels")
        np.testing.assert_allclose(made.vertices_mm, expected.vertices_mm, atol=1e-4)
        np.testing.assert_array_equal(made.triangles, expected.triangles)
        assert session.steps(p)["case"].state is StepState.MISSING  # a folder is to be chosen: nothing is waited for

        draw()
        assert session.surfaces.to_ask(node, segment_id)
        assert session.mesh(p, "vessels") is made  # what is drawn in the views stays until the new one comes
        assert session.steps(p)["case"].state is StepState.RUNNING
        outdated = answered()
        draw()
        voxels[:] = 0
        newest = answered()
        session.surfaces.take(*outdated)
        assert session.steps(p)["case"].state is StepState.RUNNING
        session.surfaces.take(*newest)
        with pytest.raises(InputError, match="S: "):
            session.mesh(p, "vessels")

        draw()
        voxels[4:9, 4:8, 4:9] = 1
        list(session.surfaces.asking(node, segment_id, tmp_path))
        session.surfaces.take(asked[-1], {"failed": "ended"})
        np.testing.assert_array_equal(
            session.mesh(p, "vessels").vertices_mm, planning.world_mesh(node, segment_id).vertices_mm
        )
    finally:
        worker.stop()


def test_a_segment_is_taken_with_the_smoothing_that_is_set_for_its_surface(scene, planned, tmp_path):
    """In the Segment Editor's menu of Show 3D: thin vessels vanish where they are smoothed much."""
    session, p = planned
    image = slicer.vtkOrientedImageData()
    image.SetExtent(0, 19, 0, 19, 0, 19)
    image.AllocateScalars(vtk.VTK_UNSIGNED_CHAR, 1)
    voxels = vtk_to_numpy(image.GetPointData().GetScalars()).reshape(20, 20, 20)
    voxels[:] = 0
    voxels[3:17, 9:11, 9:11] = 1
    node = scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "S")
    p.vesselsSegmentId = node.AddSegmentFromBinaryLabelmapRepresentation(image, "vessels", [1.0, 0.0, 0.0])
    p.vesselsNode, segmentation = node, node.GetSegmentation()

    def width_mm() -> float:
        return np.ptp(session.mesh(p, "vessels").vertices_mm[:, 0])

    def smooth(factor: float, shown: bool) -> None:
        segmentation.SetConversionParameter("Smoothing factor", str(factor))
        if shown:
            segmentation.CreateRepresentation("Closed surface", True)

    usual = width_mm()
    smooth(0.5, shown=True)
    assert width_mm() == pytest.approx(usual, abs=1e-3)
    smooth(0.0, shown=True)
    sharp = width_mm()
    assert sharp > usual + 0.1
    segmentation.RemoveRepresentation("Closed surface")
    assert width_mm() == pytest.approx(sharp, abs=1e-3)
    smooth(0.5, shown=False)
    assert width_mm() == pytest.approx(usual, abs=1e-3)
    smooth(0.0, shown=False)
    asked: list[dict] = []
    surfaces = SegmentSurfaces(asked.append)
    list(surfaces.asking(node, p.vesselsSegmentId, tmp_path))
    surfaces.take(asked[0], {"answer": answering()(asked[0])})
    made = surfaces.made(node, p.vesselsSegmentId)
    assert np.ptp(made.vertices_mm[:, 0]) == pytest.approx(sharp, abs=1e-3)
    smooth(0.5, shown=False)
    assert surfaces.to_ask(node, p.vesselsSegmentId)
