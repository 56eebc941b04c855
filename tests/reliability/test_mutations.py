"""Damaged files: a slice of the mutations in fresh processes, and the engine itself on readers with
known faults.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest
from faults import coverage, mutations
from faults.damage import change, damage
from faults.mutations import run_apart, run_target, shares
from faults.targets import TARGETS, Target

from carlasc.errors import FormatError

pytestmark = pytest.mark.posix("limits of memory")

QUICK = ("folder", "zip", "zarr", "parquet", "capture", "results", "kitti", "nuscenes")
SEED = 7


@pytest.mark.slow
def test_a_few_damaged_files_of_the_common_kinds_are_read_or_refused() -> None:
    available = [
        target.name for target in TARGETS if target.name in QUICK and target.is_available()
    ]
    assert (
        run_apart(",".join(available), SEED, 300).count(" 0 kinds of faults") == len(available) >= 6
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", [target.name for target in TARGETS])
def test_damaged_files_of_every_kind_are_read_or_refused(name: str) -> None:
    target = next(target for target in TARGETS if target.name == name)
    if not target.is_available():
        pytest.skip(f"{' or '.join(target.needs)} is not installed")
    assert " 0 kinds of faults" in run_apart(name, SEED, 20 * target.weight)


@pytest.mark.slow
@pytest.mark.needs("atheris")
def test_inputs_that_are_guided_by_coverage_are_read_or_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(coverage, "NAMES", ("capture",))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
    outcome = coverage.run(300, SEED, tmp_path)
    assert (outcome.tried, outcome.found) == (300, [])


def write(root: Path) -> None:
    root.mkdir()
    (root / "a.json").write_text('{"number": 12, "list": [1, 2, 3]}')
    (root / "b.bin").write_bytes(bytes(range(200)))


def reading(look: Callable[[bytes], object]) -> Target:
    """Return a target whose reader gives the bytes of b.bin to a function; the whole file goes
    well.
    """

    def read(root: Path, attempt: mutations.Reading) -> None:
        data = (root / "b.bin").read_bytes() if (root / "b.bin").is_file() else b""
        if data != bytes(range(200)):
            attempt(look, data)  # type: ignore[operator]

    return Target("known", write, read)  # type: ignore[arg-type]


def refuse(data: bytes) -> None:
    raise FormatError("somewhere", expected="something")


def fail(data: bytes) -> None:
    raise TypeError("of another library")


def fill_memory(data: bytes) -> None:
    bytearray(2 << 30)


def die(data: bytes) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def never_end(data: bytes) -> None:
    while True:
        pass


@pytest.mark.parametrize(
    ("look", "expected"),
    [
        (fail, "TypeError [test_mutations.py:"),
        (fill_memory, "MemoryError"),
        (die, "kills the process: SIGKILL"),
        (never_end, "takes more than 0 s"),
        (refuse, "a message that names no file"),
    ],
)
def test_a_reader_with_a_fault_is_found(
    look: Callable[[bytes], object], expected: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if look is fill_memory and not Path("/proc/self/statm").exists():
        pytest.skip("the system does not say how much memory a process has")
    if look is never_end:
        monkeypatch.setattr(mutations, "CASE_S", 0.2)
    tried, found = run_target(reading(look), range(8), SEED, tmp_path)
    assert tried == 8
    assert len(found) == 1 or look is die
    assert expected in found[0]
    assert found[0].startswith(f"known {SEED} ")


def test_a_reader_without_faults_has_none(tmp_path: Path) -> None:
    def look(data: bytes) -> None:
        raise FormatError("b.bin", expected="the numbers 0 to 199")

    assert run_target(reading(look), range(50), SEED, tmp_path) == (50, [])


def test_valid_files_that_are_refused_are_a_fault(tmp_path: Path) -> None:
    target = Target("known", write, lambda root, attempt: attempt(refuse, b""))
    assert "the files cannot be read" in run_target(target, range(5), SEED, tmp_path)[1][0]


def test_a_number_repeats_its_case_and_others_differ() -> None:
    files = {
        "a.json": b'{"a": [1, 2], "b": "c"}',
        "b.npy": b"\x93NUMPY\x01\x00v\x00{'descr': '<f4'}",
        "c.bin": bytes(99),
    }
    cases = [damage(files, Random(f"{number}")) for number in range(50)]
    assert cases == [damage(files, Random(f"{number}")) for number in range(50)]
    assert len({repr(case) for case in cases}) > 40


def test_every_operator_changes_bytes_of_any_kind() -> None:
    for data in (
        b"",
        b"\0",
        b"{}",
        b"[1]",
        b"PK\x03\x04",
        b"\x93NUMPY",
        b"1 2 3\n4 5 6\n",
        bytes(300),
    ):
        assert sum(change(data, Random(number)) != data for number in range(60)) > 15, data


def test_cases_are_divided_by_weight() -> None:
    targets = [
        Target(str(weight), write, lambda root, attempt: None, weight=weight)
        for weight in (1, 2, 7)
    ]
    assert [count for _, count in shares(1003, targets)] == [100, 200, 703]
