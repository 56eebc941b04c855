"""Rays cast through voxel grids that are torch tensors, on their own device: all rays take a step at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from carlasc.core.grids import GridSpec

if TYPE_CHECKING:
    import torch


def cast_rays_on_device(
    grids: torch.Tensor, spec: GridSpec, origins: ArrayLike, directions: ArrayLike, *, free: int = 0
) -> tuple[torch.Tensor, torch.Tensor]:
    """Cast rays as `cast_rays` does, on the device of the grids. Origins must lie inside the grid.

    Args:
        grids: (G, X, Y, Z) integer tensor of class ids.
        spec: their geometry, Cartesian.
        origins: (O, 3) metres, the grid's frame.
        directions: (R, 3) unit vectors, the grid's frame.
        free: the id of free space.

    Returns:
        (G, O * R) int64 flat index of the voxel that each ray takes, and (G, O * R) float64 metres to where the ray leaves it.
    """
    import torch

    device, double = grids.device, torch.float64
    voxel = spec.voxel_size
    starts = torch.as_tensor((np.asarray(origins, np.float64) - np.array(spec.lower)) / voxel, device=device)
    steps = torch.as_tensor(np.asarray(directions, np.float64) / voxel, device=device)
    start, step = starts.repeat_interleave(len(steps), dim=0), steps.repeat(len(starts), 1)
    size = torch.tensor(spec.size, device=device)
    strides = torch.tensor([spec.size[1] * spec.size[2], spec.size[2], 1], device=device)
    solid = (grids != free).reshape(len(grids), -1)

    cell = torch.minimum(start.floor().long().clamp(min=0), size - 1)
    infinite = torch.full((), torch.inf, dtype=double, device=device)
    to_face = torch.where(step != 0, (cell + (step > 0) - start) / step, infinite)
    between = torch.where(step != 0, (1 / step).abs(), infinite)
    sign = torch.where(step > 0, 1, -1)
    found = torch.full((len(grids), len(start)), -1, dtype=torch.int64, device=device)
    depth = torch.zeros(found.shape, dtype=double, device=device)
    walking = torch.arange(len(start), device=device)
    open_rays = torch.ones(found.shape, dtype=torch.bool, device=device)
    while len(walking):
        distance, axis = to_face[walking].min(dim=1)
        flat = (cell[walking] * strides).sum(dim=1)
        further = cell[walking].scatter_add(1, axis[:, None], sign[walking].gather(1, axis[:, None]))
        leaves = ((further < 0) | (further >= size)).any(dim=1)
        ends = (solid[:, flat] | leaves) & open_rays[:, walking]
        for g in range(len(grids)):
            rays = walking[ends[g]]
            found[g, rays], depth[g, rays] = flat[ends[g]], distance[ends[g]]
            open_rays[g, rays] = False
        goes_on = open_rays[:, walking].any(dim=0) & ~leaves
        walking, axis = walking[goes_on], axis[goes_on]
        cell[walking] = further[goes_on]
        to_face[walking, axis] += between[walking, axis]
    return found, depth
