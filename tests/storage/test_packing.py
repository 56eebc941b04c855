from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets.sequences import files_of, grid, params, write_dataset
from helpers.errors import raises
from helpers.processes.peak import PRINT_PEAK
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from storage.transport.test_zipped import write_zip
from typer.testing import CliRunner

import carlasc
from carlasc import Run
from carlasc.cli import app
from carlasc.errors import ArgumentError, CarlascError, ConflictError, FormatError
from carlasc.running import Part
from carlasc.storage import FolderSink, FolderSource, pack, unpack
from carlasc.storage.packed.stores import PackOptions
from carlasc.storage.zarr.zarr_sink import ZarrSink

for package in ("zarr", "h5py", "hdf5plugin", "pyarrow"):
    pytest.importorskip(package)

KINDS = ("zarr", "h5", "parquet")
PATH = "Train/Town01_Light/cartesian"
SIZE = (3, 5, 2)


def round_trip(source: Path, out: Path, **options: Any) -> dict[str, bytes]:
    pack(source, out, **options)
    unpack(out, out.with_suffix(".files"))
    return files_of(out.with_suffix(".files"))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("published") / "data")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "part", ["cartesian", "cylindrical", "cartesian_fine", "cartesian_step0.5"]
)
def test_the_golden_files_come_back_byte_for_byte(
    golden_capture: Path, tmp_path: Path, kind: str, part: str
) -> None:
    wanted = files_of(golden_capture / part)
    assert wanted
    assert round_trip(golden_capture / part, tmp_path / f"x.{kind}") == wanted


@pytest.mark.parametrize(("kind", "small"), [*((kind, False) for kind in KINDS), ("zarr", True)])
def test_several_sequences_come_back_byte_for_byte(
    data: Path, tmp_path: Path, kind: str, small: bool
) -> None:
    assert round_trip(data, tmp_path / f"x.{kind}", small=small) == files_of(data)


def test_a_zip_is_packed_in_place(data: Path, tmp_path: Path) -> None:
    archive = write_zip(files_of(data), tmp_path / "x.zip")
    assert round_trip(archive, tmp_path / "x.zarr") == files_of(data)


@pytest.mark.slow
def test_a_store_is_packed_again_as_another_kind(data: Path, tmp_path: Path) -> None:
    pack(data, tmp_path / "a.h5")
    pack(tmp_path / "a.h5", tmp_path / "b.parquet")
    assert round_trip(tmp_path / "b.parquet", tmp_path / "c.zarr") == files_of(data)


def test_one_sequence_keeps_its_name_though_its_path_is_empty(data: Path, tmp_path: Path) -> None:
    pack(data / PATH, tmp_path / "x.zarr")
    (sequence,) = carlasc.open(tmp_path / "x.zarr").sequences().values()
    assert (sequence.path, sequence.split, sequence.name) == ("", "Train", "Town01_Light")


any_float32 = st.floats(width=32, allow_nan=True, allow_infinity=True) | st.sampled_from(
    [0.0, -0.0]
)
counts = st.sampled_from(
    [0, 1, 2, 3, 255, 256, 65536, 2**24, 0.5, -0.0, -1.0, float("nan"), float("inf")]
)
labels = st.sampled_from([0, 1, 22, 255, 256, 65535, 65536, 2**32 - 1]) | st.integers(0, 30)


@st.composite
def frames(draw: st.DrawFn) -> list[dict[str, np.ndarray]]:
    """A few frames of a sequence: each field in some frames, every bit pattern that the published
    types can hold.
    """
    have = draw(
        st.sets(
            st.sampled_from(["labels", "flow", "instances", "bev", "evaluation", "fine", "fourth"])
        )
    )
    found = []
    for _ in range(draw(st.integers(1, 4))):
        count = draw(st.sampled_from([0, 1, 2, 7, 31, 257]))
        frame: dict[str, np.ndarray] = {"points": np.zeros((count, 4), np.float32)}
        frame["points"][:, :3] = draw(
            arrays.arrays(np.float32, (count, 3), elements=any_float32, fill=st.just(1.5))
        )
        if "fourth" in have:
            frame["points"][:, 3] = draw(
                arrays.arrays(np.float32, count, elements=any_float32, fill=st.just(0.0))
            )
        if count and draw(st.booleans()):
            # NaN payloads
            frame["points"].view(np.uint32)[0, draw(st.integers(0, 2))] = draw(
                st.integers(0, 2**32 - 1)
            )
        if "labels" in have and draw(st.booleans()):
            frame["labels"] = draw(
                arrays.arrays(np.uint32, count, elements=labels, fill=st.just(7))
            )
        if "flow" in have:
            frame["flow"] = draw(
                arrays.arrays(np.float32, (count, 3), elements=any_float32, fill=st.just(0.0))
            )
        if "instances" in have:
            frame["instances"] = draw(
                arrays.arrays(np.uint32, count, elements=labels, fill=st.just(0))
            )
        if "bev" in have:
            frame["bev"] = np.frombuffer(draw(st.binary(max_size=60)), np.uint8)
        for name, folder, size in (
            ("evaluation", "evaluation", SIZE),
            ("fine", "evaluation_6x10x4", (6, 10, 4)),
        ):
            if name in have and draw(st.booleans()):
                frame[f"{folder}/labels"] = draw(
                    arrays.arrays(np.uint32, size, elements=labels, fill=st.just(0))
                )
                frame[f"{folder}/counts"] = draw(
                    arrays.arrays(np.float32, size, elements=counts, fill=st.just(0))
                )
        found.append(frame)
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "small"), [*((kind, False) for kind in KINDS), ("zarr", True)])
@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(sequence=frames(), poses=st.binary(max_size=30), first=st.sampled_from([0, 7, 999_998]))
def test_odd_shapes_and_every_bit_pattern_come_back(
    tmp_path_factory: pytest.TempPathFactory,
    kind: str,
    small: bool,
    sequence: list[dict],
    poses: bytes,
    first: int,
) -> None:
    folder = tmp_path_factory.mktemp("odd")
    writer = FolderSink(folder / "data").sequence(PATH)
    # any bytes come back, even if no program can read them
    writer.write_document("poses.txt", poses)
    for name, size in (("evaluation", SIZE), ("evaluation_6x10x4", (6, 10, 4))):
        if any(f"{name}/labels" in frame for frame in sequence):
            writer.write_document(f"{name}/params.json", params(size) + b"\n ")
    for number, frame in enumerate(sequence, first):
        for name, array in frame.items():
            writer.write(name, number, array)
    assert round_trip(folder / "data", folder / f"x.{kind}", small=small) == files_of(
        folder / "data"
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("most", [255, 256, 65_535, 65_536, 2**24, 0.5, np.nan, -0.0, np.inf])
def test_counts_of_any_size_come_back(tmp_path: Path, kind: str, most: float) -> None:
    writer = FolderSink(tmp_path / "data").sequence(PATH)
    writer.write_document("evaluation/params.json", params(SIZE))
    for frame in range(2):
        counts = np.zeros(SIZE, np.float32)
        counts[0, 0, 0] = most if frame else 1
        writer.write("evaluation/labels", frame, np.zeros(SIZE, np.uint32))
        writer.write("evaluation/counts", frame, counts)
    assert round_trip(tmp_path / "data", tmp_path / f"x.{kind}") == files_of(tmp_path / "data")


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("largest", [255, 256, 65_536, 2**32 - 1])
def test_labels_of_any_size_come_back(tmp_path: Path, kind: str, largest: int) -> None:
    writer = FolderSink(tmp_path / "data").sequence(PATH)
    writer.write_document("evaluation/params.json", params(SIZE))
    labels = np.full(SIZE, largest, np.uint32)
    writer.write("evaluation/labels", 0, labels)
    writer.write("points", 0, np.zeros((3, 4), np.float32))
    writer.write("labels", 0, np.array([0, 1, largest], np.uint32))
    writer.write("instances", 0, np.array([0, 1, largest], np.uint32))
    assert round_trip(tmp_path / "data", tmp_path / f"x.{kind}") == files_of(tmp_path / "data")


@pytest.mark.parametrize("kind", KINDS)
def test_quantised_points_are_within_half_a_step_and_say_so(
    data: Path, tmp_path: Path, kind: str
) -> None:
    pack(data, tmp_path / f"x.{kind}", lossy_mm=1)
    unpack(tmp_path / f"x.{kind}", tmp_path / "files")
    before, after = FolderSource(data).sequences(), FolderSource(tmp_path / "files").sequences()
    for path, sequence in before.items():
        for frame in sequence.frames("points").tolist():
            wanted, found = sequence.read("points", frame), after[path].read("points", frame)
            assert np.abs(found - wanted).max(initial=0) <= 0.0005 + 1e-5
    exact = {n: d for n, d in files_of(data).items() if "velodyne" not in n}
    assert {n: d for n, d in files_of(tmp_path / "files").items() if "velodyne" not in n} == exact
    root = tmp_path / f"x.{kind}"
    if kind == "zarr":
        assert json.loads((root / "zarr.json").read_bytes())["attributes"]["lossy_mm"] == 1
        node = json.loads((root / PATH / "scans/points/zarr.json").read_bytes())
        assert node["attributes"]["scale_m"] == 0.001


@pytest.mark.parametrize("kind", KINDS)
def test_points_that_cannot_be_quantised_are_refused_by_name(tmp_path: Path, kind: str) -> None:
    points = np.zeros((3, 4), np.float32)
    points[1, 2] = np.nan
    FolderSink(tmp_path / "data").sequence(PATH).write("points", 4, points)
    with pytest.raises(FormatError, match="frame 4.*finite"):
        pack(tmp_path / "data", tmp_path / f"x.{kind}", lossy_mm=1)


def test_the_result_counts_bytes_per_field_and_lists_what_is_left_out(
    data: Path, tmp_path: Path
) -> None:
    root = write_dataset(tmp_path / "data")
    (root / PATH / "notes.txt").write_text("mine")
    steps: list[tuple[int, int]] = []
    result = pack(
        root, tmp_path / "x.zarr", run=Run(progress=lambda done, total: steps.append((done, total)))
    )
    files = files_of(root)
    assert result.left_out == [f"{PATH}: notes.txt"]
    assert result.sequences == sorted(carlasc.open(root).sequences())
    assert result.frames == 4 + 3 + 2
    assert result.published_bytes["points"] == sum(
        len(d) for n, d in files.items() if "velodyne" in n
    )
    assert result.published_bytes["flow"] == sum(
        len(d) for n, d in files.items() if "predictions" in n
    )
    assert (
        result.published_bytes["documents"]
        == sum(len(d) for n, d in files.items() if n.endswith((".txt", ".json"))) - 4
    )
    assert sum(result.stored_bytes.values()) == sum(
        map(len, files_of(tmp_path / "x.zarr").values())
    )
    assert (
        steps[-1][0]
        == steps[-1][1]
        == len(
            [
                n
                for n in files
                if n.endswith((".bin", ".label", ".jpg", ".npz", ".instance", ".png", ".seen"))
            ]
        )
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_an_existing_store_is_replaced_only_with_overwrite(
    data: Path, tmp_path: Path, kind: str
) -> None:
    out = tmp_path / f"x.{kind}"
    pack(data / "Val", out)
    with pytest.raises(ConflictError, match=r"give `overwrite=True`"):
        pack(data, out)
    assert len(carlasc.open(out).sequences()) == 1
    pack(data, out, overwrite=True)
    assert len(carlasc.open(out).sequences()) == 3
    assert [entry.name for entry in tmp_path.iterdir()] == [out.name]


def test_an_existing_folder_is_unpacked_into_only_with_overwrite(
    data: Path, tmp_path: Path
) -> None:
    pack(data / "Val", tmp_path / "x.zarr")
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "mine.txt").write_text("mine")
    with pytest.raises(ConflictError, match=r"give `overwrite=True`"):
        unpack(tmp_path / "x.zarr", tmp_path / "files")
    unpack(tmp_path / "x.zarr", tmp_path / "files", overwrite=True)
    assert files_of(tmp_path / "files") == files_of(data / "Val") | {"mine.txt": b"mine"}


@pytest.mark.slow
@pytest.mark.parametrize("out", ["x.zarr", "Train/x.zarr", ".", ".."])
def test_an_output_inside_or_around_the_source_is_refused(tmp_path: Path, out: str) -> None:
    data = write_dataset(tmp_path / "data")
    before = files_of(data)
    with pytest.raises((ConflictError, ArgumentError)):
        pack(data, data / out, overwrite=True)
    with pytest.raises(ConflictError):
        unpack(data, data / out, overwrite=True)
    assert files_of(data) == before


def test_an_ending_of_another_kind_lists_the_known_ones(data: Path, tmp_path: Path) -> None:
    with pytest.raises(ArgumentError, match=r"\.zarr, \.h5 or \.parquet"):
        pack(data, tmp_path / "x.npz")


@pytest.mark.parametrize("kind", KINDS)
def test_a_grid_whose_size_changes_is_an_error(tmp_path: Path, kind: str) -> None:
    writer = FolderSink(tmp_path / "data").sequence(PATH)
    writer.write_document("evaluation/params.json", params(SIZE))
    rng = np.random.default_rng(0)
    writer.write("evaluation/labels", 0, grid(rng, SIZE)["labels"])
    writer.write("evaluation/labels", 1, grid(rng, (3, 5, 3))["labels"])
    with raises(FormatError, where=r"evaluation/000001\.label", expected="120 bytes"):
        pack(tmp_path / "data", tmp_path / f"x.{kind}")
    with pytest.raises(CarlascError, match="run the same command again"):
        carlasc.open(tmp_path / f"x.{kind}")


@pytest.mark.parametrize("kind", KINDS)
def test_an_output_that_cannot_be_written_is_one_clear_error(
    data: Path, tmp_path: Path, kind: str
) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(
        CarlascError,
        match=rf"x\.{kind}(/zarr\.json)?: cannot be written: (Not a directory|File exists)",
    ):
        pack(data / "Val", tmp_path / "file" / f"x.{kind}")


@pytest.mark.slow
@pytest.mark.parametrize("path", ["../evil", "/tmp/evil", "Train/../../evil"])
def test_a_store_whose_names_lead_elsewhere_is_not_unpacked(
    data: Path, tmp_path: Path, path: str
) -> None:
    root = pack(data / "Val", tmp_path / "x.zarr").out / "zarr.json"
    node = json.loads(root.read_bytes())
    node["attributes"]["sequences"] = {path: next(iter(node["attributes"]["sequences"].values()))}
    root.write_text(json.dumps(node))
    with pytest.raises(FormatError, match="leads out of the store"):
        unpack(tmp_path / "x.zarr", tmp_path / "files")
    assert not list(tmp_path.parent.rglob("evil"))


KILLED = """
import os, signal, sys, carlasc.storage as packing
from carlasc import Run
from carlasc.storage import FolderSource
def kill(done, total):
    if done >= min(int(sys.argv[4]), total):
        os.kill(os.getpid(), signal.SIGKILL)
getattr(packing, sys.argv[1])(sys.argv[2], sys.argv[3], run=Run(progress=kill))
"""


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("files", [1, 30, 999])
@pytest.mark.slow
def test_a_killed_pack_leaves_no_store_and_a_second_run_finishes_it(
    data: Path, tmp_path: Path, kind: str, files: int
) -> None:
    out = tmp_path / f"x.{kind}"
    killed = subprocess.run(
        [sys.executable, "-c", KILLED, "pack", data, out, str(files)], check=False
    )
    assert killed.returncode == -signal.SIGKILL
    assert out.exists() is (kind == "zarr")
    with pytest.raises(CarlascError, match="run the same command again"):
        carlasc.open(out)
    assert round_trip(data, out) == files_of(data)
    assert {entry.name for entry in tmp_path.iterdir()} == {out.name, "x.files"}


def test_a_second_run_does_not_pack_blocks_again(data: Path, tmp_path: Path) -> None:
    out = tmp_path / "x.zarr"
    subprocess.run([sys.executable, "-c", KILLED, "pack", data, out, "999"], check=False)
    before = {file: file.stat().st_mtime_ns for file in out.rglob("c/**/0") if file.is_file()}
    assert len(before) == 45
    pack(data, out)
    assert {file: file.stat().st_mtime_ns for file in before} == before


def test_what_another_source_left_is_not_mixed_with_this_one(data: Path, tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-c", KILLED, "pack", data, tmp_path / "x.zarr", "1"], check=False
    )
    same = shutil.copytree(data, tmp_path / "same")
    (same / PATH / "carlasc.json").write_bytes(b"{}")
    with raises(
        ConflictError,
        where=r"carlasc\.json",
        expected="the text file of this source",
        found="a different file",
    ):
        pack(same, tmp_path / "x.zarr")
    other = write_dataset(tmp_path / "other", seed=1)
    with raises(ConflictError, expected="in the earlier run", found="files that changed"):
        pack(other, tmp_path / "x.zarr")


def kill(run: str, source: Path, out: Path, files: int) -> None:
    subprocess.run([sys.executable, "-c", KILLED, run, source, out, str(files)], check=False)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*KINDS, "files"])
def test_a_source_that_changes_after_a_kill_is_not_mixed_with_the_old_one(
    data: Path, tmp_path: Path, kind: str
) -> None:
    source, out = shutil.copytree(data, tmp_path / "data"), tmp_path / f"x.{kind}"
    run = unpack if kind == "files" else pack
    kill(run.__name__, source, out, 999)
    path = min((source / PATH / "velodyne").iterdir())
    path.write_bytes(np.frombuffer(path.read_bytes(), np.float32)[::-1].tobytes())
    if kind in ("zarr", "files"):
        with raises(ConflictError, where=r"x\.", found="files that changed"):
            run(source, out)
        for left in (out, out.with_name(f"{out.name}.part")):
            shutil.rmtree(left, ignore_errors=True)
    run(source, out)
    if kind != "files":
        unpack(out, tmp_path / "files")
    assert files_of(out if kind == "files" else tmp_path / "files") == files_of(source)


def test_a_store_knows_its_source_until_it_is_finished(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*arguments: object) -> None:
        raise KeyboardInterrupt

    source, out = shutil.copytree(data, tmp_path / "data"), tmp_path / "x.zarr"
    with monkeypatch.context() as killed, pytest.raises(KeyboardInterrupt):
        killed.setattr(ZarrSink, "finish", interrupt)
        pack(source, out, run=Run(1))
    path = min((source / PATH / "velodyne").iterdir())
    before = path.stat()
    os.utime(path, ns=(0, 0))
    with raises(ConflictError, found="files that changed"):
        pack(source, out, run=Run(1))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    pack(source, out, run=Run(1))
    assert not list(out.rglob("copied-*"))
    assert not [name for name in out.rglob("zarr.json") if b"copied-" in name.read_bytes()]


def test_a_part_that_runs_again_sees_that_its_source_changed(data: Path, tmp_path: Path) -> None:
    source, first = shutil.copytree(data, tmp_path / "data"), Run(part=Part(1, 2))
    unpack(source, tmp_path / "out", run=first)
    kept = unpack(source, tmp_path / "out", run=first)
    assert kept.kept and not kept.files
    for path in source.rglob("velodyne/*.bin"):
        os.utime(path, ns=(0, 0))
    with raises(ConflictError, found="files that changed"):
        unpack(source, tmp_path / "out", run=first)
    assert unpack(source, tmp_path / "out", run=Run(part=Part(2, 2))).files  # it may read a copy


def test_a_killed_unpack_continues_file_by_file(data: Path, tmp_path: Path) -> None:
    pack(data, tmp_path / "x.zarr")
    subprocess.run(
        [sys.executable, "-c", KILLED, "unpack", tmp_path / "x.zarr", tmp_path / "files", "20"],
        check=False,
    )
    assert not (tmp_path / "files").exists()
    result = unpack(tmp_path / "x.zarr", tmp_path / "files")
    assert result.kept >= 20
    assert files_of(tmp_path / "files") == files_of(data)


@pytest.mark.slow
def test_the_memory_does_not_grow_with_the_sequence(tmp_path: Path) -> None:
    script = (
        "import sys; from carlasc.storage.packing import pack; pack(sys.argv[1], sys.argv[2])\n"
    )
    script += PRINT_PEAK
    points = np.zeros((100_000, 4), np.float32)
    points[:, :3] = np.random.default_rng(0).normal(size=(100_000, 1))
    peaks = []
    for count in (20, 100):
        writer = FolderSink(tmp_path / f"data{count}").sequence(PATH)
        for frame in range(count):
            writer.write("points", frame, points)
        command = [
            sys.executable,
            "-c",
            script,
            tmp_path / f"data{count}",
            tmp_path / f"x{count}.h5",
        ]
        peaks.append(
            int(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        )
    unit = 1 if sys.platform == "darwin" else 1024
    assert (peaks[1] - peaks[0]) * unit < 40 << 20  # bytes, where the files have 128 MB more


runner = CliRunner()


def test_the_command_line_packs_and_unpacks(data: Path, tmp_path: Path) -> None:
    packed = runner.invoke(app, ["pack", str(data), str(tmp_path / "x.zarr")])
    assert packed.exit_code == 0, packed.output
    assert "3 sequences, 9 frames" in packed.output
    unpacked = runner.invoke(
        app, ["unpack", str(tmp_path / "x.zarr"), str(tmp_path / "files"), "--json"]
    )
    assert unpacked.exit_code == 0, unpacked.output
    assert json.loads(unpacked.output)["files"] == len(
        [
            n
            for n in files_of(data)
            if n.endswith((".bin", ".label", ".jpg", ".npz", ".instance", ".png", ".seen"))
        ]
    )
    assert files_of(tmp_path / "files") == files_of(data)


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["x.npz"], 2),
        (["x.h5", "--small"], 2),
        (["x.zarr", "--lossy-mm", "-1"], 2),
        (["taken.zarr"], 1),
    ],
)
def test_the_command_line_tells_wrong_usage_from_failure(
    data: Path, tmp_path: Path, arguments: list[str], code: int
) -> None:
    (tmp_path / "taken.zarr").mkdir()
    (tmp_path / "taken.zarr" / "photo.jpg").write_bytes(b"1")
    out, *options = arguments
    result = runner.invoke(app, ["pack", str(data), str(tmp_path / out), *options])
    assert result.exit_code == code
    assert result.stderr.startswith("carlasc: ")
    assert result.stderr.count("\n") == 1


@pytest.mark.parametrize("kind", ["h5", "parquet"])
def test_only_zarr_has_a_small_kind_and_the_command_names_the_option(
    data: Path, tmp_path: Path, kind: str
) -> None:
    result = runner.invoke(app, ["pack", str(data), str(tmp_path / f"x.{kind}"), "--small"])
    assert result.exit_code == 2
    assert result.stderr.startswith("carlasc: --small: expected a .zarr store")
    assert result.stderr.endswith("leave `--small` out\n")


@pytest.mark.parametrize("kind", ["h5", "parquet"])
def test_stores_of_one_writer_take_no_executor(data: Path, tmp_path: Path, kind: str) -> None:
    with (
        ThreadPoolExecutor(1) as executor,
        pytest.raises(
            ArgumentError,
            match=r"executor: expected a \.zarr store, which several processes can write",
        ),
    ):
        pack(data, tmp_path / f"x.{kind}", run=Run(executor=executor))
    assert not list(tmp_path.iterdir())


def test_results_say_how_long_it_took(data: Path, tmp_path: Path) -> None:
    began = time.perf_counter()
    packed = pack(data / "Val", tmp_path / "x.h5")
    unpacked = unpack(tmp_path / "x.h5", tmp_path / "files")
    assert packed.elapsed_s > 0 and unpacked.elapsed_s > 0
    assert packed.elapsed_s + unpacked.elapsed_s <= time.perf_counter() - began


def test_unpacking_over_a_folder_replaces_its_files_and_counts_them(
    data: Path, tmp_path: Path
) -> None:
    pack(data / "Val", tmp_path / "x.h5")
    first = unpack(tmp_path / "x.h5", tmp_path / "files")
    assert (first.files, first.kept) == (15, 0)
    damaged = next((tmp_path / "files").rglob("000001.label"))
    damaged.write_bytes(b"damaged!")
    steps: list[tuple[int, int]] = []
    again = unpack(
        tmp_path / "x.h5",
        tmp_path / "files",
        overwrite=True,
        run=Run(progress=lambda done, total: steps.append((done, total))),
    )
    assert (again.files, again.kept) == (15, 0)
    assert steps[-1] == (15, 15)
    assert files_of(tmp_path / "files") == files_of(data / "Val")


def test_a_continued_unpacking_counts_the_files_that_it_kept(data: Path, tmp_path: Path) -> None:
    pack(data / "Val", tmp_path / "x.h5")
    unpack(tmp_path / "x.h5", tmp_path / "files").out.rename(tmp_path / "files.part")
    next((tmp_path / "files.part").rglob("000001.label")).unlink()
    steps: list[tuple[int, int]] = []
    result = unpack(
        tmp_path / "x.h5",
        tmp_path / "files",
        run=Run(progress=lambda done, total: steps.append((done, total))),
    )
    assert (result.files, result.kept) == (1, 14)
    assert steps[-1] == (15, 15)


@pytest.mark.parametrize("millimetres", [0.001, 1000])
def test_the_limits_of_quantisation(millimetres: float) -> None:
    assert PackOptions(lossy_mm=millimetres).scale_m == millimetres / 1000


def test_leftovers_of_an_older_replacement_are_removed_and_a_copy_of_the_user_stays(
    data: Path, tmp_path: Path
) -> None:
    pack(data / "Val", tmp_path / "x.h5")
    for name in ("x.h5.replaced", "x.h5.old"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_bytes(b"1")
    pack(data / "Val", tmp_path / "x.h5", overwrite=True)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["x.h5", "x.h5.old"]


def test_a_file_that_appears_meanwhile_is_not_overwritten(data: Path, tmp_path: Path) -> None:
    def appear(done: int, total: int) -> None:
        (tmp_path / "x.h5").write_bytes(b"diary")

    with raises(ConflictError, where=r"x\.h5", expected="a new path", found="a file"):
        pack(data / "Val", tmp_path / "x.h5", run=Run(progress=appear))
    assert (tmp_path / "x.h5").read_bytes() == b"diary"
