"""What the rays of a LiDAR return: the nearest surface, and what real LiDARs return besides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from carlasc.captures.settings import Lidar, LidarEffects
from carlasc.core.arrays import BoolArray, FloatArray, IntArray, LabelArray, Uint32Array
from carlasc.core.geometry import Transform
from carlasc.core.tables import CARLA
from carlasc_recorders.town.meshes import Mesh, RayScene, rotate_exactly

_DROP_M = 5.0  # mean distance of the drops of rain that return a ray
_BEAM_RAD = 1.5e-3  # from the middle of a beam to its edge: that of VLP-16 is 3 mrad wide
_APART_M = 0.5  # nearer surfaces are one return
NO_SURFACE = 255
"""Label of returns in the air."""

_MIRRORS = tuple(CARLA.id_of(name) for name in ("Vehicle", "Building"))


class Seen(Protocol):
    """A part of the world at one instant."""

    @property
    def mesh(self) -> Mesh:
        """The triangles."""

    @property
    def instances(self) -> Uint32Array:
        """(F,) id of the actor of each triangle, 0 for none."""

    @property
    def scene(self) -> RayScene:
        """The same mesh, for ray casting."""


class Luck(NamedTuple):
    """What is drawn for each ray of a scan, so that it does not depend on which rays hit a surface.

    Attributes:
        noise: (R, 3) errors of the coordinates, metres.
        scale: (R,) factor of the distance.
        lost: (R,) whether a ray has no return.
        drop: (R,) distance of the drop of rain that a ray meets, metres; inf for none.
        mirrored: (R,) whether a ray is reflected by a surface that can be a mirror.
    """

    noise: FloatArray
    scale: FloatArray
    lost: BoolArray
    drop: FloatArray
    mirrored: BoolArray

    @classmethod
    def draw(cls, lidar: Lidar, effects: LidarEffects, rng: np.random.Generator) -> Luck:
        """Draw it for all rays of a LiDAR."""
        rays = len(lidar.directions)
        noise = rng.uniform(-lidar.noise_m, lidar.noise_m, (rays, 3))
        scale = np.ones(rays)
        drop = np.full(rays, np.inf)
        none = np.zeros(rays, np.bool_)
        if effects == LidarEffects():
            return cls(noise, scale, none, drop, none)
        scale += effects.range_noise * rng.standard_normal(rays)
        shares = np.array([effects.drop_outs, effects.reflections, effects.rain])
        lost, mirrored, wet = rng.random((3, rays)) < shares[:, None]
        drop[wet] = rng.exponential(_DROP_M, np.count_nonzero(wet))
        return cls(noise, scale, lost, drop, mirrored)

    def take(self, rays: IntArray) -> Luck:
        """Return that of some rays."""
        return Luck._make(values[rays] for values in self)


class Returns(NamedTuple):
    """The returns of rays.

    Attributes:
        rays: (H,) indices of the rays.
        distances: (H,) metres.
        labels: (H,) classes; `NO_SURFACE` where none is.
        instances: (H,) ids of actors; 0 for none.
        normals: (H, 3) of the surfaces, or (H, 0) if they are not needed.
    """

    rays: IntArray
    distances: FloatArray
    labels: LabelArray
    instances: Uint32Array
    normals: FloatArray

    def take(self, rows: BoolArray | IntArray) -> Returns:
        """Return some of them."""
        return Returns._make(values[rows] for values in self)


def cast(
    seen: Sequence[Seen],
    world_T_sensor: Transform,
    directions: FloatArray,
    lidar: Lidar,
    effects: LidarEffects,
    luck: Luck,
) -> Returns:
    """Return the returns of (R, 3) rays in the frame of a sensor."""
    rays = rotate_exactly(world_T_sensor, directions)
    origin = world_T_sensor[:3, 3]
    found = _nearest(seen, origin, rays, lidar.range_m, normals=effects.reflections > 0)
    if effects.reflections:
        found = _mirrored(seen, found, origin, rays, lidar.range_m, luck.mirrored)
    if effects.second_returns:
        found = _with_second(found, _nearest(seen, origin, _edges(rays), lidar.range_m))
    if effects.rain:
        found = _rained_on(found, luck.drop, lidar.range_m)
    return found.take(~luck.lost[found.rays]) if effects.drop_outs else found


def _joined(*parts: Returns) -> Returns:
    return Returns._make(np.concatenate(values) for values in zip(*parts, strict=True))


def _nearest(
    seen: Sequence[Seen],
    origins: FloatArray,
    rays: FloatArray,
    range_m: float,
    *,
    normals: bool = False,
) -> Returns:
    """Return the nearest surface that each ray meets in several parts of the world."""
    parts = []
    for part in seen:
        hit, triangles, distances = part.scene.cast(origins, rays, range_m)
        of_surfaces = part.scene.normals(triangles) if normals else np.empty((len(hit), 0))
        labels = part.mesh.labels[triangles]
        instances = part.instances[triangles]
        parts.append(Returns(hit, distances, labels, instances, of_surfaces))
    if len(parts) == 1:
        return parts[0]
    hits = _joined(*parts)
    order = np.lexsort((hits.distances, hits.rays))
    return hits.take(order[np.unique(hits.rays[order], return_index=True)[1]])


def _edges(rays: FloatArray) -> FloatArray:
    """Return rays at the left edges of beams."""
    sideways = np.column_stack([-rays[:, 1], rays[:, 0], np.zeros(len(rays))])
    turned = rays + _BEAM_RAD * sideways
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


def _with_second(first: Returns, edge: Returns) -> Returns:
    """Add what the edges of beams meet, where it is apart from what their middles meet."""
    distance = np.full(1 + max(first.rays.max(initial=0), edge.rays.max(initial=0)), np.nan)
    distance[first.rays] = first.distances
    second = edge.take(np.abs(edge.distances - distance[edge.rays]) > _APART_M)
    return _joined(first, second)


def _mirrored(
    seen: Sequence[Seen],
    found: Returns,
    origin: FloatArray,
    rays: FloatArray,
    range_m: float,
    mirrored: BoolArray,
) -> Returns:
    """Move the returns of mirrors to behind them, as far as what is seen in them is away."""
    found, normals = found._replace(normals=np.empty((len(found.rays), 0))), found.normals
    rows = np.flatnonzero(mirrored[found.rays] & np.isin(found.labels, _MIRRORS))
    at = found.take(rows)
    normal = normals[rows]
    incoming = rays[at.rays]
    outgoing = incoming - 2 * (incoming * normal).sum(axis=1, keepdims=True) * normal
    # a little off the surface, which would be met again
    points = origin + incoming * (at.distances[:, None] - 1e-3)
    image = _nearest(seen, points, outgoing, range_m)
    way = at.distances[image.rays] + image.distances
    ghosts = _of_no_surface(at.rays[image.rays], way, found).take(way <= range_m)
    others = found.take(np.setdiff1d(np.arange(len(found.rays)), rows))
    return _joined(others, ghosts)


def _rained_on(found: Returns, drop: FloatArray, range_m: float) -> Returns:
    """Replace the returns of rays that meet a drop of rain before."""
    reach = np.full(len(drop), range_m)
    np.minimum.at(reach, found.rays, found.distances)
    wet = np.flatnonzero(drop < reach)
    drops = _of_no_surface(wet, drop[wet], found)
    dry = found.take(drop[found.rays] >= reach[found.rays])
    return _joined(dry, drops)


def _of_no_surface(rays: IntArray, distances: FloatArray, others: Returns) -> Returns:
    """Return returns in the air, with arrays of the types of others."""
    labels = np.full(len(rays), NO_SURFACE, others.labels.dtype)
    instances = np.zeros(len(rays), others.instances.dtype)
    return Returns(rays, distances, labels, instances, np.empty((len(rays), 0)))
