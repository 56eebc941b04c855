"""An audit finds nothing wrong with sound ground truth, and names what was planted with its size."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from carlasc_recorders import SimulatedCapture, TownDrive
from helpers.datasets import planted
from typer.testing import CliRunner

import carlasc
from carlasc import GridSpec, Run
from carlasc.captures import Lidar
from carlasc.cli import app
from carlasc.core.geometry import invert, rotation_z
from carlasc.errors import ArgumentError, MissingDataError
from carlasc.groundtruth import FromScans, Observation, count_votes
from carlasc.inspection import write_audit_page
from carlasc.motion import MotionOptions, PoseOptions
from carlasc.running import Part
from carlasc.storage import layout

FRAMES, SPEC = 16, GridSpec.published()
LIDAR = Lidar(channels=24, points=12_000, range_m=40.0)
X, Y, Z = SPEC.voxel_size


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """A sound drive, with grids of all of its sensors."""
    folder = tmp_path_factory.mktemp("audited") / "town"
    capture = SimulatedCapture(
        count=FRAMES, first_frame=20, sensors=5, seed=1, traffic="light", lidar=LIDAR, bev=False
    )
    carlasc.regrid(capture, SPEC, folder, run=Run(workers=1))
    return folder


def faults(grids, scans, **options):
    """Return the faults of an audit by the name of the check."""
    return {verdict.check: verdict for verdict in carlasc.audit(grids, scans, **options).faults}


def test_sound_grids_have_no_fault(town):
    result = carlasc.audit(town, town)
    assert result.faults == ()
    assert result.ok
    assert result.frames == {"cartesian": FRAMES}
    states = {verdict.check: verdict.state for verdict in result.verdicts["cartesian"]}
    assert {
        states[name] for name in ("fit", "axes", "shift x", "shift y", "yaw", "voxel size", "lag")
    } == {"sound"}
    (depth,) = [one for one in result.verdicts["cartesian"] if one.check == "depth error"]
    assert depth.unit == "m"
    assert 0.2 < depth.low < depth.value < depth.high < 1.5  # rays graze the ground far away


MOVED = {
    "half x": ((X / 2, 0, 0), {"shift x": X / 2}),
    "one y": ((0, -Y, 0), {"shift y": -Y}),
    "half z": ((0, 0, Z / 2), {"shift z": Z / 2}),
    "half x and y": ((X / 2, -Y / 2, 0), {"shift x": X / 2, "shift y": -Y / 2}),
}


QUICK = ("half x", "mirrored", "classes", "elsewhere")


def some(names):
    """Return the names of faults as parameters: all but a few are slow."""
    return [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in names]


@pytest.mark.slow
@pytest.mark.parametrize("name", some(MOVED))
def test_a_shift_is_named_with_its_size(town, tmp_path, name):
    offset, wanted = MOVED[name]
    found = faults(planted.write_grids(town, tmp_path, spec=planted.moved(SPEC, offset)), town)
    assert {check: verdict.value for check, verdict in found.items()} == pytest.approx(
        wanted, abs=0.11 * X
    )
    for check, size in wanted.items():
        assert found[check].low - 1e-6 <= size <= found[check].high + 1e-6


def elsewhere(_sequence, _frame, labels, counts):
    """Return what no shift that is tried explains, as grids of another sequence."""
    return np.roll(labels, (40, 25), axis=(0, 1)), counts


WRONG = {
    "elsewhere": (
        {"change": elsewhere},
        "fit",
        "check that scans and grids are of the same sequence and in a known coordinate frame; "
        "tried: /",
    ),
    "mirrored": ({"change": planted.mirrored}, "axes", "y mirrored"),
    "axes": (
        {"change": planted.swapped_axes},
        "axes",
        "x, y, z of the grid are y, x, z of the scans",
    ),
    "late": ({"late": 1}, "lag", "1 frame (0.10 s) late"),
    "classes": ({"change": planted.exchanged(1, 10)}, "classes exchanged", "Building and Vehicle"),
    "voxels": ({"spec": planted.larger(SPEC, 1.25)}, "voxel size", "1.250 times"),
    "absent": (
        {"absent": (3, 10, 11)},
        "missing frames",
        "3 of 16 frames have no grid (18.8%): 3, 10, 11",
    ),
}


@pytest.mark.parametrize("name", some(WRONG))
def test_a_planted_fault_is_named(town, tmp_path, name):
    options, check, text = WRONG[name]
    found = faults(planted.write_grids(town, tmp_path, **options), town)
    assert set(found) - {"labels"} == {check}
    assert text in str(found[check])


@pytest.mark.parametrize(
    ("fault", "check"),
    [
        (planted.erased, "erased actors"),
        pytest.param(planted.trail, "ghost trails", marks=pytest.mark.slow),
    ],
)
def test_the_actor_of_a_fault_is_named(town, tmp_path, fault, check):
    actor = planted.fastest(planted.sequence_of(town))
    found = faults(planted.write_grids(town, tmp_path, fault(actor)), town)
    assert set(found) == {check}
    assert f"actor {actor} " in str(found[check])


@pytest.mark.slow
def test_an_actor_in_unknown_space_is_not_erased(town, tmp_path):
    actor = planted.fastest(planted.sequence_of(town))

    def unknown(sequence, frame, labels, counts):
        voxels = planted.voxels_of(sequence, frame, frame, actor)
        counts.reshape(-1)[voxels] = 0
        return planted.erased(actor)(sequence, frame, labels, counts)

    assert "erased actors" not in faults(planted.write_grids(town, tmp_path, unknown), town)


SOURCES = {  # what shows motion -> how the recording is copied
    "flow": lambda town, out: planted.without_fields(town, out, "instances"),
    "boxes": planted.with_boxes,
    "evidence": lambda town, out: planted.without_fields(town, out, "instances", "flow"),
    "evidence without labels": lambda town, out: planted.without_fields(
        town, out, "instances", "flow", "labels"
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SOURCES)
def test_an_actor_without_voxels_and_its_trail_are_found_by_whatever_shows_motion(
    town, tmp_path, name
):
    scans, actor = (
        SOURCES[name](town, tmp_path / "scans"),
        planted.fastest(planted.sequence_of(town)),
    )
    named = {"boxes": f"actor {actor} "}.get(name, "actor of track 0, first seen in scan ")
    assert planted.sequence_of(scans).fields() & {"instances", "flow", "boxes"} == {name} & {
        "flow",
        "boxes",
    }
    for fault, check in (
        (None, None),
        (planted.erased, "erased actors"),
        (planted.trail, "ghost trails"),
    ):
        out = tmp_path / f"{check}"
        found = faults(
            planted.write_grids(town, out, None if fault is None else fault(actor)), scans
        )
        assert set(found) == {check} - {None}
        assert all(named in str(verdict) for verdict in found.values())


@pytest.mark.slow
def test_a_turn_of_a_degree_is_named(town, tmp_path):
    drive, turned = TownDrive(1, "light", LIDAR), rotation_z(np.radians(1.0))
    grids = {}
    for frame in range(0, FRAMES, 3):
        recordings = [drive.record(20 + frame, sensor) for sensor in range(5)]
        grid_T_world = turned @ invert(recordings[0].world_T_sensor)
        seen = [
            Observation(r.scan.points, r.scan.labels, grid_T_world @ r.world_T_sensor)
            for r in recordings
        ]
        grids[frame] = count_votes(seen, SPEC).to_grid()

    def change(_sequence, frame, _labels, _counts):
        return grids[frame].labels, grids[frame].counts

    absent = tuple(frame for frame in range(FRAMES) if frame not in grids)
    found = faults(planted.write_grids(town, tmp_path, change, absent=absent), town)
    assert set(found) == {"yaw"}
    assert found["yaw"].value == pytest.approx(1.0, abs=0.26)


@pytest.mark.slow
def test_a_part_counts_and_the_last_part_judges(town, tmp_path):
    whole = carlasc.audit(town, town)
    first = carlasc.audit(town, town, keep=tmp_path, run=Run(workers=1, part=Part(1, 2)))
    assert first.verdicts == {}
    last = carlasc.audit(town, town, keep=tmp_path, run=Run(workers=1, part=Part(2, 2)))
    assert last.verdicts == whole.verdicts
    kept = sorted(tmp_path.rglob("audit-*"))
    assert len(kept) == FRAMES
    times = [file.stat().st_mtime_ns for file in kept]
    again = carlasc.audit(town, town, keep=tmp_path)
    assert again.verdicts == whole.verdicts
    assert [file.stat().st_mtime_ns for file in kept] == times
    kept[0].write_bytes(b"PK damaged")
    assert carlasc.audit(town, town, keep=tmp_path).verdicts == whole.verdicts
    with pytest.raises(ArgumentError) as caught:
        carlasc.audit(town, town, run=Run(workers=1, part=Part(1, 2)))
    assert caught.value.where == "part" and "keep" in caught.value.expected


@pytest.mark.slow
def test_a_frame_that_cannot_be_read_is_reported_and_the_rest_is_judged(town, tmp_path):
    grids, scans = planted.write_grids(town, tmp_path / "grids"), tmp_path / "scans"
    shutil.copytree(town, scans)
    next(grids.rglob("000005.label")).write_bytes(b"short")
    next(scans.rglob("velodyne/000007.bin")).write_bytes(b"short")
    result = carlasc.audit(grids, scans)
    assert [failure.frame for failure in result.failures] == ["5", "7"]
    assert not result.ok
    assert result.faults == ()


def test_grids_without_scans_of_theirs_are_refused(town, tmp_path):
    far = planted.write_grids(town, tmp_path / "far")
    for file in sorted(far.rglob("0000*.*"), reverse=True):
        file.rename(file.with_name(f"{int(file.stem) + 500:06d}{file.suffix}"))
    with pytest.raises(MissingDataError) as caught:
        carlasc.audit(far, town)
    assert (caught.value.expected, caught.value.found) == ("grids of frames 0 to 15", "500 to 515")
    with pytest.raises(MissingDataError) as caught:
        carlasc.audit(far, town)
    assert "far/cartesian/evaluation with" in caught.value.where
    names = tmp_path / "named"
    shutil.copytree(town / "cartesian", names / "Val" / "one" / "cartesian")
    shutil.copytree(town / "cartesian", names / "Val" / "two" / "cartesian")
    with pytest.raises(MissingDataError) as caught:
        carlasc.audit(town, names)
    assert "cartesian with Val/one" in caught.value.found


@pytest.mark.slow
def test_the_command_prints_writes_a_page_and_tells_by_its_exit_code(town, tmp_path):
    runner, page = CliRunner(), tmp_path / "audit.html"
    sound = runner.invoke(app, ["audit", str(town), str(town), "--made-from=-2:2", "--json"])
    assert sound.exit_code == 0
    assert json.loads(sound.stdout)["ok"]
    assert "false free, held out" in [
        v["check"] for v in json.loads(sound.stdout)["verdicts"]["cartesian"]
    ]
    wrong = planted.write_grids(town, tmp_path / "wrong", planted.mirrored)
    result = runner.invoke(app, ["audit", str(wrong), str(town), "--html", str(page)])
    assert result.exit_code == 1
    assert "y mirrored" in result.stdout
    text = page.read_text()
    assert text.count("<img") == 4
    assert "y mirrored" in text
    assert "http" not in text.replace("http-equiv", "")


@pytest.mark.slow
def test_one_sensor_loses_thin_things_and_the_finding_says_so(tmp_path):
    dense = Lidar(channels=48, points=40_000)
    capture = SimulatedCapture(
        count=8, first_frame=20, sensors=1, seed=1, traffic="light", lidar=dense, bev=False
    )
    carlasc.regrid(capture, SPEC, tmp_path, run=Run(workers=1))
    found = faults(tmp_path, tmp_path)
    assert set(found) == {"false free"}
    assert "are in voxels called free: " in found["false free"].text
    assert "% of Pole" in found["false free"].text
    assert "outvote their returns" in found["false free"].advice
    assert "Pole " in found["false free"].details


def test_names_of_data_are_text_on_the_page(town, tmp_path):
    result = replace(carlasc.audit(town, town), grids="<b>x</b>", notes=("<script>",), worst=())
    write_audit_page(result, tmp_path / "page.html")
    assert "<b>x</b>" not in (tmp_path / "page.html").read_text()
    assert "<script>" not in (tmp_path / "page.html").read_text()


KITTI = GridSpec("cartesian", (256, 256, 32), (0.0, -25.6, -2.0), (51.2, 25.6, 4.4))
# exporter -> geometry in the frame of the scans, options, axis and size of a shift of one row along
# x of the layout
FORMATS = {
    "kitti": (KITTI, {}, "shift x", 0.2),
    "sscbench": (KITTI, {"every": 1}, "shift x", 0.2),
    "occ3d": (
        GridSpec("cartesian", (200, 200, 16), (-40.0, -40.0, -2.8), (40.0, 40.0, 3.6)),
        {},
        "shift x",
        0.4,
    ),
    "openoccupancy": (
        GridSpec("cartesian", (512, 512, 40), (-51.2, -51.2, -5.0), (51.2, 51.2, 3.0)),
        {},
        "shift y",
        0.2,
    ),
    "carlaocc": (
        GridSpec("cartesian", (128, 128, 16), (-25.6, -25.6, -2.4), (25.6, 25.6, 4.0)),
        {},
        "shift x",
        0.4,
    ),
}


def test_grids_of_another_length_are_named_with_their_scans(town, tmp_path):
    for token in ("a", "b", "c"):
        (tmp_path / "gts" / "scene" / token).mkdir(parents=True)
        np.savez(
            tmp_path / "gts" / "scene" / token / "labels.npz",
            semantics=np.full((200, 200, 16), 17, np.uint8),
        )
    with pytest.raises(MissingDataError) as caught:
        carlasc.audit(tmp_path / "gts", town)
    assert "3 tokens" in caught.value.expected and caught.value.found.startswith("16 scans")
    grids = planted.write_grids(town, tmp_path / "longer")
    for file in grids.rglob("000015.*"):
        shutil.copy(file, file.with_name(f"000099{file.suffix}"))
    result = carlasc.audit(grids, town, frames=(8, 100))
    assert result.frames == {"cartesian": 8}
    assert (
        "cartesian: 1 of 17 grids left out, without a scan of the same number or time: 99"
        in result.notes
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_files_of_other_benchmarks_are_sound_or_faults_are_named(town, tmp_path, name):
    spec, options, check, size = FORMATS[name]
    run, observe = Run(workers=1), FromScans(window=(-3, 3))
    carlasc.regrid(
        town, spec, tmp_path / "made", observe=observe, frames=(4, 9), name="evaluation", run=run
    )

    def row_too_far(_sequence, _frame, labels, counts):
        return np.roll(labels, 1, axis=0), np.roll(counts, 1, axis=0)

    wrong = {
        "sound": (None, ()),
        "shifted": (row_too_far, ()),
        "exchanged": (planted.exchanged(1, 10), (6,)),
    }
    for fault, (change, absent) in wrong.items():
        out = tmp_path / fault
        grids = planted.write_grids(
            tmp_path / "made", tmp_path / f"{fault}-grids", change, absent=absent
        )
        if name == "carlaocc":
            planted.write_carlaocc(grids, out)
        else:
            carlasc.export(name, grids, out, options=options, run=run)
        if name == "openoccupancy":
            tokens = sorted(file.stem for file in out.rglob("*.npy"))
            (out / "tokens.txt").write_text(
                "".join(f"{token} {0.1 * int(token[-6:]):.1f}\n" for token in tokens)
            )
        result = carlasc.audit(out, town)
        assert list(result.frames.values()) == [5 - len(absent)]
        found = {verdict.check: verdict for verdict in result.faults}
        if fault == "exchanged":
            assert (
                {"classes exchanged", "missing frames"}
                <= set(found)
                <= {"classes exchanged", "missing frames", "labels"}
            )
            assert found["missing frames"].value == pytest.approx(1 / 5)
        else:
            sizes = {verdict.check: verdict.value for verdict in result.faults}
            assert sizes == pytest.approx({check: size} if change else {}, abs=0.02)


@pytest.mark.slow
def test_scans_without_poses_tell_less_and_say_so(town, tmp_path):
    shutil.copytree(town, tmp_path / "town")
    next((tmp_path / "town").rglob("poses.txt")).unlink()
    result = carlasc.audit(tmp_path / "town", tmp_path / "town")
    assert result.ok
    assert [note for note in result.notes if "town/cartesian: the scans have no poses.txt" in note]
    states = {verdict.check: verdict.state for verdict in result.verdicts["cartesian"]}
    assert states["height drift"] == states["ghost trails"] == "undetermined"


@pytest.mark.slow
def test_a_drift_of_five_centimetres_a_second_is_named(tmp_path):
    scans, drifting, spec = tmp_path / "town", tmp_path / "drifting", GridSpec.published("fine")
    capture = SimulatedCapture(
        count=51, first_frame=20, sensors=1, seed=6, traffic="light", lidar=LIDAR, bev=False
    )
    carlasc.regrid(capture, SPEC, scans, run=Run(workers=1))
    shutil.copytree(scans, drifting, ignore=shutil.ignore_patterns("evaluation"))
    poses = planted.sequence_of(scans).poses.copy()
    poses[:, 2, 3] += 0.05 * 0.1 * np.arange(len(poses))
    next(drifting.rglob("poses.txt")).write_bytes(layout.encode_poses(poses))
    observe = FromScans((-25, 25), motion=MotionOptions("flow"), poses=PoseOptions("file", "never"))
    for folder, wanted in ((drifting, {"height drift": 0.05}), (scans, {})):
        made = tmp_path / f"{folder.name}-grids"
        carlasc.regrid(
            folder,
            spec,
            made,
            observe=observe,
            frames=(20, 31),
            name="evaluation",
            run=Run(workers=1),
        )
        found = faults(made, scans)
        assert {check: verdict.value for check, verdict in found.items()} == pytest.approx(
            wanted, abs=0.011
        )
    carlasc.regrid(
        drifting, spec, observe=observe, frames=(20, 31), name="evaluation", run=Run(workers=1)
    )
    result = carlasc.audit(drifting, drifting)  # the same poses: not a fault of the grids
    (drift,) = (one for one in result.verdicts["cartesian"] if one.check == "height drift")
    assert drift.state == "sound"
