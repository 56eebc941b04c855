"""A street whose edges repeat: rails, crash barriers, fences, hedges, kerbs and rows of posts, the
negatives of movers without labels.

What repeats looks the same after a shift along itself, and rays pass its gaps: nothing that stands
is harder for a method that looks for motion. The road and the movers are those of `street.py`, but
only every third mover, so that most of what is seen stands.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from carlasc_recorders.town import furniture
from carlasc_recorders.town.meshes import Mesh, MeshBuilder
from carlasc_recorders.town.plan import KERB_M, hedge
from street import END_M, HALF_ROAD_M, START_M, WALK_M, StreetDrive, Traffic, build_street

from carlasc.captures import Lidar
from carlasc.core.geometry import rotation_z, translation
from carlasc.core.tables import CARLA

_EVERY = 3  # mover of a street is kept
# middles of the rails in the road, and of the railway beside it
_TRAM_Y_M, _TRACK_Y_M = (
    -1.75,
    17.0,
)
_STREAM = 2000  # of random numbers


class RailedDrive(StreetDrive):
    """A drive along such a street."""

    def __init__(self, seed: int, lidar: Lidar | None = None) -> None:
        """Build the street and its traffic; the arguments are those of `Drive`."""
        super().__init__(seed, lidar)
        rng = np.random.default_rng([seed, _STREAM])
        traffic = Traffic(rng)
        traffic.movers = [traffic.movers[0], *traffic.movers[1::_EVERY]]
        street = build_street(rng, houses=(-1.0,))
        edges = MeshBuilder()
        edges.add_mesh(street.mesh, np.eye(4))
        _add_edges(edges, rng)
        self.town = replace(street, mesh=edges.build())
        self._population = traffic


def _add_edges(builder: MeshBuilder, rng: np.random.Generator) -> None:
    """Add what repeats along the street: pieces with random lengths and gaps in rows beside each
    other.
    """
    rail, fence, post = (CARLA.id_of(name) for name in ("RailTrack", "Fence", "Pole"))
    length, middle = END_M - START_M, (START_M + END_M) / 2
    # they stand out by what wheels leave beside them
    for y in (
        _TRAM_Y_M - 0.72,
        _TRAM_Y_M + 0.72,
    ):
        builder.boxes(rail, (middle, y, -0.1), (length, 0.08, 0.18))
    sidewalk, land = HALF_ROAD_M + 0.15, HALF_ROAD_M + WALK_M
    builder.add_mesh(furniture.rail_track(length), translation((middle, _TRACK_Y_M, -0.15)))
    rows = (
        (land + 0.6, 1.0, furniture.guard_rail),
        (_TRACK_Y_M + 3.0, 1.0, lambda m: furniture.fence(m, 1.8)),
        (_TRACK_Y_M + 5.0, 1.0, lambda m: hedge(rng, m)),
        (-land + 0.3, 0.6, lambda m: hedge(rng, m)),
        (-land + 0.2, 0.6, furniture.fence),
        (-sidewalk, 0.4, lambda m: _railing(fence, m)),
    )
    for y, share, make in rows:
        x = START_M + float(rng.uniform(0, 8))
        while x < END_M:
            piece = float(rng.uniform(6.0, 30.0))
            if rng.random() < share:
                builder.add_mesh(
                    make(piece),
                    translation((x + piece / 2, y, KERB_M)) @ rotation_z(0.0 if y > 0 else np.pi),
                )
            x += piece + float(rng.uniform(0.3, 4.0))
    for x in np.arange(START_M, END_M, float(rng.uniform(1.5, 2.5))):
        builder.cylinder(post, (float(x), sidewalk + 0.1, 0.0), 0.06, 1.1, 8)


def _railing(label: int, length_m: float) -> Mesh:
    """Return a railing along x with its middle at the origin: thin bars, which most rays pass,
    between two beams.
    """
    builder = MeshBuilder()
    bars = np.arange(-length_m / 2, length_m / 2, 0.25)
    builder.boxes(label, np.column_stack([bars, 0 * bars, 0 * bars]), (0.03, 0.03, 1.0))
    for z in (0.15, 1.0):
        builder.boxes(label, (0, 0, z), (length_m, 0.04, 0.05))
    return builder.build()
