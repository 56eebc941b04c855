"""Random sequences of writes, kills and resumed runs on a store, compared with a model in memory.

They need hypothesis.

See `docs/howto/source.md` for an example. Run the `TestCase` of a subclass with pytest:

    class NpyMachine(StoreMachine):
        reopens = immediate = True

        def sink(self, out): return NpySink(out)
        def read(self, out): return NpySource(out)

    TestNpyMachine = NpyMachine.TestCase
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from carlasc.core.arrays import AnyArray
from carlasc.errors import ConflictError, DependencyError
from carlasc.storage import Sink, Source, layout
from carlasc.storage.protocol import SequenceWriter
from carlasc.testing.data import SCANS, SIZE, WHOLE, grid, lines, params, published_bytes, scan

try:
    from hypothesis import strategies as st
    from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
except ImportError as error:
    raise DependencyError(
        "hypothesis is not installed", advice="install it with `pip install hypothesis`"
    ) from error

Key = tuple[str, str, int]
"""Path of a sequence, field and frame."""

GRID = "evaluation"
PATHS = (WHOLE, SCANS)
FIELDS = ("points", "labels", "flow", f"{GRID}/labels", f"{GRID}/counts")
LAST = 11
"""Largest frame number. Blocks of eight frames have a neighbour."""


class StoreMachine(RuleBasedStateMachine):
    """Writes, overwrites and removes frames, abandons the sink like a killed process, resumes,
    finishes, and compares.

    A subclass defines `sink` and `read`. `model` has all written data; after each `finish`, the
    store must have exactly these data. A resumed run writes the frames that the writer lacks, like
    every command of carlasc.

    Attributes:
        rising: whether the frames of a field must be written in ascending order, so that none can
            be replaced.
        reopens: whether a finished store can be extended. Otherwise, each `finish` is followed by a
            new store.
        immediate: whether a frame survives if its process is killed after `write` has returned.
        ending: suffix of the names of stores.
        model: expected arrays by sequence, field and frame.
        documents: expected text files by sequence and name.
        out: path of the store.
    """

    rising: bool = False
    reopens: bool = False
    immediate: bool = False
    ending: str = ""

    def sink(self, out: Path) -> Sink:
        """Return a sink that writes to `out`: a new store, an abandoned store or, with `reopens`, a
        finished store.
        """
        raise NotImplementedError

    def read(self, out: Path) -> Source:
        """Return a source that reads the finished store."""
        raise NotImplementedError

    def __init__(self) -> None:
        super().__init__()
        self._folder = TemporaryDirectory(prefix="carlasc-machine-")
        self._stores = 0
        self._begin()

    def _begin(self) -> None:
        """Choose a new path for a store."""
        self._stores += 1
        self.out = Path(self._folder.name) / f"store{self._stores}{self.ending}"
        self.model: dict[Key, AnyArray] = {}
        self.documents: dict[tuple[str, str], bytes] = {}
        self._sink: Sink | None = None
        self._writers: dict[str, SequenceWriter] = {}
        # possible arrays of a frame that was replaced before a kill
        self._possible: dict[Key, list[AnyArray]] = {}
        self._killed = False

    def teardown(self) -> None:
        """Remove all stores."""
        self._sink = None
        self._writers = {}
        self._folder.cleanup()

    @rule(
        path=st.sampled_from(PATHS),
        field=st.sampled_from(FIELDS),
        frame=st.integers(0, LAST),
        seed=st.integers(0, 99),
    )
    def write(self, path: str, field: str, frame: int, seed: int) -> None:
        """Write a field of a frame, or replace it."""
        writer = self._writer(path)
        if self.rising and frame <= max(
            (key[2] for key in self.model if key[:2] == (path, field)), default=-1
        ):
            return
        if field.startswith(GRID) and (path, layout.params_file(GRID)) not in self.documents:
            self._write_document(path, layout.params_file(GRID), params(SIZE))
        self._write((path, field, frame), _array(field, frame, seed), writer)

    @rule(path=st.sampled_from(PATHS), count=st.integers(1, 3))
    def write_document(self, path: str, count: int) -> None:
        """Write the times, or replace them."""
        self._writer(path)
        self._write_document(path, layout.TIMES, lines(count)[1])

    @rule(path=st.sampled_from(PATHS))
    def remove_grid(self, path: str) -> None:
        """Remove a grid.

        A store that does not support this raises ConflictError and keeps the grid.
        """
        if (path, layout.params_file(GRID)) not in self.documents:
            return
        try:
            self._writer(path).remove_grid(GRID)
        except ConflictError:
            return
        for key in [key for key in self.model if key[0] == path and key[1].startswith(GRID)]:
            del self.model[key]
            self._possible.pop(key, None)
        del self.documents[path, layout.params_file(GRID)]

    @precondition(lambda self: self._sink is not None)
    @rule()
    def kill(self) -> None:
        """Abandon the sink and its writers without closing them, like a killed process."""
        self._sink = None
        self._writers = {}
        self._killed = True

    @precondition(lambda self: self.model)
    @rule()
    def finish(self) -> None:
        """Write missing data, finish the store, and compare it with the model."""
        if self._sink is None:
            self._resume()
        for writer in self._writers.values():
            writer.close()
        if self._sink is not None:
            self._sink.finish()
        self._sink = None
        self._writers = {}
        self.check()
        self._possible = {}
        if not self.reopens:
            self._begin()

    @invariant()
    def a_writer_has_what_it_wrote(self) -> None:
        """Check `has` of all open writers."""
        for path, writer in self._writers.items():
            for frame in range(LAST + 1):
                assert writer.has("points", frame) == ((path, "points", frame) in self.model)

    def _writer(self, path: str) -> SequenceWriter:
        """Return the writer of a sequence.

        A new sequence gets a scan immediately, because readers may ignore sequences without frames.
        """
        if self._sink is None:
            self._resume()
        if path not in self._writers and self._sink is not None:
            self._writers[path] = self._sink.sequence(path)
            if not any(key[0] == path for key in self.model):
                self._write((path, "points", 0), _array("points", 0, 0), self._writers[path])
        return self._writers[path]

    def _write(self, key: Key, array: AnyArray, writer: SequenceWriter) -> None:
        if not self.immediate and key in self.model:
            self._possible.setdefault(key, []).append(self.model[key])
        writer.write(key[1], key[2], array)
        self.model[key] = array

    def _write_document(self, path: str, name: str, data: bytes) -> None:
        self._writers[path].write_document(name, data)
        self.documents[path, name] = data

    def _resume(self) -> None:
        """Open the store again, and write missing text files, and missing frames in ascending
        order.
        """
        self._sink = self.sink(self.out)
        if not self._killed:
            return
        self._killed = False
        for path in sorted({key[0] for key in self.model}):
            writer = self._writers[path] = self._sink.sequence(path)
            for (_, name), data in [
                (key, data) for key, data in self.documents.items() if key[0] == path
            ]:
                writer.write_document(name, data)
            for _, field, frame in sorted(key for key in self.model if key[0] == path):
                if not writer.has(field, frame):
                    writer.write(field, frame, self.model[path, field, frame])
                    self._possible.pop((path, field, frame), None)

    def check(self) -> None:
        """Compare the finished store with the model. A subclass may add checks."""
        sequences = self.read(self.out).sequences()
        assert set(sequences) == {key[0] for key in self.model}
        keys = {
            (path, field, frame)
            for path, sequence in sequences.items()
            for field in sequence.fields()
            for frame in sequence.frames(field).tolist()
        }
        assert keys == set(self.model)
        for path, field, frame in sorted(keys):
            array = sequences[path].read(field, frame)
            data = published_bytes(field, array)
            allowed = [
                self.model[path, field, frame],
                *self._possible.get((path, field, frame), []),
            ]
            assert data in [published_bytes(field, each) for each in allowed], (path, field, frame)
            self.model[path, field, frame] = np.array(array)
        texts = {
            (path, name): sequences[path].read_document(name)
            for path in sequences
            for name in sequences[path].documents()
        }
        assert texts == self.documents


def _array(field: str, frame: int, seed: int) -> AnyArray:
    """Return a random array of a field.

    All fields of a frame have the same number of points: 0 to 3.
    """
    rng = np.random.default_rng(seed)
    return (
        grid(rng, SIZE)[field.partition("/")[2]]
        if field.startswith(GRID)
        else scan(rng, (frame + 2) % 4)[field]
    )
