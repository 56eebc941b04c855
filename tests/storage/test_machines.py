"""Random sequences of writes, kills, resumed runs, packing and regridding on every store."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from numpy.typing import NDArray

from carlasc import Run

pytest.importorskip("hypothesis")

from hypothesis import Phase, settings
from hypothesis.stateful import run_state_machine_as_test

import carlasc
from carlasc.core.grids import GridSpec
from carlasc.groundtruth import FromGrid
from carlasc.storage import FolderSink, Sink, Source
from carlasc.storage.copying import unpack
from carlasc.storage.folder import FolderWriter
from carlasc.storage.opening import open_sink
from carlasc.storage.packing import pack
from carlasc.testing.data import published_bytes
from carlasc.testing.machines import GRID, StoreMachine

ENDINGS = (".zarr", ".h5", ".parquet")
COARSE = GridSpec("cartesian", (2, 3, 1), (-25.6, -3.0, -2.0), (25.6, 3.0, 1.0))


class CarlascMachine(StoreMachine):
    """Packs, unpacks and regrids every finished store, too."""

    def sink(self, out: Path) -> Sink:
        return open_sink(out, None, False) if self.ending else FolderSink(out)

    def read(self, out: Path) -> Source:
        return carlasc.open(out)

    def check(self) -> None:
        super().check()
        with TemporaryDirectory(dir=self.out.parent) as folder:
            self._pack_and_unpack(Path(folder))
            self._regrid(Path(folder))

    def _pack_and_unpack(self, folder: Path) -> None:
        packed = folder / f"packed{ENDINGS[len(self.model) % len(ENDINGS)]}"
        pack(self.out, packed, run=Run(workers=1))
        unpack(packed, folder / "unpacked", run=Run(workers=1))
        assert contents(packed) == contents(folder / "unpacked") == contents(self.out)

    def _regrid(self, folder: Path) -> None:
        """Make coarser grids from the store, and compare them with those from plain files of the
        same arrays.
        """
        whole = {
            path
            for path, field, frame in self.model
            if field == f"{GRID}/labels" and (path, f"{GRID}/counts", frame) in self.model
        }
        if not whole or whole != {
            path for path, name in self.documents if name == f"{GRID}/params.json"
        }:
            return  # regrid refuses a sequence with a grid of no whole frame
        sink = FolderSink(folder / "plain")
        for (path, name), data in self.documents.items():
            sink.sequence(path).write_document(name, data)
        for (path, field, frame), array in self.model.items():
            sink.sequence(path).write(field, frame, array)
        for source, out in ((folder / "plain", folder / "wanted"), (self.out, folder / "made")):
            carlasc.regrid(
                source, COARSE, out, observe=FromGrid(GRID), name="coarse", run=Run(workers=1)
            )
        assert contents(folder / "made") == contents(folder / "wanted")


# add Phase.shrink to see the shortest sequence that fails, which takes minutes
PHASES = (Phase.generate,)
MACHINES: dict[str, dict[str, Any]] = {
    "": {"reopens": True, "immediate": True},
    ".zarr": {"reopens": True},
    ".h5": {"rising": True},
    ".parquet": {"rising": True},
}


def run(ending: str, examples: int) -> None:
    machine = type("Machine", (CarlascMachine,), {"ending": ending, **MACHINES[ending]})
    chosen = settings(
        max_examples=examples,
        stateful_step_count=15,
        derandomize=True,
        database=None,
        phases=PHASES,
    )
    run_state_machine_as_test(machine, settings=chosen)


@pytest.mark.slow
@pytest.mark.parametrize("ending", MACHINES)
def test_a_store_has_what_a_model_in_memory_has_after_kills_and_resumed_runs(ending: str) -> None:
    run(ending, 6)


@pytest.mark.slow
@pytest.mark.parametrize("ending", MACHINES)
def test_a_store_has_what_a_model_in_memory_has_after_many_kills_and_resumed_runs(
    ending: str,
) -> None:
    run(ending, 100)


class ForgetfulWriter(FolderWriter):
    """Does not replace what exists."""

    def write(self, field: str, frame: int, array: NDArray[Any]) -> None:
        if not self.has(field, frame):
            super().write(field, frame, array)


class ForgetfulSink(FolderSink):
    def sequence(self, path: str) -> ForgetfulWriter:
        return ForgetfulWriter(super().sequence(path).target)


class ForgetfulMachine(StoreMachine):
    reopens = immediate = True

    def sink(self, out: Path) -> Sink:
        return ForgetfulSink(out)

    def read(self, out: Path) -> Source:
        return carlasc.open(out)


def test_a_store_that_does_not_replace_frames_is_found_out() -> None:
    chosen = settings(max_examples=100, derandomize=True, database=None, phases=PHASES)
    with pytest.raises(AssertionError):
        run_state_machine_as_test(ForgetfulMachine, settings=chosen)


def contents(place: Path) -> dict[tuple[str, str, int], bytes]:
    return {
        (path, field, frame): published_bytes(field, sequence.read(field, frame))
        for path, sequence in carlasc.open(place).sequences().items()
        for field in sequence.fields()
        for frame in sequence.frames(field).tolist()
    }
