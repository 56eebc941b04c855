"""Scans whose rays do not all begin at the sensor: several LiDARs, and a LiDAR that turns while the
vehicle moves.
"""

import shutil

import numpy as np
import pytest
from helpers.converters.drive_converter import DriveConverter

import carlasc
from carlasc.converting import LayoutOptions, Sensor, convert
from carlasc.core import GridSpec, runs_of_origins, sorted_by_origin, translation
from carlasc.groundtruth import FromScans
from carlasc.groundtruth.from_scans.merging import PreparedScan
from carlasc.groundtruth.voting.ballot import Observation, count_votes
from carlasc.motion import MotionOptions, PoseOptions
from carlasc.running import Run
from carlasc.testing import SimulatedDrive, Thing

SPEC = GridSpec("cartesian", (96, 80, 12), (-12.0, -10.0, -1.8), (12.0, 10.0, 1.2))
SPEED = 16.0


class TwoPlaces(DriveConverter):
    """Two LiDARs three metres apart beside a box that stands close to the vehicle: the front one
    looks behind it.
    """

    drive = SimulatedDrive(
        frames=2,
        speed=0.0,
        sensors=(
            Sensor("rear", translation((-1.5, 0.0, 1.7))),
            Sensor("front", translation((3.0, 0.0, 1.7))),
        ),
        things=(
            Thing("pole", (0.8, 1.6, 1.0), (1.0, 1.0, 2.0)),
            Thing("building", (0.0, 9.0, 2.0), (40.0, 2.0, 4.0)),
        ),
        channels=40,
        columns=360,
    )


def grids_of(converter, folder):
    """Return the grids of the first frame, with the origins of rays and without them."""
    convert(
        converter,
        folder,
        folder.parent / f"{folder.name}_out",
        layout=LayoutOptions(axes="right"),
        poses=PoseOptions(force=True),
        grids=None,
        run=Run(workers=1),
    )
    (sequence,) = carlasc.open(folder.parent / f"{folder.name}_out").sequences().values()
    found = []
    for name in ("own", "one"):
        if name == "one":
            shutil.rmtree(f"{sequence.location}/origins")
        observe = FromScans(window=(0, 0), own_path=False, motion=MotionOptions("none"))
        carlasc.regrid(
            sequence.location, SPEC, name=name, observe=observe, frames=(0, 1), run=Run(workers=1)
        )
        (again,) = carlasc.open(folder.parent / f"{folder.name}_out").sequences().values()
        found.append(again.grid(name, 0))
    return found


def test_free_space_is_cast_from_the_place_of_each_lidar(tmp_path):
    (tmp_path / "in").mkdir()
    own, one = grids_of(TwoPlaces, tmp_path / "in")
    assert _free_inside(own) == 0
    # rays from one place to what the front LiDAR saw behind the box go through it
    assert _free_inside(one) > 20


def _free_inside(grid):
    """Return the number of voxels inside the box that are called free."""
    centers = SPEC.centers().reshape(-1, 3)
    inside = (np.abs(centers - (2.3, 1.6, -0.7)) < (0.3, 0.3, 0.8)).all(axis=1)
    labels, counts = grid.labels.reshape(-1), grid.counts.reshape(-1)
    return int(((labels == 0) & (counts > 0))[inside].sum())


def test_the_votes_of_a_scan_are_those_of_its_parts():
    rng = np.random.default_rng(3)
    points = rng.uniform((-9, -9, -1.5), (9, 9, 1.0), (4000, 3)).astype(np.float32)
    labels = rng.integers(1, 20, 4000).astype(np.uint32)
    places = np.array([[0, 0, 0], [2.5, 0.4, -0.3], [-1, 1, 0.2]], np.float32)
    which = rng.integers(0, 3, 4000)
    order = sorted_by_origin(places[which])
    scan = PreparedScan.of(0, points[order], labels[order], np.eye(4), origins=places[which][order])
    assert len(scan.rays.ends) == 3 and scan.rays.ends[-1] == 4000
    together = count_votes(
        [Observation(scan.ends, scan.labels, scan.world_T_places, scan.rays.ends)],
        SPEC,
    )
    expected = count_votes(
        [
            Observation(
                points[which == k] - places[k],
                labels[which == k].astype(np.uint16),
                translation(places[k]),
            )
            for k in range(3)
        ],
        SPEC,
    )
    np.testing.assert_array_equal(together.free, expected.free)
    np.testing.assert_array_equal(together.elect_occupied()[1], expected.elect_occupied()[1])


def test_origins_are_sorted_into_runs_and_keep_the_order_of_points():
    origins = np.array([[0, 0, 1], [0, 0, 0], [0, 0, 1], [0, 0, 0], [0, 0, 1]], np.float32)
    order = sorted_by_origin(origins)
    assert order.tolist() == [1, 3, 0, 2, 4]
    assert [
        (part.start, part.stop, origin.tolist())
        for part, origin in runs_of_origins(origins[order], 5)
    ] == [
        (0, 2, [0, 0, 0]),
        (2, 5, [0, 0, 1]),
    ]
    assert runs_of_origins(None, 3)[0][0] == slice(0, 3)
    assert len(sorted_by_origin(np.empty((0, 3), np.float32))) == 0


@pytest.mark.slow
@pytest.mark.parametrize("rolling", [False, True])
def test_a_lidar_that_turns_on_a_fast_vehicle_leaves_as_much_free_space_wrong_as_one_that_does_not(
    rolling, tmp_path
):
    class Fast(DriveConverter):
        drive = SimulatedDrive(
            frames=3,
            speed=SPEED,
            sensors=(Sensor("roof", translation((0.0, 0.0, 1.7)), deskewed=not rolling),),
            rolling=rolling,
            channels=40,
            columns=360,
        )

    (tmp_path / "in").mkdir()
    convert(
        Fast,
        tmp_path / "in",
        tmp_path / "out",
        layout=LayoutOptions(axes="right"),
        poses=PoseOptions(force=True),
        grids=None,
        run=Run(workers=1),
    )
    (sequence,) = carlasc.open(tmp_path / "out").sequences().values()
    assert ("origins" in sequence.fields()) == rolling
    carlasc.regrid(
        sequence.location,
        SPEC,
        name="g",
        observe=FromScans(window=(-1, 1), motion=MotionOptions("none")),
        run=Run(workers=1),
    )
    (sequence,) = carlasc.open(tmp_path / "out").sequences().values()
    grid, frame = sequence.grid("g", 1), 1
    vehicle = Fast.drive.world_T_vehicle(frame * Fast.drive.period_s)
    centers = SPEC.centers().reshape(-1, 3) + (0, 0, 1.7)
    world = centers @ vehicle[:3, :3].T + vehicle[:3, 3]
    solid = np.zeros(len(world), bool)
    for thing in Fast.drive.things:
        if thing.speed == 0:
            pose = thing.world_T_box(0.0)
            body = (world - pose[:3, 3]) @ pose[:3, :3]
            solid |= (np.abs(body) < np.array(thing.size) / 2 - 0.2).all(axis=1)
    labels, counts = grid.labels.reshape(-1), grid.counts.reshape(-1)
    known = solid & (counts > 0)
    assert solid.sum() > 100
    assert ((labels == 0) & known).sum() <= 0.02 * solid.sum()
