"""A run after a change of its inputs gives what a run into an empty folder gives."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from carlasc_recorders import SimulatedCapture
from helpers.datasets.captures import write_capture
from helpers.datasets.tiny_kitti import write_tiny_kitti
from helpers.errors import raises
from helpers.scenes.passing_car import write_sequence

import carlasc
from carlasc import FromGrid, FromScans, GridSpec, Run, Voting, regrid
from carlasc.captures import Lidar
from carlasc.converting import convert, export
from carlasc.converting.stages import Conversion
from carlasc.core import CameraModel
from carlasc.errors import ArgumentError, ConflictError
from carlasc.groundtruth.inputs import InputCheck
from carlasc.motion import PoseOptions
from carlasc.running import Part, open_cluster
from carlasc.storage import layout
from carlasc.storage.camera_files import cameras_to_json

SPEC = GridSpec("cartesian", (32, 32, 8), (-12.8, -12.8, -2.0), (12.8, 12.8, 1.2))
FRAMES = 9
ALONE = Run(workers=1)
FORCED = PoseOptions(force=True)
STILL = FromScans(window=(-2, 2), dynamic="tube", poses=PoseOptions("file", "never"))


def outputs(folder: Path) -> dict[str, bytes]:
    """Return all files below a folder, without records."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and ".carlasc" not in path.parts and "-1-of-1.json" not in path.name
    }


def scans(folder: Path) -> Path:
    return folder / "Val" / "Street" / "cartesian"


def change_points(folder: Path, rng: np.random.Generator) -> None:
    path = scans(folder) / f"velodyne/{rng.integers(FRAMES):06d}.bin"
    points = np.fromfile(path, np.float32).reshape(-1, 4)
    points[:, 2] += np.float32(0.3)
    points.tofile(path)


def change_labels(folder: Path, rng: np.random.Generator) -> None:
    path = scans(folder) / f"labels/{rng.integers(FRAMES):06d}.label"
    labels = np.fromfile(path, np.uint32)
    np.where(labels == 1, np.uint32(2), labels).tofile(path)


def shorten(folder: Path, rng: np.random.Generator) -> None:
    number = rng.integers(FRAMES)
    for field, size in (("velodyne", 16), ("labels", 4), ("predictions", 12)):
        (path,) = (scans(folder) / field).glob(f"{number:06d}.*")
        path.write_bytes(path.read_bytes()[: 500 * size])


def move_pose(folder: Path, rng: np.random.Generator) -> None:
    path = scans(folder) / "poses.txt"
    rows = np.loadtxt(path)
    rows[rng.integers(1, FRAMES), 3] += 0.2
    np.savetxt(path, rows)


def delay(folder: Path, rng: np.random.Generator) -> None:
    path = scans(folder) / "times.txt"
    times = np.loadtxt(path)
    times[rng.integers(1, FRAMES) :] += 0.02
    np.savetxt(path, times)


def remove(folder: Path, rng: np.random.Generator) -> None:
    number = rng.integers(1, FRAMES - 1)
    for field in ("velodyne", "labels", "predictions"):
        (path,) = (scans(folder) / field).glob(f"{number:06d}.*")
        path.unlink()


def grow(folder: Path, rng: np.random.Generator) -> None:
    longer = folder.with_name(f"{folder.name}-longer")
    write_sequence(longer, frames=FRAMES + 3)
    shutil.copytree(scans(longer), scans(folder), dirs_exist_ok=True)
    shutil.rmtree(longer)


CHANGES = [change_points, change_labels, shorten, move_pose, delay, remove, grow]


@pytest.fixture(scope="module")
def drive(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("drive") / "data"
    write_sequence(folder, frames=FRAMES)
    return folder


def copy(source: Path, target: Path) -> Path:
    return Path(shutil.copytree(source, target))


def compare(source: Path, out: Path, fresh: Path, observe, **options) -> tuple:
    """Make grids again after a change, and compare them with those of a run into a new place."""
    again = regrid(source, SPEC, out, observe=observe, run=ALONE, **options)
    assert not again.failures
    unchanged = regrid(source, SPEC, out, observe=observe, run=ALONE, **options)
    assert unchanged.made == 0
    assert not any("again" in note for note in unchanged.notes)
    regrid(fresh, SPEC, fresh, observe=observe, run=ALONE, **options)
    ours = outputs(source if out is None else Path(out))
    assert ours == outputs(fresh)
    return again


@pytest.mark.parametrize(
    ("change", "seed"),
    [
        pytest.param(
            change,
            seed,
            id=f"{change.__name__}-{seed}",
            marks=[] if seed == 0 and change in (change_labels, remove) else pytest.mark.slow,
        )
        for change in CHANGES
        for seed in range(6)
    ],
)
def test_a_changed_input_is_seen_and_what_depends_on_it_made_again(drive, tmp_path, change, seed):
    source = copy(drive, tmp_path / "data")
    regrid(source, SPEC, observe=STILL, run=ALONE)
    change(source, np.random.default_rng(seed))
    fresh = tmp_path / "fresh"
    shutil.copytree(source, fresh, ignore=shutil.ignore_patterns("evaluation*", ".carlasc"))
    again = compare(source, None, fresh, STILL)
    assert 0 < again.made < FRAMES + 3
    assert sum("made again" in note for note in again.notes) == 1


@pytest.mark.slow
@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
@pytest.mark.parametrize("seed", range(3))
def test_tracks_and_refined_poses_are_found_again(drive, tmp_path, change, seed):
    source = copy(drive, tmp_path / "data")
    observe = FromScans(window=(-2, 2), poses=PoseOptions("file", "always"))
    regrid(source, SPEC, observe=observe, run=ALONE)
    change(source, np.random.default_rng(seed))
    fresh = tmp_path / "fresh"
    shutil.copytree(source, fresh, ignore=shutil.ignore_patterns("evaluation*", ".carlasc"))
    compare(source, None, fresh, observe)


@pytest.fixture
def made(drive, tmp_path) -> Path:
    """A drive with grids."""
    source = copy(drive, tmp_path / "data")
    regrid(source, SPEC, observe=STILL, run=ALONE)
    return source


def test_a_copy_with_other_times_is_not_stale(made, tmp_path):
    other = Path(shutil.copytree(made, tmp_path / "other", copy_function=shutil.copyfile))
    again = regrid(other, SPEC, observe=STILL, run=ALONE)
    assert (again.made, again.notes) == (0, regrid(made, SPEC, observe=STILL, run=ALONE).notes)
    assert not any(grid.stale for one in carlasc.info(other).sequences for grid in one.grids)


@pytest.mark.slow
def test_a_report_follows_the_text_files(made, tmp_path):
    fresh = tmp_path / "fresh"
    (scans(made) / "times.txt").unlink()
    shutil.copytree(made, fresh, ignore=shutil.ignore_patterns("evaluation*", ".carlasc"))
    regrid(made, SPEC, observe=STILL, run=ALONE)
    regrid(fresh, SPEC, observe=STILL, run=ALONE)
    assert outputs(made) == outputs(fresh)


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["", ".zarr"])
def test_files_that_the_input_lost_are_removed_from_a_copy(drive, tmp_path, ending):
    source, out = copy(drive, tmp_path / "data"), tmp_path / f"out{ending}"
    camera = CameraModel(
        name="front",
        width=64,
        height=32,
        matrix=np.diag([40.0, 40.0, 1.0]),
        sensor_T_camera=np.eye(4),
    )
    (scans(source) / "cameras.json").write_bytes(cameras_to_json([camera]))
    picture = layout.field_named("bev").file(3)
    (scans(source) / picture).parent.mkdir()
    (scans(source) / picture).write_bytes(b"a picture")
    regrid(source, SPEC, out, observe=STILL, run=ALONE)
    for name in ("times.txt", "cameras.json", picture):
        (scans(source) / name).unlink()
    regrid(source, SPEC, out, observe=STILL, run=ALONE)
    regrid(source, SPEC, tmp_path / "fresh", observe=STILL, run=ALONE)
    if ending:
        carlasc.unpack(out, tmp_path / "unpacked", run=ALONE)
        out = tmp_path / "unpacked"
    assert outputs(out) == outputs(tmp_path / "fresh")


@pytest.mark.slow
def test_content_is_compared_if_asked(made):
    path = scans(made) / "labels/000003.label"
    about = path.stat()
    np.full(about.st_size // 4, 2, np.uint32).tofile(path)
    os.utime(path, ns=(about.st_atime_ns, about.st_mtime_ns))
    options = {"observe": STILL, "run": ALONE}
    assert regrid(made, SPEC, **options).made == 0
    assert regrid(made, SPEC, compare_inputs="content", **options).made == 5


@pytest.mark.slow
def test_nothing_is_compared_if_asked(made):
    change_points(made, np.random.default_rng(0))
    assert regrid(made, SPEC, observe=STILL, compare_inputs="never", run=ALONE).made == 0
    assert regrid(made, SPEC, observe=STILL, run=ALONE).made > 0


@pytest.mark.slow
def test_grids_without_a_record_are_compared_once(made):
    records = scans(made) / ".carlasc"
    shutil.rmtree(records)
    first, second = (regrid(made, SPEC, observe=STILL, run=ALONE) for _ in range(2))
    assert (first.made, second.made) == (0, 0)
    assert ["equal" in note for note in first.notes if "without a record" in note] == [True]
    assert not any("record" in note for note in second.notes)
    shutil.rmtree(records)
    for number in range(FRAMES):
        (scans(made) / f"labels/{number:06d}.label").write_bytes(
            np.full((scans(made) / f"labels/{number:06d}.label").stat().st_size // 4, 2, "<u4")
        )
    assert regrid(made, SPEC, observe=STILL, run=ALONE).made == FRAMES


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["scans", "actors", "capture", "grid"])
def test_validate_records_the_inputs_of_grids_without_a_record(made, tmp_path, kind):
    source, options = made, {"observe": STILL}
    if kind == "capture":
        source, options = tmp_path / "town", {}
        write_capture(source, frames=4)
    elif kind == "grid":
        options = {"observe": FromGrid()}
    elif kind == "actors":
        aligned = FromScans(window=(-2, 2), poses=PoseOptions("file", "never"))
        options = {"observe": aligned, "voting": Voting(keep_actors=True), "name": "with_actors"}
    spec = SPEC.with_size((16, 16, 4)) if kind == "grid" else SPEC
    regrid(source, spec, run=ALONE, **options)
    expected = {path: path.read_bytes() for path in source.rglob(".carlasc/made-*.json")}
    for path in expected:
        path.unlink()
    found = [one.found for one in carlasc.validate(source, record=True).findings]
    assert sum("count as made" in text for text in found) == len(expected)
    again = regrid(source, spec, run=ALONE, **options)
    assert again.made == 0 and not any("record" in note for note in again.notes)
    (record,) = source.rglob(f".carlasc/made-{Path(again.grids[0]).name}.json")
    assert record.read_bytes() == expected[record]
    found = [one.found for one in carlasc.validate(source, record=True).findings]
    assert not any("count as made" in text for text in found)


@pytest.mark.slow
def test_what_changes_after_it_was_recorded_is_made_again(made, tmp_path):
    for path in made.rglob(".carlasc/made-*.json"):
        path.unlink()
    carlasc.validate(made, record=True)
    change_labels(made, np.random.default_rng(1))
    (grid,) = carlasc.info(made).sequences[0].grids
    assert grid.stale.startswith("scan")
    assert regrid(made, SPEC, observe=STILL, run=ALONE).made == FRAMES
    fresh = tmp_path / "fresh"
    shutil.copytree(made, fresh, ignore=shutil.ignore_patterns("evaluation*", ".carlasc"))
    regrid(fresh, SPEC, observe=STILL, run=ALONE)
    assert outputs(made) == outputs(fresh)


def test_only_folders_keep_records(made, tmp_path):
    carlasc.pack(made, tmp_path / "data.zarr", run=ALONE)
    with raises(ArgumentError, where="record", expected="a folder"):
        carlasc.validate(tmp_path / "data.zarr", record=True)


@pytest.mark.slow
@pytest.mark.parametrize("change", [change_points, change_labels, move_pose, remove])
def test_info_and_validate_name_grids_that_are_stale(made, change):
    change(made, np.random.default_rng(0))
    ((grid,),) = [one.grids for one in carlasc.info(made).sequences]
    assert grid.stale.startswith("scan")
    findings = [one for one in carlasc.validate(made).findings if one.check == "inputs"]
    assert [one.found for one in findings] == [grid.stale]
    regrid(made, SPEC, observe=STILL, run=ALONE)
    assert not any(one.stale for one in carlasc.info(made).sequences[0].grids)


@pytest.mark.slow
@pytest.mark.parametrize("kills", [0, 1, 2])
def test_scans_beside_grids_elsewhere_are_replaced(drive, tmp_path, monkeypatch, kills):
    source, out = copy(drive, tmp_path / "data"), tmp_path / "out"
    regrid(source, SPEC, out, observe=STILL, run=ALONE)
    for path in scans(out).glob("evaluation*/*.label") if kills else ():
        path.unlink()  # a killed run had written the scans only
    change_labels(source, np.random.default_rng(0))
    if kills > 1:
        with monkeypatch.context() as killed, pytest.raises(KeyboardInterrupt):
            killed.setattr("carlasc.groundtruth.run.run_all", interrupt)
            regrid(source, SPEC, out, observe=STILL, run=ALONE)
    regrid(source, SPEC, out, observe=STILL, run=ALONE)
    regrid(source, SPEC, tmp_path / "fresh", observe=STILL, run=ALONE)
    assert outputs(out) == outputs(tmp_path / "fresh")


def test_a_coarser_grid_follows_the_finer_one(made, tmp_path):
    coarse, observe = SPEC.with_size((16, 16, 4)), FromGrid()
    regrid(made, coarse, observe=observe, run=ALONE)
    change_labels(made, np.random.default_rng(0))
    assert all(one.stale for one in carlasc.info(made).sequences[0].grids)
    regrid(made, SPEC, observe=STILL, run=ALONE)
    again = regrid(made, coarse, observe=observe, run=ALONE)
    assert 0 < again.made < FRAMES
    fresh = tmp_path / "fresh"
    shutil.copytree(made, fresh, ignore=shutil.ignore_patterns("evaluation_16*", ".carlasc"))
    regrid(fresh, coarse, observe=observe, run=ALONE)
    assert outputs(made) == outputs(fresh)


@pytest.mark.parametrize("sensor", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_changed_recording_of_a_capture(tmp_path, sensor):
    write_capture(tmp_path / "data", frames=4)
    regrid(tmp_path / "data", SPEC, tmp_path / "out", run=ALONE)
    path = tmp_path / f"data/raw/labels{sensor}/102.npy"
    np.save(path, np.full_like(np.load(path), 3))
    again = regrid(tmp_path / "data", SPEC, tmp_path / "out", run=ALONE)
    assert again.made == 1
    regrid(tmp_path / "data", SPEC, tmp_path / "fresh", run=ALONE)
    assert outputs(tmp_path / "out") == outputs(tmp_path / "fresh")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "change"),
    [
        ("file", move_pose),
        ("file", delay),
        *(
            pytest.param("kiss-icp", change, marks=pytest.mark.needs("kiss_icp"))
            for change in (change_points, shorten, delay)
        ),
    ],
)
def test_poses_elsewhere_follow(drive, tmp_path, change, source):
    given, out = copy(drive, tmp_path / "data"), tmp_path / "out"
    observe = FromScans(window=(-2, 2), dynamic="tube", poses=PoseOptions(source, "never"))
    if source == "kiss-icp":
        (scans(given) / "poses.txt").unlink()
    regrid(given, SPEC, out, observe=observe, run=ALONE)
    change(given, np.random.default_rng(0))
    again = regrid(given, SPEC, out, observe=observe, run=ALONE)
    assert again.made and not again.failures
    assert regrid(given, SPEC, out, observe=observe, run=ALONE).made == 0
    regrid(given, SPEC, tmp_path / "fresh", observe=observe, run=ALONE)
    assert outputs(out) == outputs(tmp_path / "fresh")


def test_a_capture_without_its_last_frame(tmp_path):
    write_capture(tmp_path / "data", frames=2)
    regrid(tmp_path / "data", SPEC, tmp_path / "out", run=ALONE)
    for path in (tmp_path / "data/raw").glob("*/101.npy"):
        path.unlink()
    regrid(tmp_path / "data", SPEC, tmp_path / "out", run=ALONE)
    regrid(tmp_path / "data", SPEC, tmp_path / "fresh", run=ALONE)
    assert outputs(tmp_path / "out") == outputs(tmp_path / "fresh")


def interrupt(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def test_frames_that_are_lost_after_a_run_was_killed_at_its_begin(tmp_path, monkeypatch):
    write_capture(tmp_path / "data", frames=2)
    with monkeypatch.context() as killed, pytest.raises(KeyboardInterrupt):
        killed.setattr(InputCheck, "look", interrupt)
        regrid(tmp_path / "data", SPEC, tmp_path / "out", run=ALONE)
    assert len((tmp_path / "out/cartesian/times.txt").read_text().split()) == 2
    for path in (tmp_path / "data/raw").glob("*/101.npy"):
        path.unlink()
    regrid(tmp_path / "data", SPEC, tmp_path / "out", run=ALONE)
    regrid(tmp_path / "data", SPEC, tmp_path / "fresh", run=ALONE)
    assert outputs(tmp_path / "out") == outputs(tmp_path / "fresh")


@pytest.mark.slow
def test_scans_that_are_lost_after_convert_was_killed_at_its_begin(tmp_path, monkeypatch):
    write_tiny_kitti(tmp_path / "kitti", frames=3)
    with monkeypatch.context() as killed, pytest.raises(KeyboardInterrupt):
        killed.setattr(Conversion, "_read_scans", interrupt)
        convert("kitti", tmp_path / "kitti", tmp_path / "out", grids=None, poses=FORCED, run=ALONE)
    (text,) = (tmp_path / "out").rglob("times.txt")
    assert len(text.read_text().split()) == 3
    for path in (tmp_path / "kitti").rglob("000002.*"):
        path.unlink()
    for name in ("out", "fresh"):
        convert("kitti", tmp_path / "kitti", tmp_path / name, grids=None, poses=FORCED, run=ALONE)
    assert outputs(tmp_path / "out") == outputs(tmp_path / "fresh")


@pytest.mark.slow
@pytest.mark.parametrize("frame", [100, 102])
def test_a_changed_pose_of_a_capture(tmp_path, frame):
    write_capture(tmp_path / "data", frames=4)
    regrid(tmp_path / "data", SPEC, tmp_path / "out", run=ALONE)
    path = tmp_path / f"data/raw/pose0/{frame}.npy"
    pose = np.load(path)
    pose[0, 3] += 0.1
    np.save(path, pose)
    assert regrid(tmp_path / "data", SPEC, tmp_path / "out", run=ALONE).made
    regrid(tmp_path / "data", SPEC, tmp_path / "fresh", run=ALONE)
    assert outputs(tmp_path / "out") == outputs(tmp_path / "fresh")


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("ending", ["zarr", "h5", "parquet"])
def test_grids_in_a_folder_of_scans_in_a_store(drive, tmp_path, ending, workers):
    run = Run(workers)
    source, changed = copy(drive, tmp_path / "data"), tmp_path / f"data.{ending}"
    carlasc.pack(source, changed, run=ALONE)
    regrid(changed, SPEC, tmp_path / "out", observe=STILL, run=run)
    assert regrid(changed, SPEC, tmp_path / "out", observe=STILL, run=run).made == 0
    change_points(source, np.random.default_rng(0))
    carlasc.pack(source, changed, overwrite=True, run=ALONE)
    again = regrid(changed, SPEC, tmp_path / "out", observe=STILL, run=run)
    assert 0 < again.made < FRAMES
    regrid(changed, SPEC, tmp_path / "fresh", observe=STILL, run=ALONE)
    assert outputs(tmp_path / "out") == outputs(tmp_path / "fresh")


@pytest.mark.slow
@pytest.mark.parametrize("change", [change_points, remove, grow])
@pytest.mark.parametrize("workers", [1, 2])
def test_grids_in_a_zarr_store(drive, tmp_path, workers, change):
    source, run = copy(drive, tmp_path / "data"), Run(workers)
    regrid(source, SPEC, tmp_path / "out.zarr", observe=STILL, run=run)
    change(source, np.random.default_rng(0))
    again = regrid(source, SPEC, tmp_path / "out.zarr", observe=STILL, run=run)
    assert 0 < again.made < FRAMES
    carlasc.unpack(tmp_path / "out.zarr", tmp_path / "out", run=ALONE)
    regrid(source, SPEC, tmp_path / "fresh", observe=STILL, run=ALONE)
    assert outputs(tmp_path / "out") == outputs(tmp_path / "fresh")


@pytest.mark.slow
def test_parts_make_what_changed_again(drive, tmp_path):
    source, out = copy(drive, tmp_path / "data"), tmp_path / "out"
    parts = [Run(1, part=Part(number, 2)) for number in (1, 2)]
    for part in parts:
        regrid(source, SPEC, out, observe=STILL, run=part)
    change_points(source, np.random.default_rng(0))
    again = [regrid(source, SPEC, out, observe=STILL, run=part) for part in parts]
    assert 0 < sum(one.made for one in again) < FRAMES
    regrid(source, SPEC, tmp_path / "fresh", observe=STILL, run=ALONE)
    assert outputs(out) == outputs(tmp_path / "fresh")


@pytest.mark.slow
@pytest.mark.needs("distributed")
def test_what_changed_is_made_again_on_a_cluster(drive, made, tmp_path):
    """Scans, a capture, a finer grid, an export, and another data set."""
    with open_cluster("local:2") as cluster:
        run = Run(executor=cluster)

        def check(command, change, *out: Path) -> None:
            command(out[0], run)
            change()
            command(out[0], run)
            command(out[1], ALONE)
            assert outputs(out[0]) == outputs(out[1])

        def grids(source, **options):
            return lambda out, run: regrid(source, SPEC, out, run=run, **options)

        def pair(name: str) -> tuple[Path, Path]:
            return tmp_path / name, tmp_path / f"{name}-fresh"

        given = copy(drive, tmp_path / "given")
        rng = np.random.default_rng(0)
        check(grids(given, observe=STILL), lambda: change_points(given, rng), *pair("scans"))
        aligned = FromScans(window=(-2, 2), poses=PoseOptions("file", "always"))
        check(grids(given, observe=aligned), lambda: change_labels(given, rng), *pair("aligned"))

        write_capture(tmp_path / "town", frames=4)
        labels = tmp_path / "town/raw/labels1/102.npy"
        recolour = lambda: np.save(labels, np.full_like(np.load(labels), 3))  # noqa: E731
        check(grids(tmp_path / "town"), recolour, *pair("capture"))

        (grid,) = scans(made).glob("evaluation*/000003.label")
        coarse = SPEC.with_size((16, 16, 4))
        check(
            lambda out, run: regrid(made, coarse, out, observe=FromGrid(), run=run),
            lambda: grid.write_bytes(bytes(grid.stat().st_size)),
            *pair("coarse"),
        )
        check(
            lambda out, run: export("kitti", made, out, run=run),
            lambda: change_points(made, rng),
            *pair("exported"),
        )

        folder = write_tiny_kitti(tmp_path / "kitti", frames=3, points=400)
        path = folder / "labels/000001.label"
        check(
            lambda out, run: convert(
                "kitti", tmp_path / "kitti", out, grids=None, poses=FORCED, run=run
            ),
            lambda: path.write_bytes(np.roll(np.fromfile(path, "<u4"), 7).tobytes()),
            *pair("converted"),
        )


@pytest.mark.slow
def test_scans_in_an_object_store(drive, tmp_path, monkeypatch):
    pytest.importorskip("obstore")
    from helpers.servers.object_store import BUCKET, client_of, environment_for, s3_server

    with s3_server() as url:
        for name, value in environment_for(url).items():
            monkeypatch.setenv(name, value)
        client, source = client_of(url), copy(drive, tmp_path / "data")
        place = f"s3://{BUCKET}/changed"

        def upload() -> None:
            for path in source.rglob("*"):
                if path.is_file():
                    key = f"changed/{path.relative_to(source).as_posix()}"
                    client.put_object(Bucket=BUCKET, Key=key, Body=path.read_bytes())

        upload()
        out = tmp_path / "out"
        regrid(place, SPEC, out, observe=STILL, run=ALONE)
        upload()  # other times, the same content
        assert regrid(place, SPEC, out, observe=STILL, run=ALONE).made == 0
        change_points(source, np.random.default_rng(0))
        upload()
        again = regrid(place, SPEC, out, observe=STILL, run=ALONE)
        assert 0 < again.made < FRAMES
        regrid(place, SPEC, f"s3://{BUCKET}/out", observe=STILL, run=ALONE)
        change_labels(source, np.random.default_rng(1))
        upload()
        assert regrid(place, SPEC, f"s3://{BUCKET}/out", observe=STILL, run=ALONE).made
        assert regrid(place, SPEC, out, observe=STILL, run=ALONE).made
        regrid(source, SPEC, tmp_path / "fresh", observe=STILL, run=ALONE)
        carlasc.unpack(f"s3://{BUCKET}/out", tmp_path / "unpacked", run=ALONE)
        assert outputs(out) == outputs(tmp_path / "fresh") == outputs(tmp_path / "unpacked")
        copied = f"s3://{BUCKET}/copied"
        carlasc.unpack(source, copied, run=ALONE)
        assert not carlasc.unpack(source, copied, run=ALONE).files
        change_points(source, np.random.default_rng(2))
        with raises(ConflictError, found="files that changed"):
            carlasc.unpack(source, copied, run=ALONE)


@pytest.mark.slow
def test_a_simulation_with_other_settings(tmp_path):
    pytest.importorskip("embreex")
    for points in (800, 1600):
        town = SimulatedCapture(
            count=1, sensors=1, lidar=Lidar(channels=8, points=points), bev=False
        )
        made = regrid(town, SPEC, tmp_path / "out", run=ALONE)
        assert made.made == 1
        assert regrid(town, SPEC, tmp_path / "out", run=ALONE).made == 0
    regrid(town, SPEC, tmp_path / "fresh", run=ALONE)
    assert outputs(tmp_path / "out") == outputs(tmp_path / "fresh")


@pytest.mark.slow
def test_validate_makes_a_sample_of_frames_again(made):
    def found() -> str:
        result = carlasc.validate(made, sample=2)
        (finding,) = [one for one in result.findings if "seed" in one.found]
        return f"{finding.severity}: {finding.found}"

    assert found() == "note: 0 of 2 frames that differ (seed 0)"
    for path in (scans(made) / "evaluation_32x32x8").glob("*.label"):
        path.write_bytes(bytes(path.stat().st_size))
    assert found().startswith("warning: 2 of 2 frames")


@pytest.mark.parametrize("name", ["frames", "own", "whole"])
def test_a_damaged_record_does_not_stop_a_run(drive, tmp_path, name):
    regrid(drive, SPEC, tmp_path / "out", observe=STILL, run=ALONE, frames="0:2")
    before = outputs(tmp_path / "out")
    (record,) = (tmp_path / "out").rglob(".carlasc/made-*.json")
    told = json.loads(record.read_text())
    told |= {"whole": "other", name: "odd" if name == "whole" else {"odd": 1}}
    record.write_text(json.dumps(told))
    again = regrid(drive, SPEC, tmp_path / "out", observe=STILL, run=ALONE, frames="0:2")
    assert not again.failures
    assert outputs(tmp_path / "out") == before
