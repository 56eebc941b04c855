"""Shapes of the actors: vehicles and pedestrians.

The frame of an actor: x forward, y right, z up, origin on the ground below its middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from carlasc.core.tables import CARLA
from carlasc_recorders.town.meshes import Mesh, MeshBuilder, unit_sphere

VEHICLE = CARLA.id_of("Vehicle")
PEDESTRIAN = CARLA.id_of("Pedestrian")
GAIT_PHASES = 8  # number of poses in a cycle of two steps


@dataclass(frozen=True)
class VehicleKind:
    """A kind of vehicle, described by its side view.

    Attributes:
        name: name of the kind.
        length_m: length from bumper to bumper, metres.
        width_m: width without mirrors, metres.
        body: (x, z) corners of the convex side view of the body; x from 0 (rear) to 1 (front), z in
            metres.
        cabin: (x, z) corners of the side view of the cabin or box on the body, which is narrower at
            its top.
        wheels: (x, radius) of the wheels of each axle; x from 0 to 1, radius in metres.
        share: frequency relative to other kinds.
        cabin_taper: difference of the half widths of the cabin at its base and at its top, metres.
    """

    name: str
    length_m: float
    width_m: float
    body: tuple[tuple[float, float], ...]
    cabin: tuple[tuple[float, float], ...]
    wheels: tuple[tuple[float, float], ...]
    share: float
    cabin_taper: float = 0.2


def _points(text: str) -> tuple[tuple[float, float], ...]:
    """Return the pairs of numbers in a text such as "0.1 0.92, 0.7 0.88"."""
    return tuple((float(one), float(other)) for one, other in map(str.split, text.split(",")))


_SEDAN_BODY = _points(
    "0.0 0.35, 0.02 0.25, 0.98 0.22, 1.0 0.4, 0.99 0.68, 0.7 0.9, 0.12 0.95, 0.01 0.85"
)
VEHICLE_KINDS = (
    VehicleKind(
        "sedan",
        4.6,
        1.84,
        _SEDAN_BODY,
        _points("0.1 0.92, 0.7 0.88, 0.54 1.44, 0.26 1.46"),
        _points("0.19 0.33, 0.81 0.33"),
        5,
    ),
    VehicleKind(
        "hatchback",
        3.9,
        1.75,
        _SEDAN_BODY,
        _points("0.01 0.9, 0.74 0.86, 0.55 1.48, 0.1 1.5"),
        _points("0.17 0.31, 0.82 0.31"),
        4,
    ),
    VehicleKind(
        "suv",
        4.8,
        1.95,
        _points("0.0 0.45, 0.03 0.32, 0.97 0.32, 1.0 0.5, 0.99 0.9, 0.72 1.08, 0.01 1.08"),
        _points("0.01 1.05, 0.73 1.05, 0.58 1.76, 0.05 1.8"),
        _points("0.19 0.38, 0.81 0.38"),
        3,
    ),
    VehicleKind(
        "van",
        5.4,
        2.0,
        _points("0.0 0.4, 0.02 0.3, 0.98 0.3, 1.0 0.5, 0.98 1.05, 0.8 1.2, 0.0 1.2"),
        _points("0.0 1.15, 0.84 1.15, 0.72 2.2, 0.68 2.3, 0.01 2.32"),
        _points("0.17 0.36, 0.83 0.36"),
        2,
        0.1,
    ),
    VehicleKind(
        "pickup",
        5.5,
        1.98,
        _points("0.0 0.5, 0.02 0.38, 0.98 0.38, 1.0 0.5, 0.99 0.95, 0.74 1.1, 0.0 1.05"),
        _points("0.42 1.05, 0.76 1.08, 0.64 1.8, 0.45 1.82"),
        _points("0.18 0.4, 0.82 0.4"),
        1.5,
    ),
    VehicleKind(
        "truck",
        8.2,
        2.45,
        _points("0.0 0.75, 0.98 0.75, 1.0 0.85, 1.0 1.0, 0.0 1.0"),
        _points("0.0 0.98, 0.72 0.98, 0.72 3.3, 0.0 3.3"),
        _points("0.16 0.48, 0.86 0.48"),
        1,
        0.0,
    ),
    VehicleKind(
        "bus",
        11.2,
        2.5,
        _points("0.0 0.35, 0.98 0.35, 1.0 0.5, 0.995 1.6, 0.0 1.6"),
        _points("0.0 1.58, 0.995 1.58, 0.975 2.9, 0.96 3.05, 0.01 3.05"),
        _points("0.22 0.48, 0.77 0.48"),
        0.8,
        0.08,
    ),
)
EGO_KIND = VEHICLE_KINDS[0]


@cache
def vehicle_mesh(kind: VehicleKind) -> Mesh:
    """Return the mesh of a vehicle in its own frame."""
    builder = MeshBuilder()
    half = kind.width_m / 2
    stretch = np.array([kind.length_m, 1.0])
    middle = np.array([kind.length_m / 2, 0.0])
    body = np.array(kind.body) * stretch - middle
    builder.prism(VEHICLE, body, -half, half)
    cabin = np.array(kind.cabin) * stretch - middle
    low = cabin[:, 1].min()
    high = cabin[:, 1].max()
    sides = half - 0.04 - kind.cabin_taper * (cabin[:, 1] - low) / (high - low)
    builder.prism(VEHICLE, cabin, -sides, sides)
    if kind.name == "truck":  # the cab is separate from the box
        cab = (
            np.array(((0.76, 0.98), (1.0, 0.98), (0.995, 1.7), (0.95, 2.6), (0.77, 2.65))) * stretch
            - middle
        )
        builder.prism(VEHICLE, cab, -half + 0.1, half - 0.1)
    for x, radius in kind.wheels:
        for side in (-1.0, 1.0):
            hub = np.array([(x - 0.5) * kind.length_m, side * (half - 0.12), radius])
            builder.rod(VEHICLE, hub - (0, 0.11, 0), hub + (0, 0.13, 0), radius, sections=12)
    mirror_x = float(cabin[1, 0]) - 0.05 * kind.length_m
    for side in (-1.0, 1.0):
        builder.boxes(VEHICLE, (mirror_x, side * (half + 0.08), low + 0.02), (0.12, 0.18, 0.16))
    return builder.build()


@cache
def bicycle_mesh() -> Mesh:
    """Return a bicycle with its rider. Both are of the class Vehicle, as in CARLA."""
    builder = MeshBuilder()
    for x in (-0.5, 0.5):
        builder.rod(VEHICLE, (x, -0.03, 0.34), (x, 0.03, 0.34), 0.34, sections=12)
    builder.rod(VEHICLE, (-0.5, 0, 0.34), (0.0, 0, 0.75), 0.03)
    builder.rod(VEHICLE, (0.5, 0, 0.34), (0.38, 0, 1.0), 0.03)
    builder.rod(VEHICLE, (0.0, 0, 0.75), (0.4, 0, 0.85), 0.03)
    builder.rod(VEHICLE, (0.38, -0.28, 1.0), (0.38, 0.28, 1.0), 0.025)
    for side in (-1.0, 1.0):
        builder.rod(VEHICLE, (-0.15, side * 0.12, 0.9), (0.15, side * 0.14, 0.62), 0.09)
        builder.rod(VEHICLE, (0.15, side * 0.14, 0.62), (0.02, side * 0.12, 0.25), 0.06)
        builder.rod(VEHICLE, (0.05, side * 0.2, 1.38), (0.36, side * 0.24, 1.05), 0.05)
    builder.rod(VEHICLE, (-0.18, 0, 0.88), (0.06, 0, 1.42), 0.18, sections=8)
    _add_ellipsoid(builder, VEHICLE, (0.14, 0, 1.63), (0.12, 0.1, 0.14))
    return builder.build()


@cache
def pedestrian_mesh(height_m: float, phase: int) -> Mesh:
    """Return the mesh of a pedestrian in its own frame.

    Args:
        height_m: height.
        phase: phase of the gait, 0..GAIT_PHASES-1; -1 for a standing pedestrian.
    """
    builder = MeshBuilder()
    scale = height_m / 1.75
    swing = 0.0 if phase < 0 else 0.42 * np.sin(2 * np.pi * (phase + 0.5) / GAIT_PHASES)
    for side in (-1.0, 1.0):
        hip = np.array([0.0, side * 0.1, 0.88])
        foot = np.array([side * swing * 0.85, side * 0.11, 0.06])
        knee = (hip + foot) / 2 + (0.05 + 0.08 * abs(swing), 0, 0)
        builder.rod(PEDESTRIAN, hip, knee, 0.085)
        builder.rod(PEDESTRIAN, knee, foot, 0.06)
        builder.boxes(PEDESTRIAN, foot + (0.06, 0, -0.06), (0.27, 0.1, 0.09))
        shoulder = np.array([0.0, side * 0.21, 1.42])
        hand = np.array([-side * swing * 0.7, side * 0.27, 0.82])
        builder.rod(PEDESTRIAN, shoulder, hand, 0.05)
    torso = np.array(
        ((-0.11, 0.85), (0.11, 0.85), (0.13, 1.2), (0.09, 1.48), (-0.1, 1.48), (-0.13, 1.2))
    )
    builder.prism(
        PEDESTRIAN,
        torso,
        (-0.16, -0.16, -0.19, -0.2, -0.2, -0.19),
        (0.16, 0.16, 0.19, 0.2, 0.2, 0.19),
    )
    _add_ellipsoid(builder, PEDESTRIAN, (0.01, 0, 1.62), (0.1, 0.08, 0.13))
    mesh = builder.build()
    return Mesh(mesh.vertices * scale, mesh.faces, mesh.labels)


def _add_ellipsoid(
    builder: MeshBuilder,
    label: int,
    centre: tuple[float, float, float],
    radii: tuple[float, float, float],
) -> None:
    vertices, faces = unit_sphere(1)
    builder.add(label, vertices * radii + centre, faces)
