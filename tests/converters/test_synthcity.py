import os
import pickle
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from carlasc_converters.synthcity import CLASSES, SynthCity, SynthCityArea

import carlasc
from carlasc.converting import LayoutOptions, convert
from carlasc.core.geometry import relative_to, transform_points
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA
from carlasc.errors import ArgumentError, CarlascError, FormatError, MissingDataError
from carlasc.running import Run
from carlasc.testing.drives import SimulatedDrive

pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")
from converters.formats.synthcity import CORNER, LABELS, area_points, write_area  # noqa: E402

DRIVE = SimulatedDrive(frames=4, speed=60.0, channels=10, columns=90)


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_area(tmp_path_factory.mktemp("city") / "area_3.parquet", DRIVE)


def recording(path: Path, **options: str) -> SynthCityArea:
    found = SynthCity(path, **options).sequences()[0]
    assert isinstance(found, SynthCityArea)
    return found


def test_every_point_is_in_one_tile_in_the_order_of_the_table(table: Path) -> None:
    area, (truth, labels) = recording(table), area_points(DRIVE)
    assert len(area.frames) > 4
    assert [frame.number for frame in area.frames] == list(range(len(area.frames)))
    done = 0
    for frame, pose in zip(area.frames, area.poses().world_T_vehicle, strict=True):
        (cloud,) = pickle.loads(pickle.dumps(frame)).read()
        inside = (np.abs(truth[:, :2] - pose[:2, 3]) < np.float32(25.6)).all(axis=1)
        np.testing.assert_allclose(
            transform_points(pose, cloud.points[:, :3]), truth[inside], atol=2e-6
        )
        np.testing.assert_array_equal(cloud.labels, labels[inside] + 1)
        assert cloud.points.dtype == np.float32
        done += len(cloud.points)
    assert done == len(truth)


def test_tiles_lie_on_a_lattice_above_their_ground(table: Path) -> None:
    places = recording(table).poses().world_T_vehicle[:, :3, 3]
    step = 2 * float(np.float32(25.6))
    np.testing.assert_allclose(places[:, :2] / step % 1, 0.5, atol=1e-9)
    # also of the tiles without ground points
    np.testing.assert_allclose(places[:, 2], CORNER[2] + 1.8, atol=1e-6)
    assert recording(table).sensors[0].height_m == pytest.approx(1.8)


@pytest.mark.parametrize("grid", ["coarse", "fine"])
def test_voxels_have_the_class_of_most_of_their_points_and_nothing_is_free(
    table: Path, grid: str
) -> None:
    area = recording(table, grid=grid)
    spec = GridSpec.published(grid)
    assert area.voxels == spec
    assert not area.rays
    frame = max(area.frames, key=lambda frame: len(frame.read()[0].points))
    (cloud,) = frame.read()
    content = frame.read_voxels()
    assert content is not None
    assert cloud.labels is not None
    votes: dict[int, Counter[int]] = {}
    for cell, label in zip(
        spec.flat_index(cloud.points[:, :3]).tolist(), cloud.labels.tolist(), strict=True
    ):
        if cell >= 0:
            votes.setdefault(cell, Counter())[label] += 1
    assert len(votes) > 100
    np.testing.assert_array_equal(np.flatnonzero(content.known), sorted(votes))
    for cell, counts in votes.items():
        most = max(counts.values())
        assert content.labels.flat[cell] == min(
            label for label, count in counts.items() if count == most
        )
    assert (content.labels[content.known] > 0).all()
    assert (content.labels[~content.known] == 0).all()


def test_classes_map_to_those_of_carlasc() -> None:
    names = {0: "Free", 1: "Building", 2: "Vehicle", 6: "Road", 8: "Vegetation", 9: "Sidewalk"}
    assert set(SynthCity.to_carla.mapping) == set(CLASSES.names) == set(range(10))
    for index, name in names.items():
        assert CARLA.names[SynthCity.to_carla.mapping[index]] == name
    assert CLASSES.names[LABELS["pole"] + 1] == "pole-like"
    assert all(SynthCity.to_carla.mapping[index] in CARLA.ground for index in CLASSES.ground)


@pytest.mark.parametrize("rows", [64, 10**6])
def test_the_size_of_row_groups_makes_no_difference(table: Path, tmp_path: Path, rows: int) -> None:
    other = recording(write_area(tmp_path / "area_3.parquet", DRIVE, rows=rows))
    area = recording(table)
    for frame, same in zip(area.frames, other.frames, strict=True):
        np.testing.assert_array_equal(frame.read()[0].points, same.read()[0].points)


@pytest.mark.parametrize(
    "names",
    [
        {"x": "X", "y": " Y ", "z": "Z", "label": "Class"},
        {"x": "pos_x", "y": "Pos_Y", "z": "posZ", "label": "label_id"},
    ],
)
def test_columns_are_found_by_usual_names(
    table: Path, tmp_path: Path, names: dict[str, str]
) -> None:
    other = recording(write_area(tmp_path / "area_3.parquet", DRIVE, names=names))
    np.testing.assert_array_equal(
        other.frames[1].read()[0].points, recording(table).frames[1].read()[0].points
    )


def test_an_option_names_columns(table: Path) -> None:
    noisy = recording(table, columns="x=x_noise, y=y_noise,z=z_noise")
    difference = (
        noisy.poses().world_T_vehicle[0, 2, 3] - recording(table).poses().world_T_vehicle[0, 2, 3]
    )
    assert difference == pytest.approx(0.005, abs=1e-6)
    assert recording(table, columns="label=label").columns["label"] == "label"


@pytest.mark.parametrize("text", ["x", "x=", "x=a,x=b", "w=a", ""])
def test_an_option_that_names_nothing_is_refused(table: Path, text: str) -> None:
    with pytest.raises(
        ArgumentError, match="columns: expected x=NAME,y=NAME,z=NAME,label=NAME, or some of these"
    ):
        recording(table, columns=text)


def test_the_temporary_folder_goes_with_the_frames(table: Path) -> None:
    frames = SynthCity(table).sequences()[0].frames  # the recording itself is gone
    folder = Path(frames[0].rows).parent  # type: ignore[attr-defined]
    copy = pickle.loads(pickle.dumps(frames[0]))
    assert len(frames[0].read()[0].points)
    del copy
    assert folder.is_dir()
    del frames
    assert not folder.exists()


@pytest.mark.slow
def test_the_temporary_folder_is_deleted_when_the_process_ends_early(
    table: Path, tmp_path: Path
) -> None:
    code = (
        "import sys; from pathlib import Path; from carlasc_converters.synthcity import SynthCity\n"
    )
    code += "frames = SynthCity(Path(sys.argv[1])).sequences()[0].frames; print(len(frames)); raise KeyboardInterrupt"
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", code, str(table)],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    assert int(done.stdout) > 4
    assert not list(tmp_path.iterdir())


def test_areas_are_found_below_the_folder(table: Path, tmp_path: Path) -> None:
    for area in ("area1", "area_2"):
        (tmp_path / area).mkdir()
        (tmp_path / area / f"{area}.parquet").write_bytes(table.read_bytes())
    assert [area.name for area in SynthCity(tmp_path).sequences()] == [
        "SYNTHCITY_area1",
        "SYNTHCITY_area-2",
    ]
    with pytest.raises(MissingDataError, match="Parquet tables, one per area"):
        SynthCity(tmp_path / "none").sequences()
    with pytest.raises(
        ArgumentError, match="grid: expected one of coarse, fine, found 'cylindrical'"
    ):
        convert(
            "synthcity", tmp_path, tmp_path / "out", options={"grid": "cylindrical"}, run=Run(1)
        )


def test_notes_say_that_nothing_is_free(table: Path) -> None:
    notes = recording(table).notes()
    assert any("static cloud without trajectory" in note for note in notes)
    assert any("only voxels with points are known" in note for note in notes)


def test_a_conversion_writes_tiles_and_their_voxels(table: Path, tmp_path: Path) -> None:
    result = convert(
        "synthcity",
        table.parent,
        tmp_path,
        layout=LayoutOptions(axes="right", classes="synthcity"),
        grids="voxels",
        run=Run(workers=1),
    )
    assert result.failures == ()
    (sequence,) = carlasc.open(tmp_path).sequences().values()
    area = recording(table)
    world = area.poses().world_T_vehicle
    np.testing.assert_allclose(sequence.poses, relative_to(world[0], world), atol=1e-9)
    for frame in area.frames:
        (cloud,) = frame.read()
        content = frame.read_voxels()
        assert content is not None
        np.testing.assert_array_equal(sequence.read("points", frame.number), cloud.points)
        np.testing.assert_array_equal(sequence.read("labels", frame.number), cloud.labels)
        grid = sequence.grid("evaluation", frame.number)
        np.testing.assert_array_equal(grid.known, content.known)
        np.testing.assert_array_equal(grid.labels, content.labels)
    assert not {"flow", "instances"} & sequence.fields()
    assert not any("KISS-ICP" in note for note in result.notes)


def test_a_conversion_in_other_processes_finds_the_tiles(table: Path, tmp_path: Path) -> None:
    result = convert("synthcity", table, tmp_path, grids=None, run=Run(workers=2))
    assert result.failures == ()
    assert result.made == len(recording(table).frames)


def test_grids_from_scans_are_refused_because_nothing_is_known_to_be_free(
    table: Path, tmp_path: Path
) -> None:
    with pytest.raises(
        ArgumentError, match="grids: expected voxels or none, found scans for .*area_3.parquet"
    ):
        convert("synthcity", table, tmp_path / "out", run=Run(workers=1))
    assert not (tmp_path / "out").exists()


COLUMNS = {name: np.zeros(4) for name in ("x", "y", "z")} | {"label": np.zeros(4, np.int64)}


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (
            COLUMNS | {"label": np.array([0, 1, 9, 9])},
            "expected labels 0 to 8 in the column label, found 9 in row 2",
        ),
        (COLUMNS | {"label": np.array([0, -1, 0, 0])}, "found -1 in row 1"),
        (COLUMNS | {"label": np.array([0, 0.5, 0, 0])}, "found 0.5 in row 1"),
        (COLUMNS | {"label": ["road"] * 4}, "expected numbers in the column label, found string"),
        (COLUMNS | {"label": [1, None, 2, 3]}, "found nan in row 1"),
        (
            COLUMNS | {"y": np.array([0, 0, 0, np.nan])},
            "expected finite coordinates, found others in row 3",
        ),
        (
            {"x": np.zeros(4), "y": np.zeros(4)},
            "expected one column z, found x, y: name the columns with the option",
        ),
        (COLUMNS | {"Class": np.zeros(4)}, "expected one column label, found label, Class"),
        ({name: column[:0] for name, column in COLUMNS.items()}, "expected points, found none"),
    ],
)
def test_a_wrong_table_is_named_in_one_line(
    tmp_path: Path, columns: dict[str, np.ndarray], message: str
) -> None:
    path = tmp_path / "area1.parquet"
    pq.write_table(pa.table(columns), path)
    with pytest.raises(CarlascError) as error:
        _ = recording(path).frames
    assert isinstance(error.value, FormatError)
    assert str(error.value).startswith(str(path))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("spoil", ["cut", "pages", "text"])
def test_a_damaged_table_is_named_in_one_line(table: Path, tmp_path: Path, spoil: str) -> None:
    data, path = bytearray(table.read_bytes()), tmp_path / "area1.parquet"
    if spoil == "pages":
        data[4:4000] = bytes(3996)
    path.write_bytes({"cut": data[:-500], "pages": data, "text": b"x y z\n1 2 3\n"}[spoil])
    with pytest.raises(FormatError, match="expected a Parquet table") as error:
        _ = recording(path).frames
    assert "\n" not in str(error.value)


MEASURE = """
import sys, time
from pathlib import Path
from carlasc_converters.synthcity import SynthCity
start = time.perf_counter()
area = SynthCity(Path(sys.argv[1])).sequences()[0]
frames, _ = area.frames, area.poses()
cut = time.perf_counter() - start
points = sum(len(frame.read()[0].points) for frame in frames)
voxels = sum(int(frame.read_voxels().known.sum()) for frame in frames)
peak = int(Path("/proc/self/status").read_text().partition("VmHWM:")[2].split()[0])
print(len(frames), points, peak // 1024, round(cut, 1), round(time.perf_counter() - start - cut, 1), voxels)
"""


def write_large(path: Path, millions: int) -> None:
    """Write a table of random points of a square kilometre in a single row group."""
    rng = np.random.default_rng(0)
    schema = pa.schema([(name, pa.float64()) for name in "xyz"] + [("label", pa.int64())])
    with pq.ParquetWriter(path, schema) as writer:
        x, y, z = rng.uniform(0, 1000, (3, millions * 10**6))
        label = rng.integers(0, 9, len(x))
        writer.write_table(
            pa.table({"x": x, "y": y, "z": z / 100, "label": label}), row_group_size=len(x)
        )


@pytest.mark.slow
@pytest.mark.skipif(
    not Path("/proc/self/status").exists(), reason="reads the peak memory of a process from Linux"
)
def test_a_large_area_is_cut_in_little_memory(tmp_path: Path) -> None:
    path = tmp_path / "area1.parquet"
    write_large(path, 8)
    done = subprocess.run(
        [sys.executable, "-c", MEASURE, str(path)], capture_output=True, text=True, check=True
    )
    frames, points, peak_mib = map(int, done.stdout.split()[:3])
    assert (frames, points) == (400, 8_000_000)
    assert peak_mib < 350  # most of it is Python with NumPy, numba and pyarrow
