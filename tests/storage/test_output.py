from __future__ import annotations

from pathlib import Path

import pytest

from carlasc.errors import StorageError
from carlasc.storage.packed.output import DeferredErrorFile


def test_a_file_that_cannot_be_created_can_be_closed_as_python_does_when_it_forgets_it(
    tmp_path: Path,
) -> None:
    (tmp_path / "folder").write_bytes(b"a file")
    file = DeferredErrorFile.__new__(DeferredErrorFile)
    with pytest.raises(StorageError, match="cannot be written"):
        file.__init__(tmp_path / "folder" / "x.h5", tmp_path / "x.h5")  # type: ignore[misc]
    file.close()
    assert file.closed


def test_ctrl_c_in_a_library_is_raised_afterwards(tmp_path, monkeypatch):
    file = DeferredErrorFile(tmp_path / "a", tmp_path / "b")
    monkeypatch.setattr("carlasc.storage.packed.output.write_at", interrupt)
    assert file.write(b"abc") == 3
    file.close()
    with pytest.raises(KeyboardInterrupt):
        file.check()


def interrupt(*_):
    raise KeyboardInterrupt
