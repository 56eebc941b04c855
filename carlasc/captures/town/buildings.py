"""Buildings: walls with window frames, ledges and balconies, and roofs."""

from __future__ import annotations

import numpy as np

from carlasc.captures.town.meshes import Mesh, MeshBuilder
from carlasc.captures.town.plan import KERB_M, Rectangle, TownPlan
from carlasc.core.geometry import Transform, rotation_z, translation
from carlasc.core.tables import CARLA

BUILDING = CARLA.id_of("Building")
FOUNDATION_M = 1.0  # depth of the walls below the ground, which is not level


def add_building(plan: TownPlan, footprint: Rectangle, height_m: float, pitched: bool, base_m: float = KERB_M) -> None:
    """Add a building to the plan of a town.

    Args:
        plan: the town's plan.
        footprint: the building's ground plan.
        height_m: height of its walls.
        pitched: whether its roof is pitched; it is flat otherwise.
        base_m: z of its ground floor.
    """
    mesh, pose = make_building(plan.rng, footprint, height_m, pitched)
    plan.builder.add_mesh(mesh, translation((0, 0, base_m)) @ pose)
    plan.buildings.append((footprint, base_m + height_m))


def make_building(
    rng: np.random.Generator, footprint: Rectangle, height_m: float, pitched: bool
) -> tuple[Mesh, Transform]:
    """Make a building.

    Args:
        rng: source of the random numbers.
        footprint: its ground plan.
        height_m: height of its walls.
        pitched: whether its roof is pitched; it is flat otherwise.

    Returns:
        The mesh in the building's frame (x along the street, y away from the street), and world_T_building.
    """
    width, depth = footprint.size
    storey = float(rng.uniform(2.9, 3.5))
    builder = MeshBuilder()
    builder.boxes(BUILDING, (0, 0, -FOUNDATION_M), (width, depth, height_m + FOUNDATION_M))
    _add_entrance(builder, rng, width, depth)
    _add_facades(builder, rng, width, depth, height_m, storey)
    if pitched:
        _add_pitched_roof(builder, rng, width, depth, height_m)
    else:
        _add_flat_roof(builder, rng, width, depth, height_m)
    return builder.build(), translation((*footprint.centre, 0.0)) @ rotation_z(footprint.yaw_rad)


def _add_entrance(builder: MeshBuilder, rng: np.random.Generator, width: float, depth: float) -> None:
    """Add a door with steps and a porch roof on the side of the street (y < 0)."""
    x = float(rng.uniform(-0.3, 0.3)) * width
    builder.boxes(BUILDING, (x, -depth / 2 - 0.35, -0.5), (2.0, 0.7, 0.5 + 0.3))
    builder.boxes(BUILDING, (x, -depth / 2 - 0.45, 2.6), (2.4, 0.9, 0.12))
    for side in (-1.0, 1.0):
        builder.boxes(BUILDING, (x + side * 0.7, -depth / 2 - 0.08, 0.3), (0.2, 0.16, 2.3))


def _add_facades(
    builder: MeshBuilder, rng: np.random.Generator, width: float, depth: float, height: float, storey: float
) -> None:
    """Add window frames and sills on all four sides, a ledge per storey, pillars at the corners, and some balconies."""
    pitch = float(rng.uniform(2.2, 3.6))
    floors = np.arange(int(height // storey)) * storey
    balconies = rng.random() < 0.35
    for length, reach, yaw in (
        (width, depth, 0.0),
        (width, depth, np.pi),
        (depth, width, np.pi / 2),
        (depth, width, -np.pi / 2),
    ):
        columns = max(int((length - 1.0) // pitch), 1)
        x, z = np.meshgrid((np.arange(columns) - (columns - 1) / 2) * pitch, floors + 0.9)
        x, z = x.ravel(), z.ravel()
        out = np.full_like(x, -reach / 2)
        frame = MeshBuilder()
        frame.boxes(BUILDING, np.column_stack([x, out - 0.06, z - 0.1]), (1.5, 0.24, 0.1))
        frame.boxes(BUILDING, np.column_stack([x, out - 0.04, z + 1.4]), (1.5, 0.14, 0.12))
        for side in (-0.68, 0.68):
            frame.boxes(BUILDING, np.column_stack([x + side, out - 0.03, z]), (0.12, 0.1, 1.4))
        if balconies and yaw == 0.0:
            high = z > storey
            if high.any():
                place = np.column_stack([x[high], out[high] - 0.6, z[high] - 0.95])
                frame.boxes(BUILDING, place, (1.9, 1.2, 0.14))
                frame.boxes(BUILDING, place - (0, 0.57, -0.14), (1.9, 0.05, 0.85))
        if rng.random() < 0.7:
            levels = floors[1:]
            if len(levels):
                ledge = np.column_stack([np.zeros(len(levels)), np.full(len(levels), -reach / 2 - 0.05), levels - 0.1])
                frame.boxes(BUILDING, ledge, (length, 0.16, 0.18))
        builder.add_mesh(frame.build(), rotation_z(yaw))
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * (width / 2, depth / 2, 1)
    builder.boxes(BUILDING, corners - (0, 0, FOUNDATION_M), (0.5, 0.5, height + FOUNDATION_M))


def _add_flat_roof(builder: MeshBuilder, rng: np.random.Generator, width: float, depth: float, height: float) -> None:
    for y in (-1, 1):
        builder.boxes(BUILDING, (0, y * (depth / 2), height - 0.1), (width + 0.5, 0.45, 0.75))
    for x in (-1, 1):
        builder.boxes(BUILDING, (x * (width / 2), 0, height - 0.1), (0.45, depth, 0.75))
    for _ in range(int(rng.integers(1, 4))):
        place = rng.uniform(-0.3, 0.3, 2) * (width, depth)
        builder.boxes(BUILDING, (*place, height), rng.uniform((1.0, 1.0, 0.8), (2.5, 2.5, 2.0)))


def _add_pitched_roof(
    builder: MeshBuilder, rng: np.random.Generator, width: float, depth: float, height: float
) -> None:
    eaves, rise = 0.45, depth / 2 * float(rng.uniform(0.5, 0.9))
    roof = np.array([(-width / 2 - eaves, height - 0.15), (width / 2 + eaves, height - 0.15)])
    x = np.array([roof[0, 0], roof[1, 0], roof[1, 0], roof[0, 0], roof[0, 0], roof[1, 0]])
    y = np.array([-depth / 2 - eaves, -depth / 2 - eaves, depth / 2 + eaves, depth / 2 + eaves, 0, 0])
    z = np.array([height - 0.15] * 4 + [height + rise] * 2)
    faces = [[0, 1, 5], [0, 5, 4], [2, 3, 4], [2, 4, 5], [1, 2, 5], [3, 0, 4], [0, 2, 1], [0, 3, 2]]
    builder.add(BUILDING, np.column_stack([x, y, z]), faces)
    builder.boxes(BUILDING, (width * float(rng.uniform(-0.35, 0.35)), depth * 0.15, height), (0.7, 0.7, rise + 0.6))
