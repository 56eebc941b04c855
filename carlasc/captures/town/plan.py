"""What a town is drawn on: its mesh as it grows, its buildings, its parking spaces."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.town.buildings import building
from carlasc.captures.town.meshes import Mesh, MeshBuilder
from carlasc.captures.town.plants import Nursery
from carlasc.captures.town.plots import Rectangle
from carlasc.captures.town.streets import HALF_ROAD_M, SIDEWALK_M
from carlasc.core.geometry import Transform, rotation_z, translation

KERB_M = 0.15
PAINT_M = 0.01  # road markings lie this far above the road
INNER_M = HALF_ROAD_M + SIDEWALK_M  # from the centre line to the land behind the sidewalk


@dataclass(frozen=True)
class ParkingSpace:
    """Where a vehicle may be parked.

    Attributes:
        pose: world_T_vehicle.
        long: whether a long vehicle fits.
    """

    pose: Transform
    long: bool


@dataclass
class Plan:
    """What the steps of building a town add to.

    Attributes:
        rng: what they draw from.
        plants: the plants that grow in it.
        builder: the town's mesh.
        solids: footprints of buildings with their heights, metres.
        parking: parking spaces.
    """

    rng: np.random.Generator
    plants: Nursery
    builder: MeshBuilder = field(default_factory=MeshBuilder)
    solids: list[tuple[Rectangle, float]] = field(default_factory=list)
    parking: list[ParkingSpace] = field(default_factory=list)

    def put(self, mesh: Mesh, place: NDArray[np.float64], yaw_rad: float, height_m: float = KERB_M) -> None:
        """Put a thing at a place (2,), turned and lifted."""
        self.builder.add_mesh(mesh, translation((*place, height_m)) @ rotation_z(yaw_rad))

    def build(self, footprint: Rectangle, height_m: float, pitched: bool, base_m: float = KERB_M) -> None:
        """Put a building on a footprint."""
        mesh, pose = building(self.rng, footprint, height_m, pitched)
        self.builder.add_mesh(mesh, translation((0, 0, base_m)) @ pose)
        self.solids.append((footprint, base_m + height_m))
