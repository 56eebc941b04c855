from __future__ import annotations

import numpy as np
import pytest
from carlasc_recorders import TownDrive
from carlasc_recorders.town.plan import Land, Rectangle
from carlasc_recorders.town.town import build_town

from carlasc.core.tables import CARLA

pytest.importorskip("embreex", reason="the simulator needs carlasc[simulate]")
pytest.importorskip("trimesh", reason="the simulator needs carlasc[simulate]")


def test_the_same_seed_builds_the_same_town(drive: TownDrive, twin: TownDrive) -> None:
    again = twin.town
    np.testing.assert_array_equal(again.mesh.vertices, drive.town.mesh.vertices)
    np.testing.assert_array_equal(again.mesh.faces, drive.town.mesh.faces)
    np.testing.assert_array_equal(again.mesh.labels, drive.town.mesh.labels)


@pytest.mark.slow
def test_another_seed_builds_another_town(drive: TownDrive) -> None:
    other = build_town(np.random.default_rng(1234))
    assert other.mesh.vertices.shape != drive.town.mesh.vertices.shape


def test_the_static_town_has_all_static_classes(drive: TownDrive) -> None:
    names = {CARLA.names[int(label)] for label in np.unique(drive.town.mesh.labels)}
    assert names == set(CARLA.names.values()) - {"Free", "Sky", "Vehicle", "Pedestrian"}


def test_the_mesh_is_valid(drive: TownDrive) -> None:
    mesh = drive.town.mesh
    assert np.isfinite(mesh.vertices).all()
    assert mesh.faces.min() >= 0
    assert mesh.faces.max() < len(mesh.vertices)
    assert mesh.labels.shape == (len(mesh.faces),)


def test_road_is_level_markings_lie_just_above_and_sidewalks_are_raised(drive: TownDrive) -> None:
    mesh = drive.town.mesh
    heights = {
        name: mesh.vertices[np.unique(mesh.faces[mesh.labels == CARLA.id_of(name)]), 2]
        for name in ("Road", "RoadLine", "Sidewalk")
    }
    assert (heights["Road"] == 0.0).all()
    on_road = heights["RoadLine"][heights["RoadLine"] < 0.1]
    assert on_road.size
    assert ((on_road > 0) & (on_road <= 0.02)).all()
    assert heights["Sidewalk"].max() == pytest.approx(0.15)


def test_no_building_is_on_a_lane(drive: TownDrive) -> None:
    lanes = np.concatenate([lane.path for lane in drive.town.streets.lanes])
    for footprint, _ in drive.town.buildings:
        assert not footprint.contains(lanes, margin_m=1.5).any()


def test_rectangles_overlap_as_their_areas_do() -> None:
    square = Rectangle(np.zeros(2), (2.0, 2.0), 0.0)
    turned = Rectangle(np.array([2.2, 0.0]), (2.0, 2.0), np.pi / 4)
    assert square.overlaps(turned)  # a corner reaches in
    assert not square.overlaps(Rectangle(np.array([2.2, 0.0]), (2.0, 2.0), 0.0))
    assert square.overlaps(Rectangle(np.array([2.2, 0.0]), (2.0, 2.0), 0.0), margin_m=0.3)
    assert not square.overlaps(Rectangle(np.array([2.2, 2.2]), (2.0, 2.0), np.pi / 4), margin_m=0.2)


def test_land_is_reserved_once_and_only_inside_its_boundary() -> None:
    notched = np.array(
        [[0, 0], [10, 0], [10, 10], [6, 10], [6, 5], [4, 5], [4, 10], [0, 10]], float
    )
    land = Land(notched)
    assert not land.reserve(Rectangle(np.array([5.0, 8.0]), (1.0, 1.0), 0.0))  # in the notch
    assert not land.reserve(Rectangle(np.array([0.0, 5.0]), (1.0, 1.0), 0.0))  # across the edge
    assert land.reserve(Rectangle(np.array([2.0, 2.0]), (2.0, 2.0), 0.3))
    assert not land.reserve(Rectangle(np.array([2.5, 2.5]), (2.0, 2.0), 0.0))
    assert land.reserve(Rectangle(np.array([7.5, 2.5]), (2.0, 2.0), 0.0))
