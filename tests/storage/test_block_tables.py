"""Zarr stores that several processes write: nothing is lost, and the files are those of one
process.
"""

from __future__ import annotations

import itertools
import json
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets.sequences import files_of, lines, params, scan
from helpers.errors import raises
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import carlasc
from carlasc import Run
from carlasc.errors import ArgumentError, ConflictError, FormatError, MissingDataError
from carlasc.storage import FolderSink, Sequence, pack, unpack
from carlasc.storage.packed.stores import PackOptions
from carlasc.storage.transport.trees import LocalTarget
from carlasc.storage.zarr.zarr_finish import finish
from carlasc.storage.zarr.zarr_sink import ZarrSink, ZarrWriter

for package in ("numcodecs", "google_crc32c"):
    pytest.importorskip(package)

PATH = "Train/Town01_Light/cartesian"
SIZE = (4, 6, 2)
FRAMES = 40


def arrays_of(frame: int) -> dict[str, np.ndarray]:
    """The fields of a frame: some frames have a 4th column, wide labels, counts that are not whole,
    no points, or no grid.
    """
    rng = np.random.default_rng(frame)
    fields: dict[str, np.ndarray] = scan(rng, 0 if frame % 7 == 3 else 100 + frame)
    if frame % 5 == 1 and len(fields["points"]):
        fields["points"][0, 3] = 0.5
        fields["labels"][0] = 70_000
    if frame % 3:
        counts = rng.integers(0, 300, SIZE).astype(np.float32)
        fields["evaluation/labels"] = rng.integers(0, 23, SIZE).astype(np.uint32)
        fields["evaluation/counts"] = counts / 3 if frame % 4 == 0 else counts
    return fields


def start(out: Path) -> ZarrWriter:
    return start_sink(ZarrSink(out))


def start_sink(sink: ZarrSink) -> ZarrWriter:
    """Announce the frames, and write the text files."""
    writer = sink.sequence(PATH)
    writer.write_document("evaluation/params.json", params(SIZE))
    writer.write_document("poses.txt", lines(FRAMES)[0])
    frames: dict[str, list[int]] = {}
    for frame in range(FRAMES):
        for name in arrays_of(frame):
            frames.setdefault(name, []).append(frame)
    writer.expect(frames, {"points": 140})
    return writer


def write_block(task: tuple[ZarrWriter, int]) -> None:
    writer, block = task
    first = block * writer.block
    writer.write_frames(
        {frame: arrays_of(frame) for frame in range(first, min(first + writer.block, FRAMES))}
    )


def assert_whole(out: Path) -> None:
    sequence = carlasc.open(out).sequences()[PATH]
    for frame in range(FRAMES):
        for name, array in arrays_of(frame).items():
            assert np.array_equal(sequence.read(name, frame), array), (name, frame)


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of a store that one process has written, block by block."""
    out = tmp_path_factory.mktemp("reference") / "x.zarr"
    writer = start(out)
    for block in range(3):
        write_block((writer, block))
    finish(LocalTarget(out))
    assert_whole(out)
    return files_of(out)


@pytest.mark.posix("fork")
def test_two_processes_write_different_blocks_in_any_order(
    tmp_path: Path, reference: dict[str, bytes]
) -> None:
    writer = start(tmp_path / "x.zarr")
    with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("fork")) as pool:
        list(pool.map(write_block, [(writer, block) for block in (2, 0, 1)]))
    finish(LocalTarget(tmp_path / "x.zarr"))
    assert files_of(tmp_path / "x.zarr") == reference


WHOLE_RUN = """
import sys
from pathlib import Path
sys.path[:0] = sys.argv[2:]
from storage.test_block_tables import start, write_block
from carlasc.storage.zarr.zarr_finish import finish
from carlasc.storage.transport.trees import LocalTarget
out = Path(sys.argv[1])
writer = start(out)
print("ready", flush=True)
sys.stdin.read(1)
for block in range(3):
    write_block((writer, block))
finish(LocalTarget(out))
"""


@pytest.mark.slow
def test_two_processes_that_write_the_same_blocks_at_once_lose_nothing(
    tmp_path: Path, reference: dict[str, bytes]
) -> None:
    tests = Path(__file__).parents[1]
    command = [sys.executable, "-c", WHOLE_RUN, tmp_path / "x.zarr", tests, tests.parent]
    runs = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) for _ in range(2)
    ]
    pipes = [(run.stdin, run.stdout) for run in runs]
    for _, output in pipes:
        assert output is not None and output.readline() == b"ready\n"
    for pipe, _ in pipes:
        assert pipe is not None
        pipe.write(b"1")
        pipe.flush()
    for run in runs:
        run.communicate()
    assert [run.returncode for run in runs] == [0, 0]
    assert files_of(tmp_path / "x.zarr") == reference


@pytest.mark.posix("fork")
@pytest.mark.parametrize("seed", range(4))
def test_a_process_that_is_killed_anywhere_is_continued(
    tmp_path: Path, reference: dict[str, bytes], seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, last = tmp_path / "x.zarr", int(np.random.default_rng(seed).integers(1, 60))
    child = os.fork()
    if child == 0:  # dies at some write, before or after its file has got its name
        puts = itertools.count(1)  # files are written in several threads
        put = LocalTarget.put

        def put_and_die(self: LocalTarget, path: str, data: Any, *, create: bool = False) -> bool:
            number = next(puts)
            if number == last and seed % 2:
                os.kill(os.getpid(), signal.SIGKILL)
            done = put(self, path, data, create=create)
            if number == last:
                os.kill(os.getpid(), signal.SIGKILL)
            return done

        LocalTarget.put = put_and_die  # type: ignore[method-assign]
        writer = start(out)
        for block in (1, 0, 2):
            write_block((writer, block))
        os._exit(1)
    assert os.WTERMSIG(os.waitpid(child, 0)[1]) == signal.SIGKILL
    with pytest.raises((FormatError, MissingDataError)):
        carlasc.open(out).sequences()
    writer = start(out)
    for block in range(3):
        missing = [
            f
            for f in range(block * 16, min(block * 16 + 16, FRAMES))
            if not all(writer.has(n, f) for n in arrays_of(f))
        ]
        writer.write_frames({frame: arrays_of(frame) for frame in missing})
    finish(LocalTarget(out))
    assert files_of(out) == reference


@settings(max_examples=15, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(data=st.data(), block=st.integers(1, 5))
@pytest.mark.slow
def test_frames_written_in_any_order_together_or_alone_give_the_same_files(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject, block: int
) -> None:
    folder, count = tmp_path_factory.mktemp("orders"), 7
    given = {frame: arrays_of(frame) for frame in range(count)}
    whole = ZarrSink(folder / "a.zarr", PackOptions(block=block)).sequence(PATH)
    whole.expect({}, {"points": 140})
    whole.write_frames(given)
    finish(LocalTarget(folder / "a.zarr"))
    writer: ZarrWriter = ZarrSink(folder / "b.zarr", PackOptions(block=block)).sequence(PATH)
    writer.expect({}, {"points": 140})
    items = data.draw(st.permutations([(frame, name) for frame in given for name in given[frame]]))
    while items:
        size = data.draw(st.integers(1, 6))
        part, items = items[:size], items[size:]
        if data.draw(st.booleans()):
            for frame, name in part:
                writer.write(name, frame, given[frame][name])
        else:
            together: dict[int, dict[str, np.ndarray]] = {}
            for frame, name in part:
                together.setdefault(frame, {})[name] = given[frame][name]
            writer.write_frames(together)
        frame, name = part[-1]
        assert writer.has(name, frame)
        assert np.array_equal(writer.read(name, frame), given[frame][name])
        if data.draw(st.booleans()):
            writer.close()
            writer = pickle.loads(pickle.dumps(writer))
    writer.close()
    finish(LocalTarget(folder / "b.zarr"))
    assert files_of(folder / "a.zarr") == files_of(folder / "b.zarr")


def test_a_frame_that_is_written_again_is_replaced(tmp_path: Path) -> None:
    with ZarrSink(tmp_path / "x.zarr") as sink, sink.sequence(PATH) as writer:
        writer.write_frames({frame: arrays_of(frame) for frame in range(4)})
        writer.write_frames({1: arrays_of(2)})
        writer.write("points", 2, arrays_of(1)["points"])
        assert np.array_equal(writer.read("points", 1), arrays_of(2)["points"])
    sequence = carlasc.open(tmp_path / "x.zarr").sequences()[PATH]
    for frame, wanted in ((0, 0), (1, 2), (2, 1), (3, 3)):
        assert np.array_equal(sequence.read("points", frame), arrays_of(wanted)["points"])


def test_a_writer_sees_what_another_one_writes(tmp_path: Path) -> None:
    first, second = start(tmp_path / "x.zarr"), start(tmp_path / "x.zarr")
    assert not any(first.has("points", frame) for frame in range(FRAMES))
    write_block((second, 1))
    assert [frame for frame in range(FRAMES) if first.has("points", frame)] == list(range(16, 32))
    assert np.array_equal(first.read("points", 20), arrays_of(20)["points"])
    write_block((second, 2))
    assert first.read("labels", 39) is not None and first.has("labels", 39)
    assert first.read("labels", 0) is None and first.read("flow", 0) is None


def test_asking_for_all_frames_takes_few_listings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, frames = tmp_path / "x.zarr", 2000
    labels = np.zeros(3, np.uint32)
    with ZarrSink(out).sequence(PATH) as writer:
        writer.write_frames({frame: {"labels": labels} for frame in range(0, frames, 100)})
    asked: list[str] = []
    tree, listed = type(LocalTarget(out).tree), LocalTarget.paths
    many = tree.read_many
    monkeypatch.setattr(
        LocalTarget, "paths", lambda self, folder="": asked.append(folder) or listed(self, folder)
    )
    monkeypatch.setattr(
        tree,
        "read_many",
        lambda self, paths, size=None: asked.append("many") or many(self, paths, size),
    )
    other = ZarrSink(out).sequence(PATH)
    assert [f for f in range(frames) if other.has("labels", f)] == list(range(0, frames, 100))
    assert len(asked) < 12, asked


def test_a_store_with_missing_frames_is_not_finished_by_accident(tmp_path: Path) -> None:
    out = tmp_path / "x.zarr"
    writer = start(out)
    write_block((writer, 0))
    with pytest.raises(
        ConflictError,
        match=rf"expected all frames that the run announced, found 16 of evaluation/counts "
        rf"missing in {PATH}, 128 in the whole "
        "store: run the same command again, or give `incomplete=True`",
    ):
        finish(LocalTarget(out))
    with pytest.raises(FormatError, match="carlasc finish"):
        carlasc.open(out)
    found = finish(LocalTarget(out), incomplete=True)
    assert found.sequences == {
        PATH: {"evaluation/counts": 10, "evaluation/labels": 10}
        | dict.fromkeys(scan(np.random.default_rng(0), 1), 16)
    }
    assert found.missing[PATH]["points"] == 24
    assert carlasc.open(out).sequences()[PATH].frames("points").tolist() == list(range(16))


def test_finishing_again_changes_nothing_and_without_a_store_it_is_an_error(
    tmp_path: Path, reference: dict[str, bytes]
) -> None:
    out = tmp_path / "x.zarr"
    for name, data in reference.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (out / name).write_bytes(data)
    assert finish(LocalTarget(out)).sequences[PATH]["points"] == FRAMES
    assert files_of(out) == reference
    with raises(MissingDataError, expected="a zarr store of version 3"):
        finish(LocalTarget(tmp_path / "nothing"))


def test_sequences_may_lie_inside_each_other(tmp_path: Path) -> None:
    with ZarrSink(tmp_path / "x.zarr") as sink:
        for number, path in enumerate(("town", "town/scans", "")):
            with sink.sequence(path) as writer:
                writer.write("points", number, arrays_of(number)["points"])
    sequences = carlasc.open(tmp_path / "x.zarr").sequences()
    assert {path: found.frames("points").tolist() for path, found in sequences.items()} == {
        "": [2], "town": [0], "town/scans": [1]
    }  # fmt: skip


def test_expected_frames_are_kept_as_ranges_and_add_up(tmp_path: Path) -> None:
    writer = ZarrSink(tmp_path / "x.zarr").sequence(PATH)
    writer.expect({"points": [0, 1, 2, 7], "labels": []})
    writer.expect({"points": [3], "flow": [5]})
    found = json.loads((tmp_path / "x.zarr" / PATH / "expected.json").read_bytes())
    assert found == {"points": [[0, 4], [7, 8]], "labels": [], "flow": [[5, 6]]}


def test_a_scan_much_larger_than_announced_is_one_clear_error(tmp_path: Path) -> None:
    writer = ZarrSink(tmp_path / "x.zarr").sequence(PATH)
    writer.expect({}, {"points": 10})
    with raises(
        FormatError,
        where="field labels, frame 3: its array",
        expected="at most 262144 elements",
        found="262145",
        advice="leave",
    ):
        writer.write("labels", 3, np.zeros(262_145, np.uint32))
    writer.write("labels", 4, np.ones(262_144, np.uint32))
    assert writer.read("labels", 4).sum() == 262_144


def test_flow_with_many_vectors_comes_back(tmp_path: Path) -> None:
    flow = np.random.default_rng(0).normal(size=(20_000, 3)).astype(np.float32)
    few = np.repeat(flow[:4], 5000, axis=0)
    with ZarrSink(tmp_path / "x.zarr") as sink, sink.sequence(PATH) as writer:
        writer.write_frames({0: {"flow": flow}, 1: {"flow": few}, 2: {"flow": flow[:300]}})
    sequence = carlasc.open(tmp_path / "x.zarr").sequences()[PATH]
    for frame, wanted in enumerate((flow, few, flow[:300])):
        assert sequence.read("flow", frame).tobytes() == wanted.tobytes()


def test_a_grid_can_be_removed_and_made_again(tmp_path: Path) -> None:
    writer = start(tmp_path / "x.zarr")
    write_block((writer, 0))
    writer.write_document("evaluation/carlasc-report.json", b"{}")
    writer.remove_grid("evaluation")
    assert writer.read_document("evaluation/params.json") is None
    assert writer.read_document("evaluation/carlasc-report.json") is None
    assert not writer.has("evaluation/labels", 1) and writer.has("points", 1)
    writer.write("evaluation/labels", 1, np.ones((2, 2, 2), np.uint8))
    writer.close()
    finish(LocalTarget(tmp_path / "x.zarr"), incomplete=True)
    sequence = carlasc.open(tmp_path / "x.zarr").sequences()[PATH]
    assert sequence.fields() == {"points", "labels", "flow", "instances", "evaluation/labels"}
    assert sequence.read("evaluation/labels", 1).shape == (2, 2, 2)


@pytest.mark.parametrize("small", [False, True])
@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.slow
def test_packing_in_processes_gives_the_same_files(
    tmp_path: Path, small: bool, workers: int
) -> None:
    writer = FolderSink(tmp_path / "data").sequence(PATH)
    writer.write_document("evaluation/params.json", params(SIZE))
    for frame in range(FRAMES):
        writer.write_frames({frame: arrays_of(frame)})
    pack(tmp_path / "data", tmp_path / "a.zarr", small=small, run=Run(workers=workers))
    pack(tmp_path / "a.zarr", tmp_path / "b.zarr", small=small, run=Run(workers=1))
    assert files_of(tmp_path / "a.zarr") == files_of(tmp_path / "b.zarr")
    unpack(tmp_path / "b.zarr", tmp_path / "files", run=Run(workers=workers))
    assert files_of(tmp_path / "files") == files_of(tmp_path / "data")


def test_a_source_names_the_files_that_hold_frames(
    tmp_path: Path, reference: dict[str, bytes]
) -> None:
    for name, data in reference.items():
        (tmp_path / "x.zarr" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "x.zarr" / name).write_bytes(data)
    sequence: Sequence = carlasc.open(tmp_path / "x.zarr").sequences()[PATH]
    shards = f"{PATH}/scans/points/xyz/c"
    assert sequence.files_of("points", [0, 5, 4]) == [f"{shards}/0/0/0"]
    assert sequence.files_of("points", [39, 1]) == [
        f"{shards}/2/0/0",
        f"{shards}/0/0/0",
        f"{PATH}/scans/points/fourth/c/0/0",
    ]
    assert sequence.files_of("points", [3]) == []  # an empty scan
    assert set(sequence.files_of("evaluation/counts", [1, 4])) == {
        f"{PATH}/grids/evaluation/counts/{column}/c/0/0/0/0" for column in ("values", "values_wide")
    }


@pytest.mark.parametrize("block", [0, 1025])
def test_senseless_blocks_are_refused(block: int) -> None:
    with raises(ArgumentError, where="block", expected="1 to 1024 frames"):
        PackOptions(block=block)


def test_a_store_of_one_frame_in_blocks_of_one_frame_is_read(tmp_path: Path) -> None:
    with ZarrSink(tmp_path / "x.zarr", PackOptions(block=1)) as sink, sink.sequence(PATH) as writer:
        writer.write_frames({0: arrays_of(1)})
        assert np.array_equal(
            writer.read("evaluation/counts", 0), arrays_of(1)["evaluation/counts"]
        )
    sequence = carlasc.open(tmp_path / "x.zarr").sequences()[PATH]
    for name, array in arrays_of(1).items():
        assert np.array_equal(sequence.read(name, 0), array), name


def test_a_store_in_blocks_of_one_frame_is_read(tmp_path: Path) -> None:
    with ZarrSink(tmp_path / "x.zarr", PackOptions(block=1)) as sink, sink.sequence(PATH) as writer:
        writer.write_frames({frame: arrays_of(frame) for frame in range(FRAMES)})
    assert_whole(tmp_path / "x.zarr")
    assert len(list((tmp_path / "x.zarr" / PATH / "scans/labels/values/c").iterdir())) > 20


def test_an_empty_table_that_a_power_failure_left_is_made_again(
    tmp_path: Path, reference: dict[str, bytes]
) -> None:
    writer = start(tmp_path / "x.zarr")
    for block in range(3):
        write_block((writer, block))
    (tmp_path / "x.zarr" / PATH / "scans/points/blocks/000000.json").write_bytes(b"")
    again = start(tmp_path / "x.zarr")
    assert not again.has("points", 0)
    write_block((again, 0))
    finish(LocalTarget(tmp_path / "x.zarr"))
    assert files_of(tmp_path / "x.zarr") == reference


@pytest.mark.parametrize("broken", [b"[]", b'{"frames": [1]}', b'{"frames": {"x": {"xyz": 1}}}'])
def test_a_damaged_table_of_a_block_is_one_clear_error(tmp_path: Path, broken: bytes) -> None:
    writer = start(tmp_path / "x.zarr")
    write_block((writer, 0))
    (tmp_path / "x.zarr" / PATH / "scans/points/blocks/000000.json").write_bytes(broken)
    for use in (
        lambda: ZarrSink(tmp_path / "x.zarr").sequence(PATH).has("points", 0),
        lambda: finish(LocalTarget(tmp_path / "x.zarr")),
    ):
        with pytest.raises(FormatError, match="scans/points/blocks/000000.json: expected"):
            use()
