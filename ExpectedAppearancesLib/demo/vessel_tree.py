"""A generated patient: a curved patch of cortex with a branching tree of superficial vessels on it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ..case.meshes import Mesh
from ..geometry.camera import Camera

PATCH_SIDE_MM = 44.0
PATCH_CELLS = 80
HEAD_RADIUS_MM = 62.0  # of curvature: the middle of the patch then lies 4 mm above its sides
HEAD_CENTRE_MM = np.array([3.0, 12.0, 35.0])
ROOTS = 4
ROOT_RADIUS_MM = (1.15, 1.5)
SMALLEST_RADIUS_MM = 0.5
MURRAY_EXPONENT = 3  # Murray, PNAS 1926: r0^3 = r1^3 + r2^3 where the flow's cost is least
STEP_MM = 0.5
RING_VERTICES = 12
CENTRE_ABOVE_SURFACE = 0.3  # of the radius: a little less than half of the tube is sunk in the cortex
WALKS_TRIED = 6
TREES_TRIED = 3
SHORTEST_STEPS = 8
CLEARANCE_MM = 1.5  # between the walls of two vessels
FAMILY_MM = 3.5


@dataclass(frozen=True, eq=False)
class CortexPatch:
    """Height of the cortex over a plane, and where that plane lies in the head.

    axes: rows are the patch's x, y and outward directions in world (LPS) coordinates. centre_world_mm: where patch
    coordinates are 0. waves: (K, 4) of wave vector (rad/mm), phase and amplitude (mm) of the undulations.
    """

    centre_world_mm: np.ndarray
    axes: np.ndarray
    waves: np.ndarray

    @property
    def outward_axis(self) -> np.ndarray:
        return self.axes[2]

    def height_mm(self, points_mm: np.ndarray) -> np.ndarray:
        """Height of the surface over patch points (..., 2)."""
        dome = -(points_mm**2).sum(axis=-1) / (2 * HEAD_RADIUS_MM)
        phase = points_mm @ self.waves[:, :2].T + self.waves[:, 2]
        return dome + np.sin(phase) @ self.waves[:, 3]

    def to_world(self, points_mm: np.ndarray, above_mm: float = 0.0) -> np.ndarray:
        """Patch points (..., 2) on the surface, or above it, as world points (..., 3)."""
        height = self.height_mm(points_mm) + above_mm
        return self.centre_world_mm + np.concatenate([points_mm, height[..., None]], axis=-1) @ self.axes

    def mesh(self) -> Mesh:
        line = np.linspace(-PATCH_SIDE_MM / 2, PATCH_SIDE_MM / 2, PATCH_CELLS + 1)
        points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
        a = (np.arange(PATCH_CELLS)[:, None] * (PATCH_CELLS + 1) + np.arange(PATCH_CELLS)).ravel()
        b, c, d = a + 1, a + PATCH_CELLS + 2, a + PATCH_CELLS + 1
        return Mesh(self.to_world(points), np.vstack([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


@dataclass(frozen=True, eq=False)
class Branch:
    """A vessel between two branchings. centre_line_mm: (N, 2) in the patch, from its parent's end onwards.

    parent: index of the branch that it continues, None for a root.
    """

    centre_line_mm: np.ndarray
    radius_mm: float
    parent: int | None


def demo_camera() -> Camera:
    """256 x 256 px, 30 degrees of view, centred."""
    focal_px = 128 / math.tan(math.radians(15))
    return Camera(256, 256, focal_px, focal_px, 127.5, 127.5)


def generate_case_meshes(seed: int) -> tuple[Mesh, Mesh]:
    """(vessels, cortex) of a patient, LPS mm; the same for the same seed."""
    patch, branches = generate_tree(seed)
    return tree_mesh(patch, branches), patch.mesh()


def generate_tree(seed: int) -> tuple[CortexPatch, list[Branch]]:
    """The patch and its vessels; parents come before their children."""
    rng = np.random.default_rng([seed, 3])
    patch = _generate_patch(rng)
    # Vessels that grow first may shut out the others: of a few trees, the one that covers most of the patch.
    return patch, max(
        (_grow(rng) for _ in range(TREES_TRIED)), key=lambda tree: sum(len(b.centre_line_mm) for b in tree)
    )


def _grow(rng: np.random.Generator) -> list[Branch]:
    branches: list[Branch] = []
    half = PATCH_SIDE_MM / 2
    first_side = rng.integers(4)
    for i in range(ROOTS):
        # One root from each side, off its middle: no two patients alike, no symmetry that would make poses ambiguous.
        side = math.radians(90 * (first_side + i))
        along = rng.uniform(0.2, 0.6) * half * rng.choice([-1, 1])
        start = half * np.array([math.cos(side), math.sin(side)]) + along * np.array([-math.sin(side), math.cos(side)])
        heading = math.atan2(*-start[::-1]) + rng.uniform(-0.5, 0.5)
        radius_mm = rng.uniform(*ROOT_RADIUS_MM)
        line = _walk(branches, start, heading, radius_mm, rng)
        if len(line) >= SHORTEST_STEPS:
            branches.append(Branch(line, radius_mm, None))
    # Breadth first, so that no root takes the whole patch before the others have grown.
    index = 0
    while index < len(branches):
        branches += _children(branches, index, rng)
        index += 1
    return branches


def tree_mesh(patch: CortexPatch, branches: list[Branch]) -> Mesh:
    """A closed tube with round ends for each branch; tubes of a branching overlap."""
    vertices, triangles, count = [], [], 0
    for branch in branches:
        tube = _tube(patch.to_world(branch.centre_line_mm, CENTRE_ABOVE_SURFACE * branch.radius_mm), branch.radius_mm)
        vertices.append(tube.vertices_mm)
        triangles.append(tube.triangles + count)
        count += len(tube.vertices_mm)
    return Mesh(np.vstack(vertices), np.vstack(triangles))


def _generate_patch(rng: np.random.Generator) -> CortexPatch:
    outward = np.array([0.75, -0.25, 0.6]) + rng.uniform(-0.15, 0.15, 3)  # left fronto-parietal
    outward /= np.linalg.norm(outward)
    x = np.cross([0.0, 0.0, 1.0], outward)
    x /= np.linalg.norm(x)
    angle = rng.uniform(0, 2 * np.pi, 5)
    wavelength_mm = rng.uniform(13, 24, 5)
    vectors = np.stack([np.cos(angle), np.sin(angle)], 1) * (2 * np.pi / wavelength_mm)[:, None]
    waves = np.column_stack([vectors, rng.uniform(0, 2 * np.pi, 5), rng.uniform(0.1, 0.35, 5)])
    axes = np.stack([x, np.cross(outward, x), outward])
    return CortexPatch(HEAD_CENTRE_MM + HEAD_RADIUS_MM * outward, axes, waves)


def _children(branches: list[Branch], index: int, rng: np.random.Generator) -> list[Branch]:
    """The two branches that continue branch `index`; none where one would be too thin or has no room."""
    parent = branches[index]
    cube = parent.radius_mm**MURRAY_EXPONENT
    thin = ((1 - rng.uniform(0.55, 0.8)) * cube) ** (1 / MURRAY_EXPONENT)
    if thin < SMALLEST_RADIUS_MM:
        return []
    thick = (cube - thin**MURRAY_EXPONENT) ** (1 / MURRAY_EXPONENT)
    end = parent.centre_line_mm[-1]
    ahead = math.atan2(*(end - parent.centre_line_mm[-2])[::-1])
    best: list[Branch] = []
    for turn in (-1, 1, -1, 1):
        # The thinner child turns further away, as Murray's law has it.
        first = Branch(_walk(branches, end, ahead - turn * rng.uniform(0.2, 0.5), thick, rng), thick, index)
        second_heading = ahead + turn * rng.uniform(0.7, 1.1)
        second = Branch(_walk([*branches, first], end, second_heading, thin, rng), thin, index)
        pair = [first, second]
        shortest = min(len(b.centre_line_mm) for b in pair)
        if shortest >= SHORTEST_STEPS and shortest > min((len(b.centre_line_mm) for b in best), default=0):
            best = pair
    return best


def _walk(branches: list[Branch], start, heading: float, radius_mm: float, rng: np.random.Generator) -> np.ndarray:
    """The longest of a few tortuous lines from `start`; each ends at the border or before another vessel."""
    points = np.vstack([b.centre_line_mm for b in branches]) if branches else np.zeros((0, 2))
    radii = np.repeat([b.radius_mm for b in branches], [len(b.centre_line_mm) for b in branches])
    steps = rng.integers(18, 30)
    distance_mm = np.linalg.norm(points - start, axis=1)
    # At the branching its own family is always near; what is out of reach need not be looked at.
    obstacle = (distance_mm > FAMILY_MM) & (distance_mm < steps * STEP_MM + 2 * max(ROOT_RADIUS_MM) + CLEARANCE_MM)
    points, nearest_mm_2 = points[obstacle], (radii[obstacle] + radius_mm + CLEARANCE_MM) ** 2
    best = np.zeros((0, 2))
    for _ in range(WALKS_TRIED):
        line, bend = [start], 0.0
        drift = rng.normal(0, 0.05)
        while len(line) <= steps:
            # The bend returns to 0, so that a vessel winds about its course and does not curl up.
            drift = 0.9 * drift + rng.normal(0, 0.042) - 0.018 * bend
            bend += drift
            point = line[-1] + STEP_MM * np.array([math.cos(heading + bend), math.sin(heading + bend)])
            if np.abs(point).max() > PATCH_SIDE_MM / 2 or (((points - point) ** 2).sum(axis=1) < nearest_mm_2).any():
                break
            line.append(point)
        if len(line) > len(best):
            best = np.array(line)
    return best


def _tube(centre_line_mm: np.ndarray, radius_mm: float) -> Mesh:
    """Closed tube around (N, 3) points: rings carried along without twist, and half spheres on both ends."""
    tangents = np.gradient(centre_line_mm, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across = np.cross(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))])
    angle = np.linspace(0, 2 * np.pi, RING_VERTICES, endpoint=False)[:, None]
    cap = np.radians([60.0, 30.0])
    centres, radii, frames = [], [], []
    for i, (point, tangent) in enumerate(zip(centre_line_mm, tangents)):
        across = across - tangent * (across @ tangent)
        across /= np.linalg.norm(across)
        ends = [(0.0, 1.0)]
        if i == 0:
            ends = [*((-math.sin(a), math.cos(a)) for a in cap), *ends]
        if i == len(tangents) - 1:
            ends = [*ends, *((math.sin(a), math.cos(a)) for a in cap[::-1])]
        for shift, scale in ends:
            centres.append(point + shift * radius_mm * tangent)
            radii.append(scale * radius_mm)
            frames.append((across, np.cross(tangent, across)))
    rings = [c + r * (np.cos(angle) * f + np.sin(angle) * s) for c, r, (f, s) in zip(centres, radii, frames)]
    tips = [centre_line_mm[0] - radius_mm * tangents[0], centre_line_mm[-1] + radius_mm * tangents[-1]]
    vertices = np.vstack([*rings, *tips])
    k = np.arange(RING_VERTICES)
    following = (k + 1) % RING_VERTICES
    triangles = []
    for i in range(len(rings) - 1):
        a, b = i * RING_VERTICES + k, i * RING_VERTICES + following
        c, d = b + RING_VERTICES, a + RING_VERTICES
        triangles += [np.stack([a, b, c], 1), np.stack([a, c, d], 1)]
    first_tip = len(rings) * RING_VERTICES
    last = (len(rings) - 1) * RING_VERTICES
    triangles.append(np.stack([np.full(RING_VERTICES, first_tip), following, k], 1))
    triangles.append(np.stack([np.full(RING_VERTICES, first_tip + 1), last + k, last + following], 1))
    return Mesh(vertices, np.vstack(triangles))
