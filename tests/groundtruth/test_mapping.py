"""Maps of drives: one point per cell, as a few lines of plain Python say, without what moves; their
files, and what is refused.
"""

import csv
import json

import numpy as np
import pytest
from carlasc_converters.point_files import read_columns
from helpers.errors import raises
from helpers.scenes.passing_car import CAR, SPEED_M_S, scan, sensor_pose, write_sequence
from numpy.testing import assert_allclose, assert_array_equal

import carlasc
from carlasc import GridSpec, MapExtras, Run
from carlasc.core.geometry import (
    mirror_poses,
    quaternions_of,
    relative_to,
    rotation_z,
    transform_points,
)
from carlasc.core.grids import mirror_voxels
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, ConflictError, MissingDataError
from carlasc.groundtruth import Voting
from carlasc.groundtruth.maps.map_files import MapCells
from carlasc.motion import MotionOptions, PoseOptions
from carlasc.storage import layout

FRAMES = 14
ALONE, NONE, FLOW = Run(workers=1), MotionOptions("none"), MotionOptions("flow")
GIVEN = PoseOptions("file", "never")
SPEC = GridSpec.published().with_bounds((-12.8, -12.8, -2), (12.8, 12.8, 1.2)).with_resolution(0.4)
GRID = layout.grid_folder(SPEC)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A car passes while the sensor moves slowly."""
    folder = write_sequence(tmp_path_factory.mktemp("drive"), frames=FRAMES)
    voting = Voting(rule="sensor")
    carlasc.regrid(
        folder,
        SPEC,
        observe=carlasc.FromScans(dynamic="tube"),
        voting=voting,
        frames="3",
        run=ALONE,
    )
    return folder


def make(drive, out, **options):
    given = {"motion": NONE, "poses": GIVEN, "run": ALONE, "cell_m": 0.1} | options
    extras = MapExtras(**{k: given.pop(k) for k in vars(MapExtras()) if k in given})
    return carlasc.map(drive, out, extras=extras, **given)


def world_points(frame):
    """Return the points of a scan in the frame of the first one, y to the left, their labels, and
    which are on the car.
    """
    pose = sensor_pose(frame)
    points, labels, moving = scan(frame, pose)
    pose = relative_to(sensor_pose(0), pose[None])[0]
    return (
        transform_points(pose, points.astype(np.float32).astype(np.float64)) * (1, -1, 1),
        labels,
        moving,
    )


def plain_map(cell_m, frames):
    """Return {cell: [points, labels by scan]} by one point after the other."""
    cells = {}
    for frame in frames:
        points, labels, _ = world_points(frame)
        here = {}
        for point, label in zip(points, labels.tolist(), strict=True):
            here.setdefault(tuple(np.floor(point / cell_m).astype(int).tolist()), []).append(
                (point, label)
            )
        for cell, found in here.items():
            counts = np.bincount([label for _, label in found])
            vote = (int(counts.argmax()), counts.max() / len(found))
            whole, votes = cells.setdefault(cell, ([], []))
            whole += [point for point, _ in found]
            votes.append(vote)
    return cells


def test_a_map_is_what_plain_python_makes(drive, tmp_path):
    frames = range(3, 5)
    result = make(drive, tmp_path / "map.npz", frames=frames)
    made, expected = np.load(tmp_path / "map.npz"), plain_map(0.1, frames)
    cells = np.floor(made["points"].astype(np.float64) / 0.1).astype(int)
    assert result.points == len(cells) == len(expected) and result.frames == 2
    order = [expected[tuple(cell)] for cell in cells.tolist()]  # KeyError: a cell without points
    inside = np.array([np.mean(points, axis=0) for points, _ in order]) / 0.1 - cells
    assert_allclose(made["points"], 0.1 * (np.clip(inside, 1 / 64, 63 / 64) + cells), atol=1e-4)
    shares = [
        np.bincount([label for label, _ in votes], [share for _, share in votes])
        for _, votes in order
    ]
    assert_array_equal(made["label"], [votes.argmax() for votes in shares])
    assert_array_equal(made["seen"], [len(votes) for _, votes in order])
    assert_allclose(
        made["confidence"],
        [v.max() / (len(votes) + 1) for v, (_, votes) in zip(shares, order, strict=True)],
        atol=1e-4,
    )
    assert dict(made["classes"].tolist())[1] == CARLA.names[1]


def test_the_trajectory_is_that_of_the_drive_in_the_format_of_tum(drive, tmp_path):
    make(drive, tmp_path / "map.ply", frames="2:5", trajectory=tmp_path / "poses.tum")
    table = np.loadtxt(tmp_path / "poses.tum")
    for row, frame in zip(table, range(2, 5), strict=True):
        pose = relative_to(sensor_pose(0), sensor_pose(frame)[None])[0]
        pose = mirror_poses(pose[None])[0]  # the drive has y to the right
        assert_allclose(row[:4], [0.1 * frame, *pose[:3, 3]], atol=1e-5)
        assert_allclose(row[[7, 4, 5, 6]], quaternions_of(pose[None, :3, :3])[0], atol=1e-5)
    with raises(ArgumentError, where="trajectory"):
        make(drive, tmp_path / "g.ply", grid=GRID, trajectory=tmp_path / "other.tum")


def test_boxes_of_moving_actors_are_a_table_in_the_frame_of_the_map(drive, tmp_path):
    options = {"motion": FLOW, "frames": "2:5"}
    make(drive, tmp_path / "a.npz", boxes_out=tmp_path / "boxes.csv", **options)
    make(drive, tmp_path / "b.npz", boxes_out=tmp_path / "boxes.json", **options)
    with (tmp_path / "boxes.csv").open() as file:
        rows = list(csv.DictReader(file))
    same = [
        {name: "" if value is None else str(value) for name, value in row.items()}
        for row in json.loads((tmp_path / "boxes.json").read_text())
    ]
    assert rows == same
    numbers = [row["number"] for row in rows]
    rows = [row for row in rows if numbers.count(row["number"]) == 3]  # the car
    assert [row["time"] for row in rows] == ["0.2", "0.3", "0.4"]
    for row, frame in zip(rows, range(2, 5), strict=True):
        points, _, moving = world_points(frame)
        half = np.array([float(row[name]) for name in ("length", "width", "height")]) / 2
        middle = np.array([float(row[name]) for name in "xyz"])
        turned = rotation_z(-float(row["heading"]))[:3, :3]
        inside = (np.abs((points[moving] - middle) @ turned.T) < half + 0.1).all(axis=1)
        assert inside.mean() > 0.95
        ahead = np.array([np.cos(float(row["heading"])), np.sin(float(row["heading"]))])
        velocity = np.array([float(row["vx"]), float(row["vy"])])
        assert velocity @ ahead > 0.9 * np.linalg.norm(velocity) > 1
    with raises(ArgumentError, where="boxes_out"):
        make(drive, tmp_path / "g.ply", grid=GRID, boxes_out=tmp_path / "g.csv")


def test_what_moves_leaves_no_trace_and_what_stands_stays(drive, tmp_path):
    result = make(drive, tmp_path / "map.npz", motion=FLOW, actors=True)
    points = np.load(tmp_path / "map.npz")["points"]
    worlds = [world_points(frame) for frame in range(FRAMES)]
    car = np.concatenate([points[moving] for points, _, moving in worlds])
    stands = np.concatenate([points[~moving] for points, _, moving in worlds])
    cells = {tuple(cell) for cell in np.floor(points.astype(np.float64) / 0.1).astype(int).tolist()}
    trace = [tuple(cell) in cells for cell in np.floor(car / 0.1).astype(int).tolist()]
    kept = [tuple(cell) in cells for cell in np.floor(stands / 0.1).astype(int).tolist()]
    assert len(trace) > 1000 and np.mean(trace) < 0.01
    assert np.mean(kept) > 0.99

    actor, *parts = json.loads((tmp_path / "map_actors" / "actors.json").read_text())
    assert (
        result.actors == 1 + len(parts)
        and actor["class"] == "Vehicle"
        and actor["frames"] == list(range(FRAMES))
    )
    places = np.array(actor["map_T_actor"]).reshape(-1, 3, 4)[:, :, 3]
    assert_allclose(np.diff(places[:, 0]), SPEED_M_S * 0.1, atol=0.1)
    with np.load(tmp_path / "map_actors" / actor["file"]) as body:
        spread = np.ptp(body["points"], axis=0)
    assert spread[0] == pytest.approx(CAR[0], abs=0.4) and spread[1] < CAR[1] + 0.3
    again = np.concatenate(
        [
            transform_points(np.vstack([np.reshape(p, (3, 4)), [0, 0, 0, 1]]), np.zeros((1, 3)))
            for p in actor["map_T_actor"]
        ]
    )
    assert (np.abs(again[:, 1] + 2.6 + CAR[1] / 2) < 0.5).all()  # it passes on the right


def test_all_files_of_points_hold_the_same_points(drive, tmp_path):
    pytest.importorskip("laspy")
    made = {}
    for ending in (".npz", ".ply", ".pcd", ".las"):
        make(drive, tmp_path / f"map{ending}", frames="0:2")
        made[ending] = (
            read_columns(tmp_path / f"map{ending}")
            if ending != ".npz"
            else np.load(tmp_path / "map.npz")
        )
    expected = made.pop(".npz")
    for ending, columns in made.items():
        places = np.stack([columns[axis] for axis in "xyz"], axis=1)
        assert_allclose(places, expected["points"], atol=1e-4 if ending == ".las" else 0)
        for name in ("label", "seen", "confidence"):
            assert_array_equal(columns[name], expected[name])
    color = CARLA.colors[int(expected["label"][0])]
    assert tuple(int(made[".ply"][name][0]) for name in ("red", "green", "blue")) == color
    assert tuple(int(made[".las"][name][0]) // 257 for name in ("red", "green", "blue")) == color
    assert int(made[".pcd"]["rgb"][0]) & 0xFFFFFF == color[0] << 16 | color[1] << 8 | color[2]
    assert_array_equal(made[".las"]["classification"], expected["label"])


@pytest.mark.slow
def test_other_programs_read_the_map_and_its_mesh(drive, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    result = make(drive, tmp_path / "map.ply", frames="0:2", mesh=tmp_path / "map.glb")
    cloud, scene = trimesh.load(tmp_path / "map.ply"), trimesh.load(tmp_path / "map.glb")
    assert len(cloud.vertices) == result.points and cloud.colors.shape == (result.points, 4)
    (mesh,) = scene.geometry.values()
    # in glTF, y is up
    turned = np.stack([mesh.bounds[:, 0], -mesh.bounds[::-1, 2], mesh.bounds[:, 1]], axis=1)
    assert_allclose(turned, cloud.bounds, atol=0.1)
    assert len(mesh.faces) > 10 * result.points ** (1 / 2) and mesh.volume > 0
    colors = {tuple(color[:3]) for color in np.unique(mesh.visual.vertex_colors, axis=0).tolist()}
    assert colors == {tuple(color[:3]) for color in np.unique(cloud.colors, axis=0).tolist()}


@pytest.mark.slow
def test_processes_and_right_handed_data_make_the_same_map(drive, tmp_path):
    make(drive, tmp_path / "one.npz", motion=FLOW)
    make(drive, tmp_path / "two.npz", motion=FLOW, run=Run(workers=2))
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()


def test_a_grid_is_a_map_of_its_voxels(drive, tmp_path):
    result = make(drive, tmp_path / "grid.npz", grid=GRID, distance=tmp_path / "far.npz")
    (sequence,) = carlasc.open(drive).sequences().values()
    grid = sequence.grid(GRID, 3)
    points = np.load(tmp_path / "grid.npz")
    assert result.points == np.count_nonzero(grid.labels) and result.actors == 0
    voxel = SPEC.flat_index(points["points"].astype(np.float64) * (1, -1, 1))
    assert_array_equal(np.sort(voxel), np.flatnonzero(grid.labels))
    assert_array_equal(points["label"], grid.labels.reshape(-1)[voxel])
    assert_array_equal(points["seen"], grid.counts.reshape(-1)[voxel])
    assert np.load(tmp_path / "far.npz")["distance"].shape == SPEC.size


def test_wrong_arguments_are_refused_before_anything_is_written(drive, tmp_path, monkeypatch):
    out = tmp_path / "map.ply"
    for message, options in {
        "out: expected a file that ends in .ply": {"out": tmp_path / "map.xyz"},
        "mesh: expected a file that ends in .ply, .glb": {"mesh": tmp_path / "mesh.obj"},
        "out: expected a file to write": {"out": None},
        "cell_m: expected 0.001 metres or more, found nan": {"cell_m": float("nan")},
        "distance: expected the `grid`": {"distance": tmp_path / "far.npz"},
        "actors: expected a file of points of a drive": {"actors": True, "grid": GRID},
        "mesh: expected files of different names": {"mesh": out},
        "part: expected none": {"run": Run(part=carlasc.running.Part(1, 2))},
    }.items():
        with pytest.raises(ArgumentError, match=message):
            make(drive, **({"out": out} | options))
    with pytest.raises(MissingDataError, match=f"expected the grid other, found {GRID}"):
        make(drive, out, grid="other")
    with pytest.raises(MissingDataError) as error:
        make(drive, out, frames="99:")
    assert error.value.expected.startswith("frames in 99:")
    with pytest.raises(MissingDataError) as error:
        for name in ("static", "under"):
            monkeypatch.setattr(
                f"carlasc.groundtruth.from_scans.merging.Merger.{name}",
                lambda self, frame: np.zeros(len(self.scan_of(frame).points), bool),
            )
        make(drive, out, frames="0:2")
    assert error.value.expected == "points of something static"
    assert list(tmp_path.iterdir()) == []


def test_a_map_without_poses_is_one_line(tmp_path):
    folder = write_sequence(tmp_path / "drive", frames=3, poses=False)
    with pytest.raises(MissingDataError) as error:
        make(folder, tmp_path / "map.ply")
    assert error.value.where.endswith("poses.txt") and error.value.found == "none"


def test_several_sequences_have_no_one_frame(tmp_path):
    write_sequence(tmp_path / "a", frames=2)
    (tmp_path / "b").mkdir()
    (tmp_path / "a").rename(tmp_path / "b" / "one")
    write_sequence(tmp_path / "b" / "two", frames=2)
    with pytest.raises(ArgumentError) as error:
        make(tmp_path / "b", tmp_path / "map.ply")
    assert error.value.where == "source" and error.value.found.startswith("2 (")


def test_what_exists_stays_unless_it_is_to_be_replaced(drive, tmp_path):
    out = tmp_path / "map.npz"
    make(drive, out, frames="0:1", actors=True)
    before = out.read_bytes()
    with pytest.raises(ConflictError) as error:
        make(drive, out, frames="0:2")
    assert error.value.found == "a file"
    assert out.read_bytes() == before
    make(drive, out, frames="0:2", actors=True, overwrite=True)
    assert out.read_bytes() != before and sorted(path.name for path in tmp_path.iterdir()) == [
        ".carlasc",
        "map.npz",
        "map_actors",
    ]


@pytest.mark.parametrize("steps", [0, 1, 2])
def test_an_interrupted_run_leaves_nothing(drive, tmp_path, steps):
    def progress(done, total):
        if done >= steps:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make(drive, tmp_path / "map.ply", frames="0:2", run=Run(workers=1, progress=progress))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("lower", "size", "message"),
    [
        (
            (0, 0, 0),
            (0.4, 0.4, 0.375),
            r"out: expected cubic voxels for OctoMap, found 0.4 x 0.4 x 0.375 m",
        ),
        (
            (0.1, 0, 0),
            (0.4, 0.4, 0.4),
            r"out: expected voxels that begin at multiples of 0.4 m for OctoMap, found 0.1, 0, 0",
        ),
    ],
)
def test_octomap_holds_only_cubes_at_multiples_of_their_size(tmp_path, lower, size, message):
    cells = MapCells(
        np.zeros((1, 3), np.int64), np.ones(1, np.uint8), np.array(lower, float), np.array(size)
    )
    with pytest.raises(ArgumentError, match=message):
        cells.write_octomap(tmp_path / "map.bt")
    assert not (tmp_path / "map.bt").exists()


@pytest.mark.slow
def test_octomaps_library_reads_maps_and_grids(drive, tmp_path):
    pyoctomap = pytest.importorskip("pyoctomap", reason="OctoMap's library is not installed")
    (sequence,) = carlasc.open(drive).sequences().values()
    grid = mirror_voxels(sequence.grid(GRID, 3))
    make(drive, tmp_path / "grid.bt", grid=GRID)
    tree = pyoctomap.OcTree(0.1)
    assert tree.readBinary(str(tmp_path / "grid.bt")) and tree.getResolution() == pytest.approx(0.4)
    centers = grid.spec.centers().reshape(-1, 3)
    found = [tree.search(center.tolist()) for center in centers]
    known, occupied = grid.known.reshape(-1), (grid.labels > 0).reshape(-1)
    assert_array_equal([node is not None for node in found], known)
    assert_array_equal(
        [tree.isNodeOccupied(node) for node in found if node is not None], occupied[known]
    )

    make(drive, tmp_path / "map.bt", frames="0:2")
    make(drive, tmp_path / "map.npz", frames="0:2")
    tree = pyoctomap.OcTree(0.1)
    assert tree.readBinary(str(tmp_path / "map.bt"))
    points = np.load(tmp_path / "map.npz")["points"].astype(np.float64)
    assert all(tree.isNodeOccupied(tree.search(point.tolist())) for point in points[:2000])
    leaves = sum(round(leaf.getSize() / 0.1) ** 3 for leaf in tree.begin_leafs())
    assert leaves == len(points)
