"""Bird's-eye pictures."""

from __future__ import annotations

import io

import numpy as np
import pytest

from carlasc.captures.town.actors import EGO_ID
from carlasc.captures.town.birdseye import render_birdseye
from carlasc.captures.town.drive import Snapshot
from carlasc.captures.town.meshes import MeshBuilder
from carlasc.captures.town.rays import RayScene
from carlasc.core.geometry import rotation_z, translation
from carlasc.core.tables import CARLA

for package in ("embreex", "trimesh", "PIL"):
    pytest.importorskip(package, reason="the simulator needs carlasc[simulate]")


def picture_of_box(centre: tuple[float, float, float]) -> np.ndarray:
    """Return which pixels of a bird's-eye picture, (1080, 1920), show a box of 4 m in the ego vehicle's frame."""
    from PIL import Image

    world_T_ego = translation((30.0, -12.0, 0.0)) @ rotation_z(1.1)
    builder = MeshBuilder()
    builder.boxes(CARLA.id_of("Vehicle"), centre, (4.0, 4.0, 0.1))
    mesh = builder.build().transformed(world_T_ego)
    scene = RayScene(mesh, world_T_ego[:3, 3])
    snapshot = Snapshot(0, world_T_ego, {}, mesh, np.full(len(mesh.faces), EGO_ID, np.uint32), scene)
    pixels = np.asarray(Image.open(io.BytesIO(render_birdseye(snapshot))), np.int64)
    shown: np.ndarray = pixels.sum(axis=2) < 500
    return shown


@pytest.mark.parametrize(
    ("centre", "row", "column"),
    [
        ((20.0, 0.0, 0.0), 540 - 384, 960),  # ahead: above the middle
        ((0.0, 20.0, 0.0), 540, 960 + 384),  # on the right
        ((-20.0, -30.0, 0.0), 540 + 384, 960 - 576),
    ],
)
def test_the_upper_edge_is_ahead_and_the_picture_is_90_degrees_wide(
    centre: tuple[float, float, float], row: int, column: int
) -> None:
    shown = picture_of_box(centre)  # at 50 m, 960 pixels are 50 m: 19.2 pixels per metre
    middle = np.argwhere(shown).mean(axis=0)
    assert np.abs(middle - (row, column)).max() < 3
    assert shown.sum() == pytest.approx((4 * 19.2) ** 2, rel=0.1)
