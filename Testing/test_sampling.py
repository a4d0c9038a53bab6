import cv2
import numpy as np
import pytest
from cases import camera, dome, vessels
from scipy.spatial.transform import Rotation

from ExpectedAppearancesLib.case.meshes import Mesh
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.geometry.pose import inverse, is_rigid
from ExpectedAppearancesLib.poses import sampling
from ExpectedAppearancesLib.poses.craniotomy import (
    Craniotomy,
    disc_under_vessels,
    find_craniotomy,
    has_own_axis,
    near_vessels,
    parenchyma_around,
)
from ExpectedAppearancesLib.poses.sampling import PoseRanges, PoseSampler

TURN = Rotation.from_euler("xyz", [40, -65, 20], degrees=True).as_matrix()


def turned(mesh: Mesh, inside_out: bool = False) -> Mesh:
    return Mesh(mesh.vertices_mm @ TURN.T + [5, -80, 30], mesh.triangles[:, ::-1] if inside_out else mesh.triangles)


@pytest.mark.parametrize("inside_out", [False, True])
def test_outward_axis_is_found_from_the_cortex_whatever_its_triangle_order(inside_out):
    found = find_craniotomy(turned(vessels()), turned(dome(), inside_out))
    assert np.degrees(np.arccos(found.outward_axis @ TURN[:, 2])) < 2


def ball(radius_mm: float = 70.0, cells: int = 24) -> Mesh:
    """Closed and round, as a segmented brain, but flatter from side to side; its triangles face outwards."""
    z = np.linspace(1, -1, cells + 1)[:, None]
    angle = np.linspace(0, 2 * np.pi, cells, endpoint=False)
    across = np.sqrt(1 - z**2)
    points = np.stack([0.8 * across * np.cos(angle), across * np.sin(angle), z + 0 * angle], axis=-1)
    row, column = (index.ravel() for index in np.mgrid[:cells, :cells])
    a, b = row * cells + column, row * cells + (column + 1) % cells
    triangles = np.vstack([np.stack([a, a + cells, b], 1), np.stack([b, a + cells, b + cells], 1)])
    return Mesh(radius_mm * points.reshape(-1, 3), triangles)


@pytest.mark.parametrize("side", [1, -1])
def test_outward_axis_on_a_closed_brain_is_where_its_vessels_lie(side):
    """The flattest direction of the whole brain is from ear to ear, and which ear nobody could tell."""
    brain = ball()
    on_top = Mesh((vessels().vertices_mm + np.array([0, 0, 70])) * [side, 1, side], vessels().triangles)
    found = find_craniotomy(turned(on_top), turned(brain))
    assert np.degrees(np.arccos(found.outward_axis @ (TURN @ [0, 0, side]))) < 12
    assert has_own_axis(dome(), vessels()) and not has_own_axis(brain, on_top)


def test_outward_axis_on_half_a_brain_is_that_of_the_place_and_not_of_the_half():
    whole = ball()
    right = Mesh(whole.vertices_mm, whole.triangles[(whole.vertices_mm[whole.triangles, 0] > -1).all(axis=1)])
    place = 70 * np.array([0.8 * np.sqrt(0.5), 0, np.sqrt(0.5)])
    outward = place / [0.8**2, 1, 1] / np.linalg.norm(place / [0.8**2, 1, 1])
    turn = np.stack([np.cross([0, 1, 0], outward), [0, 1, 0], outward], axis=1)
    on_the_side = Mesh(vessels().vertices_mm @ turn.T + place, vessels().triangles)
    found = find_craniotomy(turned(on_the_side), turned(right))
    assert np.degrees(np.arccos(found.outward_axis @ (TURN @ outward))) < 8  # of the whole half it is 40 degrees off


def test_of_a_whole_brain_the_part_around_the_vessels_is_seen():
    brain, on_top = ball(cells=120), Mesh(vessels().vertices_mm + np.array([0, 0, 70]), vessels().triangles)
    axis, reach_mm = np.array([0, 0, 1.0]), 1.75 * vessels().radius_mm
    part = parenchyma_around(on_top, brain, axis)
    distances_mm = np.linalg.norm(part.vertices_mm - on_top.centroid_mm, axis=1)
    assert distances_mm.max() < reach_mm + 6
    assert part.vertices_mm[:, 2].min() > 0, "the other side of the brain is in it"
    corners = {tuple(corner) for corner in brain.vertices_mm.round(6).tolist()}
    assert {tuple(corner) for corner in part.vertices_mm.round(6).tolist()} <= corners
    near = np.linalg.norm(brain.vertices_mm - on_top.centroid_mm, axis=1) < reach_mm
    assert (distances_mm < reach_mm).sum() == near.sum() > 100  # and nothing near is left out
    patch = dome()
    assert parenchyma_around(vessels(), patch, axis) is patch


def test_a_coarse_cortex_has_no_hole_where_the_vessels_are():
    far = np.array([[-900, -900, 0], [900, -900, 0], [0, 900, 0], [5000, 0, 0], [6000, 0, 0], [5000, 900, 0]], float)
    part = near_vessels(Mesh(far, np.array([[0, 1, 2], [3, 4, 5]])), vessels())
    np.testing.assert_array_equal(part.vertices_mm[part.triangles], far[None, :3])


def test_outward_axis_is_fitted_to_the_vessels_where_there_is_no_cortex():
    found = find_craniotomy(turned(vessels()))
    assert np.degrees(np.arccos(found.outward_axis @ TURN[:, 2])) < 12


def test_point_and_normal_are_taken_as_given():
    found = find_craniotomy(vessels(), dome(), point_world_mm=[1, 2, 3], normal=[0, 3, 4])
    np.testing.assert_allclose(found.centre_world_mm, [1, 2, 3])
    np.testing.assert_allclose(found.outward_axis, [0, 0.6, 0.8])
    with pytest.raises(InputError, match="normal"):
        find_craniotomy(vessels(), normal=[0, 0, 0])


def test_image_up_is_superior_and_at_the_crown_anterior():
    side = find_craniotomy(vessels(), normal=[1, 0, 0.3])
    assert side.up[2] > 0.9 and abs(side.up @ side.outward_axis) < 1e-12
    assert find_craniotomy(vessels(), normal=[0, 0, 1], space="LPS").up[1] == pytest.approx(-1)
    assert find_craniotomy(vessels(), normal=[0, 0, 1], space="RAS").up[1] == pytest.approx(1)


def test_disc_lies_below_all_vessels_and_reaches_beyond_them():
    mesh, axis = turned(vessels()), TURN[:, 2]
    disc = disc_under_vessels(mesh, axis)
    assert (disc.vertices_mm @ axis).max() < (mesh.vertices_mm @ axis).min()
    assert disc.radius_mm > 1.1 * mesh.radius_mm


def sampler(seed: int = 3, **ranges) -> PoseSampler:
    craniotomy = Craniotomy(vessels().centroid_mm, np.array([0, 0, 1.0]), np.array([0, -1.0, 0]))
    return PoseSampler(craniotomy, PoseRanges(**ranges), camera(), vessels().vertices_mm, seed)


def test_poses_keep_to_their_ranges():
    given = sampler(
        tilt_max_deg=50, roll_max_deg=20, working_distance_mm=(90, 120), lateral_offset_mm=4, in_view_min=0.0
    )
    middle_ray = np.linalg.solve(camera().matrix, [(camera().width - 1) / 2, (camera().height - 1) / 2, 1])
    tilts = []
    for i in range(300):
        pose = given.sample(i)
        assert is_rigid(pose, 1e-9)
        tilt = np.degrees(np.arccos(-pose[2, 2]))
        assert tilt <= 50.0001
        tilts.append(tilt)
        # What the middle of the image shows lies on the plane through the centre, within the lateral offset.
        eye, ray = inverse(pose)[:3, 3], pose[:3, :3].T @ middle_ray
        hit = eye - ray * ((eye - vessels().centroid_mm)[2] / ray[2])
        assert np.linalg.norm(hit - vessels().centroid_mm) <= 4.0001
        assert 90 - 1e-6 <= (pose[:3, :3] @ hit + pose[:3, 3])[2] <= 120 + 1e-6
        # Roll: turn the view back to the axis by the shortest rotation, then compare with the upright image.
        towards = -pose[2, :3]
        back, _ = Rotation.align_vectors([[0, 0, 1.0]], [towards])
        if tilt > 1e-3:
            axis = np.cross(towards, [0, 0, 1.0])
            back = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.radians(tilt))
        up = back.apply(-pose[1, :3])
        assert np.degrees(np.arccos(np.clip(up @ [0, -1.0, 0], -1, 1))) <= 20.0001
    # Uniform on the cap: the cosine of the tilt is uniform between cos 50 and 1.
    cosine = np.cos(np.radians(tilts))
    assert np.mean(cosine) == pytest.approx((1 + np.cos(np.radians(50))) / 2, abs=0.02)


def test_same_seed_same_poses_and_each_index_its_own():
    first, again = sampler(), sampler()
    np.testing.assert_array_equal(first.sample(7), again.sample(7))
    assert np.abs(first.sample(7) - first.sample(8)).max() > 1e-3


def test_vessels_are_in_view():
    given = sampler(in_view_min=0.9)
    for i in range(50):
        projected = camera().project(vessels().vertices_mm @ given.sample(i)[:3, :3].T + given.sample(i)[:3, 3])
        inside = ((projected > -0.5) & (projected < 95.5)).all(axis=1)
        assert inside.mean() > 0.87
    with pytest.raises(InputError, match="no view held 95%"):
        sampler(working_distance_mm=(5, 6), in_view_min=0.95).sample(0)


def test_all_impossible_ranges_are_reported_at_once():
    with pytest.raises(InputError) as error:
        sampler(tilt_max_deg=120, roll_max_deg=-1, working_distance_mm=(50, 40), lateral_offset_mm=-1, in_view_min=60)
    assert len(error.value.problems) == 5
    with pytest.raises(InputError) as error:  # blamed on vessels and camera, or an error of numpy's
        sampler(seed=-1, working_distance_mm=(50, np.inf), lateral_offset_mm=np.nan, in_view_min=np.nan)
    assert len(error.value.problems) == 4


def test_turns_are_those_of_opencv():
    rng = np.random.default_rng(3)
    for angle in (0.0, 1e-9, 0.7, -2.9, np.pi):
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        np.testing.assert_allclose(sampling._turn(axis, angle), cv2.Rodrigues(axis * angle)[0], atol=1e-12)
