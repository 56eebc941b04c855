from __future__ import annotations

from pathlib import Path

import pytest
from helpers.sequences import write_dataset

import carlasc
from carlasc.errors import FormatError, MissingDataError
from carlasc.storage import FolderSink, FolderSource, Sink, Source
from carlasc.testing import SinkContract, SourceContract
from carlasc.testing.data import SCANS, WHOLE


class TestFolderSource(SourceContract):
    def build(self, published: Path, folder: Path) -> Source:
        return FolderSource(published)


class TestFolderSink(SinkContract):
    rising = False

    def sink(self, out: Path) -> Sink:
        return FolderSink(out)

    def read(self, out: Path) -> Source:
        return FolderSource(out)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("a") / "wrapped" / "CarlaSC")


@pytest.mark.parametrize("up", [1, 0])
def test_a_folder_around_the_root_is_understood(data: Path, up: int) -> None:
    root = data.parent if up else data
    assert len(FolderSource(root).sequences()) == 3


@pytest.mark.parametrize("level", ["Train", "Train/Town01_Light", WHOLE])
def test_a_split_a_sequence_or_its_coordinates_folder_is_understood(data: Path, level: str) -> None:
    (sequence,) = FolderSource(data / level).sequences().values()
    assert (sequence.split, sequence.name, sequence.coordinates) == ("Train", "Town01_Light", "cartesian")


@pytest.mark.parametrize("folder", ["velodyne", "evaluation", "bev"])
def test_a_root_one_level_too_low_says_which_is_meant(data: Path, folder: str) -> None:
    with pytest.raises(MissingDataError, match="give the folder above"):
        FolderSource(data / WHOLE / folder).sequences()


def test_a_folder_of_zips_says_to_give_one_of_them(tmp_path: Path) -> None:
    (tmp_path / "val_cartesian.zip").write_bytes(b"")
    with pytest.raises(MissingDataError, match=r"val_cartesian\.zip: give one"):
        FolderSource(tmp_path).sequences()


def test_an_empty_folder_says_what_was_looked_for(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match=r"velodyne.*Train, Val and Test"):
        FolderSource(tmp_path).sequences()


def test_a_capture_without_grids_says_what_to_run(tmp_path: Path) -> None:
    (tmp_path / "raw").mkdir()
    with pytest.raises(MissingDataError, match="carlasc regrid"):
        FolderSource(tmp_path).sequences()


def test_nothing_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match="found nothing"):
        carlasc.open(tmp_path / "absent")


def test_a_scan_cut_short_names_the_file_and_the_size(data: Path, tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    file = root / WHOLE / "velodyne" / "000005.bin"
    file.write_bytes(file.read_bytes()[:-3])
    with pytest.raises(FormatError, match=r"000005\.bin: expected a multiple of 16 bytes.*found 16013"):
        FolderSource(root).sequences()[WHOLE].read("points", 5)


def test_a_missing_poses_file_is_missed_only_when_it_is_asked_for(data: Path) -> None:
    sequence = FolderSource(data).sequences()[SCANS]
    assert len(sequence.read("points", 0)) == 50
    with pytest.raises(MissingDataError, match=r"poses\.txt"):
        sequence.read_pose(0)


def test_poses_shorter_than_the_scans_name_both_counts(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    poses = root / WHOLE / "poses.txt"
    poses.write_text("".join(poses.read_text().splitlines(keepends=True)[:2]))
    with pytest.raises(FormatError, match=r"4 frames.*found 2"):
        FolderSource(root).sequences()[WHOLE].read_pose(5)


def test_unknown_files_are_listed(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    (root / WHOLE / "notes.txt").write_text("mine")
    (root / WHOLE / "depth").mkdir()
    (root / WHOLE / "velodyne" / "index.txt").write_text("mine")
    sequence = FolderSource(root).sequences()[WHOLE]
    assert sequence.unknown_files() == ("depth/", "notes.txt", "velodyne/index.txt")
