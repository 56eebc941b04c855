"""Data sets of the Hugging Face Hub, read through its real client from a server of this machine."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from helpers.datasets.sequences import FRAMES, files_of, write_dataset
from helpers.errors import raises
from helpers.servers.hub_server import Hub, hub_server
from storage.transport.test_zipped import write_zip
from typer.testing import CliRunner

import carlasc
from carlasc.cli import app
from carlasc.errors import ArgumentError, CarlascError, DependencyError, MissingDataError
from carlasc.storage import FolderSource, Source
from carlasc.storage.transport.remote_tree import RemoteTarget
from carlasc.testing import SourceContract
from carlasc.testing.data import WHOLE

pytest.importorskip("huggingface_hub")
URL = "hf://datasets/lab/town"


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("published") / "data")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hub]:
    """The server, which the client asks instead of the Hub."""
    import fsspec.config
    from huggingface_hub import HfFileSystem

    with hub_server() as hub, pytest.MonkeyPatch.context() as patch:
        patch.setitem(
            fsspec.config.conf,
            "hf",
            {"endpoint": hub.url, "token": False, "use_listings_cache": False},
        )
        hub.folders["lab/town"] = write_dataset(tmp_path_factory.mktemp("hub") / "data")
        yield hub
        HfFileSystem.clear_instance_cache()


@pytest.fixture(autouse=True)
def _fresh(server: Hub) -> None:
    from huggingface_hub import HfFileSystem

    server.faults.clear()
    server.private.clear()
    server.requests.clear()
    HfFileSystem.clear_instance_cache()


def serve(server: Hub, folder: Path) -> str:
    """Serve a folder as a data set of its own; return its URL."""
    name = f"lab/{folder.parent.name}"
    server.folders[name] = folder
    return f"hf://datasets/{name}"


class TestHubFolder(SourceContract):
    processes = ()

    hub: ClassVar[Hub]

    @pytest.fixture(scope="class", autouse=True)
    @classmethod
    def _hub(cls, server: Hub) -> None:
        cls.hub = server

    def build(self, published: Path, folder: Path) -> Source:
        return carlasc.open(serve(self.hub, Path(shutil.copytree(published, folder / "copy"))))


@pytest.mark.parametrize("kind", ["zip", "zarr", "h5", "parquet"])
def test_every_kind_is_read_from_a_data_set(
    server: Hub, published: Path, tmp_path: Path, kind: str
) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    if kind == "zip":
        write_zip(files_of(published), folder / "x.zip")
    else:
        carlasc.pack(published, folder / f"x.{kind}")
    server.folders["lab/packed"] = folder
    found = carlasc.open(f"hf://datasets/lab/packed/x.{kind}").sequences()[WHOLE]
    expected = FolderSource(published).sequences()[WHOLE]
    for field in ("points", "evaluation/labels"):
        frame = int(expected.frames(field)[0])
        assert np.array_equal(found.read(field, frame), expected.read(field, frame))


def test_commands_read_a_data_set(server: Hub, tmp_path: Path) -> None:
    for command in ("info", "stats", "validate"):
        result = CliRunner().invoke(app, [command, URL, "--json"])
        assert '"location": "hf://datasets/lab/town"' in result.stdout, result.output
    result = CliRunner().invoke(app, ["pack", URL, str(tmp_path / "x.zarr")])
    assert result.exit_code == 0, result.output
    assert len(carlasc.open(tmp_path / "x.zarr").sequences()[WHOLE].frames("points")) == len(FRAMES)


def test_the_card_of_a_data_set_of_the_hub_is_written_here(server: Hub, tmp_path: Path) -> None:
    result = CliRunner().invoke(
        app,
        [
            "card",
            URL,
            "-o",
            str(tmp_path / "card"),
            "--license",
            "mit",
            "--draft",
            "--no-pictures",
            "--published",
            "2026-11-22",
        ],
    )
    assert result.exit_code == 0, result.output
    assert 'pretty_name: "town"' in (tmp_path / "card" / "README.md").read_text()


def test_a_revision_and_a_folder_in_a_data_set_are_read(server: Hub) -> None:
    assert set(carlasc.open(f"{URL}@main/{WHOLE}").sequences()) == {""}


def test_a_folder_with_the_name_of_the_data_set_is_listed(
    server: Hub, published: Path, tmp_path: Path
) -> None:
    shutil.copytree(published, tmp_path / "files" / "town")
    server.folders["lab2/town"] = tmp_path / "files"
    assert f"town/{WHOLE}" in carlasc.open("hf://datasets/lab2/town").sequences()


def test_a_cache_fetches_each_file_once(server: Hub, published: Path, tmp_path: Path) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    carlasc.pack(published, folder / "x.zarr")
    server.folders["lab/cached"] = folder
    for _ in range(2):
        server.requests.clear()
        source = carlasc.open("hf://datasets/lab/cached/x.zarr", cache=tmp_path / "cache")
        assert len(source.sequences()[WHOLE].read("points", 5))
        fetched = [path for path in server.requests if "/resolve/" in path and "/points/" in path]
    assert not fetched


def test_requests_that_fail_are_sent_again(server: Hub, published: Path) -> None:
    sequence = carlasc.open(URL).sequences()[WHOLE]
    server.faults += [503, 429, 500]
    assert np.array_equal(
        sequence.read("points", 5), FolderSource(published).sequences()[WHOLE].read("points", 5)
    )
    assert not server.faults


def test_a_whole_file_instead_of_a_range_is_asked_for_again(
    server: Hub, published: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    carlasc.pack(published, folder / "x.h5")
    server.folders["lab/h5"] = folder
    server.faults += [0, 0]
    found = carlasc.open("hf://datasets/lab/h5/x.h5").sequences()[WHOLE].read("points", 5)
    assert np.array_equal(found, FolderSource(published).sequences()[WHOLE].read("points", 5))
    assert not server.faults


def test_a_server_that_keeps_failing_is_one_line(
    server: Hub, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CARLASC_REMOTE_ATTEMPTS", "2")
    sequence = carlasc.open(URL).sequences()[WHOLE]
    server.faults += [503] * 10
    with pytest.raises(
        CarlascError, match="the server failed at each attempt, last with 503: try again later"
    ) as caught:
        sequence.read("points", 5)
    assert caught.value.__cause__ is None
    assert "127.0.0.1" not in str(caught.value)


def test_a_data_set_that_does_not_exist_is_one_line_with_advice(server: Hub) -> None:
    with pytest.raises(
        MissingDataError, match="hf://datasets/lab/nothing: .*check the name; private and gated"
    ):
        carlasc.open("hf://datasets/lab/nothing")
    result = CliRunner().invoke(app, ["info", "hf://datasets/lab/nothing"])
    assert (result.exit_code, len(result.stderr.splitlines())) == (1, 1)


def test_a_private_data_set_needs_a_token_that_no_message_shows(server: Hub) -> None:
    server.private.add("lab/town")
    with pytest.raises(MissingDataError, match="need a token"):
        carlasc.open(URL, token="hf_wrong")
    assert WHOLE in carlasc.open(URL, token="secret").sequences()


def test_a_file_that_is_removed_meanwhile_is_missing(
    server: Hub, published: Path, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(published, tmp_path / "copy"))
    server.folders["lab/copy"] = copy
    sequence = carlasc.open("hf://datasets/lab/copy").sequences()[WHOLE]
    assert 5 in sequence.frames("points").tolist()
    (copy / WHOLE / "velodyne" / "000005.bin").unlink()
    with pytest.raises(MissingDataError, match=r"velodyne/000005\.bin"):
        sequence.read("points", 5)


def test_offline_is_one_line_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    with pytest.raises(CarlascError, match="HF_HUB_OFFLINE is set: unset it"):
        carlasc.open("hf://datasets/lab/never-seen")


def test_nothing_is_written_to_the_hub() -> None:
    with raises(ArgumentError, found="the Hugging Face Hub, where each file would be a commit"):
        RemoteTarget(URL)


def test_a_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(DependencyError, match=r"\[hub\]"):
        carlasc.open(URL)
