"""Extracting zips, which anybody may have made."""

from __future__ import annotations

import shutil
import stat
import zipfile
from pathlib import Path

import pytest
from helpers.errors import raises
from storage.test_downloading import make_zip, names

from carlasc.errors import CarlascError, ConflictError, FormatError
from carlasc.storage import extraction


@pytest.mark.parametrize("name", ["../evil", "/evil", "a/../../evil", "C:/evil", "a\\..\\evil"])
def test_a_name_that_leads_out_of_the_folder_is_refused_before_anything_is_unpacked(
    tmp_path: Path, name: str
) -> None:
    path = tmp_path / "x.zip"
    path.write_bytes(make_zip(0, {"good": 10, name: 10}))
    with pytest.raises(FormatError, match="names inside the folder"):
        extraction.extract_zip(path, tmp_path / "out", lambda _: None)
    assert not (tmp_path / "out").exists()
    assert not (tmp_path / "evil").exists()


def test_a_name_with_a_zero_byte_is_refused_as_it_is_written_in_the_zip(tmp_path: Path) -> None:
    path = tmp_path / "x.zip"
    path.write_bytes(make_zip(0, {"good/evil": 10}).replace(b"good/evil", b"good\0evil"))
    with pytest.raises(FormatError, match=r"names inside the folder, found 'good.x00evil'"):
        extraction.extract_zip(path, tmp_path / "out", lambda _: None)


def test_a_link_in_a_zip_is_refused(tmp_path: Path) -> None:
    path, link = tmp_path / "x.zip", zipfile.ZipInfo("link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(link, "/etc/passwd")
    with raises(FormatError, found="the link"):
        extraction.extract_zip(path, tmp_path / "out", lambda _: None)


def test_a_damaged_member_is_named_and_not_left_half_written(tmp_path: Path) -> None:
    content = bytearray(make_zip(0, {"a": 100, "b": 100}))
    place = content.index(b"PK", 10) + 80  # inside the second file
    content[place] ^= 0xFF
    path = tmp_path / "x.zip"
    path.write_bytes(content)
    with raises(FormatError, where=r"x\.zip/b$", advice="damaged"):
        extraction.extract_zip(path, tmp_path / "out", lambda _: None)
    assert names(tmp_path / "out") == []


def test_extracting_continues_after_an_interruption_and_refuses_other_files(tmp_path: Path) -> None:
    path, out = tmp_path / "x.zip", tmp_path / "out"
    path.write_bytes(make_zip(0, {"a": 100, "b": 200}))
    extraction.extract_zip(path, out, lambda _: None)
    stamp = (out / "a").stat().st_mtime_ns
    (out / "b").unlink()
    assert extraction.extract_zip(path, out, lambda _: None) == 2
    assert (out / "a").stat().st_mtime_ns == stamp
    assert (out / "b").stat().st_size == 200
    (out / "b").write_bytes(b"other")
    with pytest.raises(ConflictError, match="a different file"):
        extraction.extract_zip(path, out, lambda _: None)


def test_extracting_checks_the_space_for_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, out = tmp_path / "x.zip", tmp_path / "out"
    path.write_bytes(make_zip(0, {"a": 100, "b": 200}))
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(extraction.shutil, "disk_usage", lambda _: usage._replace(free=250))
    with pytest.raises(CarlascError, match=r"free space to extract x\.zip"):
        extraction.extract_zip(path, out, lambda _: None)
    assert not out.exists()
    out.mkdir()
    with zipfile.ZipFile(path) as archive:
        (out / "a").write_bytes(archive.read("a"))
    assert extraction.extract_zip(path, out, lambda _: None) == 2
