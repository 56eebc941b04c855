"""Hostile files, stores and servers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from faults.hostile import Case, run, try_case
from helpers.processes.fresh import in_fresh_process

pytest.importorskip("h5py")


@pytest.mark.slow
def test_a_quarter_of_the_cases_does_no_harm(tmp_path: Path) -> None:
    outcome = in_fresh_process(run, 130, 2, tmp_path)  # `make faults` tries all
    assert outcome.found == []
    assert outcome.tried == 130


def shout() -> None:
    raise ValueError("\x1b[2J")


def write_outside() -> None:
    Path("../elsewhere.txt").write_text("mine")


def overwrite() -> None:
    Path("../victim.txt").write_text("theirs")
    raise SystemExit(1)


def show_a_secret() -> None:
    Path("out.txt").write_bytes(Path("../secret.txt").read_bytes())
    raise SystemExit(1)


def take_memory() -> None:
    bytearray(3 << 30)


@pytest.mark.parametrize(
    ("read", "message"),
    [
        (shout, "exit code 70"),
        (write_outside, "wrote outside: open"),
        (overwrite, "victim.txt was changed"),
        (show_a_secret, "out.txt contains"),
        (take_memory, "MemoryError"),
        (lambda: None, "exit code 0"),
        (lambda: print("\x1b[2J"), "was printed"),
    ],
)
def test_harm_is_seen(tmp_path: Path, read: Callable[[], object], message: str) -> None:
    found = try_case(Case("harm", lambda work: None, "", "x.zip", read=read), tmp_path)
    assert any(message in line for line in found)
