"""The plan of a town while it is built: its mesh, its buildings and its parking spaces so far."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from carlasc.captures.town.buildings import make_building
from carlasc.captures.town.meshes import Mesh, MeshBuilder
from carlasc.captures.town.plants import PlantCatalogue
from carlasc.captures.town.plots import Rectangle
from carlasc.captures.town.streets import HALF_ROAD_M, SIDEWALK_M
from carlasc.core.geometry import Transform, rotation_z, translation

KERB_M = 0.15  # height of the sidewalks above the road
PAINT_M = 0.01  # height of road markings above the road
INNER_M = HALF_ROAD_M + SIDEWALK_M  # from a street's centre line to the land behind the sidewalk


@dataclass
class Plan:
    """A town while it is built: each step adds to it.

    Attributes:
        rng: source of all random numbers.
        plants: the plants to choose from.
        builder: the town's mesh so far.
        buildings: footprints of the buildings with the heights of their roofs, metres.
        parking: parking spaces: world_T_vehicle of a vehicle parked in each.
    """

    rng: np.random.Generator
    plants: PlantCatalogue
    builder: MeshBuilder = field(default_factory=MeshBuilder)
    buildings: list[tuple[Rectangle, float]] = field(default_factory=list)
    parking: list[Transform] = field(default_factory=list)

    def add(self, mesh: Mesh, position: NDArray[np.float64], yaw_rad: float, height_m: float = KERB_M) -> None:
        """Add an object.

        Args:
            mesh: the object in its own frame.
            position: (2,) x and y of its origin, metres.
            yaw_rad: its heading.
            height_m: z of its origin.
        """
        self.builder.add_mesh(mesh, translation((*position, height_m)) @ rotation_z(yaw_rad))

    def add_building(self, footprint: Rectangle, height_m: float, pitched: bool, base_m: float = KERB_M) -> None:
        """Add a building.

        Args:
            footprint: its ground plan.
            height_m: height of its walls.
            pitched: whether its roof is pitched; it is flat otherwise.
            base_m: z of its ground floor.
        """
        mesh, pose = make_building(self.rng, footprint, height_m, pitched)
        self.builder.add_mesh(mesh, translation((0, 0, base_m)) @ pose)
        self.buildings.append((footprint, base_m + height_m))
