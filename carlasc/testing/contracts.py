"""The contract tests of a Source and of a Sink.

Subclass them, and pytest runs them on your store.
"""

# ruff: noqa: D102 (the name of a test says what it tests)

from __future__ import annotations

import multiprocessing
import os
import pickle
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from carlasc.core.arrays import Float32Array
from carlasc.core.boxes import BOXES_DTYPE
from carlasc.errors import FormatError, MissingDataError
from carlasc.storage import FolderSource, Sequence, Sink, Source
from carlasc.testing.data import FRAMES, GRIDS, SCANS, WHOLE, published_bytes, scan, write_dataset


def read_sum(sequence: Sequence) -> float:
    """Return the sum of the coordinates of a scan. Called in other processes."""
    return float(sequence.read("points", FRAMES[-1])[:, :3].sum())


def _documents(sequence: Sequence) -> dict[str, bytes]:
    return {name: sequence.read_document(name) for name in sequence.documents()}


class SourceContract:
    """Contract of a Source: it returns the sequences, fields, frames, values and text files that
    `write_dataset` wrote.

    A subclass defines `build`.

    Attributes:
        processes: start methods of processes in which the source is also read ("spawn" takes two
            seconds); empty if it cannot be pickled.
    """

    processes: tuple[str, ...] = ("fork", "spawn")

    def build(self, published: Path, folder: Path) -> Source:
        """Return a source of the sequences in `published`, a folder of published files.

        `folder` is empty and can be written to.
        """
        raise NotImplementedError

    @pytest.fixture(scope="class")
    @classmethod
    def published(cls, tmp_path_factory: pytest.TempPathFactory) -> Path:
        return write_dataset(tmp_path_factory.mktemp("published") / "data")

    @pytest.fixture(scope="class")
    @classmethod
    def source(cls, published: Path, tmp_path_factory: pytest.TempPathFactory) -> Source:
        return cls().build(published, tmp_path_factory.mktemp("store"))

    @pytest.fixture(scope="class")
    @classmethod
    def expected(cls, published: Path) -> dict[str, Sequence]:
        return dict(FolderSource(published).sequences())

    def test_finds_the_sequences_sorted_by_their_paths(self, source: Source) -> None:
        assert list(source.sequences()) == sorted([WHOLE, SCANS, GRIDS])

    def test_sequences_have_their_split_name_and_coordinates(self, source: Source) -> None:
        parts = {(s.split, s.name, s.coordinates) for s in source.sequences().values()}
        assert parts == {
            ("Train", "Town01_Light", "cartesian"),
            ("Val", "Town07_Heavy", "cartesian"),
            ("Test", "Town10_Medium", "cylindrical"),
        }

    @pytest.mark.parametrize("path", [WHOLE, SCANS, GRIDS])
    def test_has_the_same_fields_frames_and_bits(
        self, source: Source, expected: dict[str, Sequence], path: str
    ) -> None:
        sequence = source.sequences()[path]
        reference = expected[path]
        assert sequence.fields() == reference.fields()
        for name in reference.fields():
            frames = reference.frames(name)
            assert sequence.frames(name).tolist() == frames.tolist()
            for frame, together in zip(
                frames.tolist(), sequence.read_many(name, frames.tolist()), strict=True
            ):
                alone = sequence.read(name, frame)
                wanted = reference.read(name, frame)
                assert alone.shape == together.shape == wanted.shape
                bits = published_bytes(name, wanted)
                assert published_bytes(name, alone) == bits, (name, frame)
                assert published_bytes(name, together) == bits, (name, frame)

    @pytest.mark.parametrize("path", [WHOLE, SCANS, GRIDS])
    def test_has_the_same_text_files(
        self, source: Source, expected: dict[str, Sequence], path: str
    ) -> None:
        assert _documents(source.sequences()[path]) == _documents(expected[path])

    def test_points_are_float32_and_labels_unsigned(self, source: Source) -> None:
        read = source.sequences()[WHOLE].read
        for name, kind in {
            "points": np.float32,
            "flow": np.float32,
            "instances": np.uint32,
        }.items():
            assert read(name, 5).dtype == kind
        for name in ("labels", "evaluation/labels"):
            assert read(name, 5).dtype.kind == "u"

    def test_boxes_are_the_same_empty_without_objects_and_absent_without_annotation(
        self, source: Source, expected: dict[str, Sequence]
    ) -> None:
        sequence = source.sequences()[WHOLE]
        none = sequence.boxes(0)
        some = sequence.boxes(5)
        wanted = expected[WHOLE].boxes(5)
        assert none is not None and len(none) == 0 and sequence.boxes(2) is None
        assert some is not None and wanted is not None and len(some) == 5
        assert some.annotated.dtype == np.bool_ and np.array_equal(some.annotated, wanted.annotated)
        assert np.array_equal(some.tracks, wanted.tracks) and np.array_equal(
            some.sensor_T_box, wanted.sensor_T_box
        )
        assert sequence.read("boxes", 5).dtype == BOXES_DTYPE

    def test_reads_frames_in_any_order_and_twice(self, source: Source) -> None:
        sequence = source.sequences()[WHOLE]
        order = [5, 0, 2, 5, 1]
        for frame, array in zip(order, sequence.read_many("points", order), strict=True):
            assert np.array_equal(array, sequence.read("points", frame))

    def test_read_xyz_gives_the_coordinates_of_the_points_also_into_memory_of_earlier_calls(
        self, source: Source
    ) -> None:
        sequence = source.sequences()[WHOLE]
        spare: list[Float32Array] = []
        for frames in ([0, 1, 2], [5, 2], [1, 0, 5]):
            arrays = sequence.read_xyz(frames, spare)
            for frame, xyz in zip(frames, arrays, strict=True):
                points = sequence.read("points", frame)
                assert xyz.dtype == np.float32 and xyz.shape[0] == len(points)
                assert xyz[:, :3].tobytes() == points[:, :3].tobytes()
            spare = arrays

    def test_reading_no_frames_gives_an_empty_list(self, source: Source) -> None:
        assert source.sequences()[WHOLE].read_many("points", []) == []

    def test_an_absent_field_has_no_frames_and_reading_it_is_an_error(self, source: Source) -> None:
        sequence = source.sequences()[SCANS]
        assert len(sequence.frames("flow")) == 0
        with pytest.raises(MissingDataError, match=r"flow.*labels.*points"):
            sequence.read("flow", 0)

    def test_an_absent_frame_is_an_error(self, source: Source) -> None:
        with pytest.raises(MissingDataError):
            source.sequences()[WHOLE].read("points", 3)

    def test_an_absent_text_file_is_an_error(self, source: Source) -> None:
        with pytest.raises(MissingDataError):
            source.sequences()[SCANS].read_document("poses.txt")

    def test_pickles_before_and_after_reading(self, source: Source) -> None:
        sequence = source.sequences()[WHOLE]
        before = pickle.loads(pickle.dumps(source)).sequences()[WHOLE]
        wanted = sequence.read("points", 2)
        after = pickle.loads(pickle.dumps(sequence))
        assert np.array_equal(before.read("points", 2), wanted)
        assert np.array_equal(after.read("points", 2), wanted)

    @pytest.mark.parametrize("method", ["fork", "spawn"])
    def test_reads_in_other_processes_after_reading_in_this_one(
        self, source: Source, method: str
    ) -> None:
        if method not in self.processes:
            pytest.skip("this store is not tested with this start method of processes")
        sequence = source.sequences()[WHOLE]
        wanted = read_sum(sequence)
        with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context(method)) as pool:
            assert list(pool.map(read_sum, [sequence] * 4)) == [wanted] * 4
        assert read_sum(sequence) == wanted

    @pytest.mark.skipif(
        not Path("/proc/self/fd").is_dir(), reason="needs Linux to list the open files"
    )
    def test_keeps_no_file_open(self, source: Source) -> None:
        sequence = source.sequences()[WHOLE]
        for name in sequence.fields():
            sequence.read(name, 5)
        links = [Path(f"/proc/self/fd/{number}") for number in os.listdir("/proc/self/fd")]
        targets = [str(link.readlink()) for link in links if link.is_symlink()]
        assert not [target for target in targets if target.startswith(source.location)]


class SinkContract:
    """Contract of a Sink: the written data can be read again, and data that do not fit are refused.

    A subclass defines `sink` and `read`.

    Attributes:
        rising: whether the frames of a field must be written in ascending order.
    """

    rising: bool = True

    def sink(self, out: Path) -> Sink:
        """Return a sink that writes to `out`, which does not exist yet."""
        raise NotImplementedError

    def read(self, out: Path) -> Source:
        """Return a source that reads what the sink wrote to `out`."""
        raise NotImplementedError

    @pytest.fixture
    def out(self, tmp_path: Path) -> Path:
        return tmp_path / "out"

    @pytest.fixture(scope="class")
    @classmethod
    def given(cls, tmp_path_factory: pytest.TempPathFactory) -> Source:
        return FolderSource(write_dataset(tmp_path_factory.mktemp("published") / "data", seed=1))

    def write_all(self, given: Source, sink: Sink) -> None:
        with sink:
            for path, sequence in given.sequences().items():
                with sink.sequence(path) as writer:
                    for name in sequence.documents():
                        writer.write_document(name, sequence.read_document(name))
                    frames = sorted(
                        {int(f) for name in sequence.fields() for f in sequence.frames(name)}
                    )
                    # all fields of a frame before the next frame, as in a run over frames
                    for frame in frames:
                        for name in sorted(
                            [n for n in sequence.fields() if frame in sequence.frames(n)]
                        ):
                            writer.write(name, frame, sequence.read(name, frame))
                            assert writer.has(name, frame)

    def test_gives_back_what_it_took(self, given: Source, out: Path) -> None:
        self.write_all(given, self.sink(out))
        read_back = self.read(out).sequences()
        assert list(read_back) == list(given.sequences())
        for path, sequence in given.sequences().items():
            again = read_back[path]
            assert again.fields() == sequence.fields()
            assert _documents(again) == _documents(sequence)
            for name in sequence.fields():
                frames = sequence.frames(name).tolist()
                assert again.frames(name).tolist() == frames
                for frame in frames:
                    got = again.read(name, frame)
                    wanted = sequence.read(name, frame)
                    same = published_bytes(name, got) == published_bytes(name, wanted)
                    assert same, (path, name, frame)

    def test_has_nothing_but_what_was_written(self, given: Source, out: Path) -> None:
        writer = self.sink(out).sequence(SCANS)
        assert not writer.has("points", 0)
        writer.write("points", 0, given.sequences()[SCANS].read("points", 0))
        assert writer.has("points", 0)
        assert not writer.has("points", 1)
        assert not writer.has("labels", 0)

    def test_text_files_can_be_read_before_the_sink_is_closed(self, out: Path) -> None:
        writer = self.sink(out).sequence(SCANS)
        assert writer.read_document("times.txt") is None
        writer.write_document("times.txt", b"0\n")
        assert writer.read_document("times.txt") == b"0\n"

    def test_refuses_an_array_that_does_not_fit(self, out: Path) -> None:
        writer = self.sink(out).sequence(SCANS)
        with pytest.raises(FormatError, match="N, 4"):
            writer.write("points", 0, np.zeros((5, 3), np.float32))

    def test_refuses_a_field_that_is_not_in_the_layout(self, out: Path) -> None:
        with pytest.raises(FormatError, match="velocity"):
            self.sink(out).sequence(SCANS).write("velocity", 0, np.zeros((5, 3), np.float32))

    def test_empty_arrays_keep_their_shape(self, out: Path) -> None:
        empty = scan(np.random.default_rng(), 0)
        with self.sink(out) as sink, sink.sequence(SCANS) as writer:
            for name, array in empty.items():
                writer.write(name, 0, array)
        sequence = self.read(out).sequences()[SCANS]
        for name, array in empty.items():
            assert sequence.read(name, 0).shape == array.shape

    def test_refuses_or_takes_frames_out_of_order(self, given: Source, out: Path) -> None:
        labels = given.sequences()[SCANS].read("labels", 0)
        with self.sink(out) as sink, sink.sequence(SCANS) as writer:
            writer.write("labels", 5, labels)
            if self.rising:
                with pytest.raises(FormatError, match="rising"):
                    writer.write("labels", 4, labels)
            else:
                writer.write("labels", 4, labels)
        frames = self.read(out).sequences()[SCANS].frames("labels").tolist()
        assert frames == ([5] if self.rising else [4, 5])
