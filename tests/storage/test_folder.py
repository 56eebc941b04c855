from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.datasets.sequences import params, write_dataset
from helpers.errors import raises

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
    assert (sequence.split, sequence.name, sequence.coordinates) == (
        "Train",
        "Town01_Light",
        "cartesian",
    )


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


def test_a_path_without_anything_is_an_error(tmp_path: Path) -> None:
    with raises(MissingDataError, found="nothing"):
        carlasc.open(tmp_path / "absent")


def test_a_truncated_scan_names_the_file_and_the_size(data: Path, tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    file = root / WHOLE / "velodyne" / "000005.bin"
    file.write_bytes(file.read_bytes()[:-3])
    with raises(
        FormatError, where=r"000005\.bin", expected="a multiple of 16 bytes", found="16013"
    ):
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


@pytest.mark.parametrize("levels", [1, 2])
def test_sequences_are_found_down_to_four_levels(tmp_path: Path, levels: int) -> None:
    write_dataset(tmp_path.joinpath(*"ab"[:levels]))
    if levels == 1:
        assert len(FolderSource(tmp_path).sequences()) == 3
    else:
        with pytest.raises(MissingDataError):
            FolderSource(tmp_path).sequences()


@pytest.mark.parametrize("folder", [".cache", "raw"])
def test_hidden_folders_and_captures_hold_no_sequences(tmp_path: Path, folder: str) -> None:
    write_dataset(tmp_path / "data")
    (tmp_path / "data" / folder / "velodyne").mkdir(parents=True)
    assert len(FolderSource(tmp_path / "data").sequences()) == 3


def test_a_sequence_that_has_only_a_grid_of_another_size_is_found(tmp_path: Path) -> None:
    writer = FolderSink(tmp_path).sequence(WHOLE)
    writer.write_document("evaluation_8x4x3/params.json", params((8, 4, 3)))
    writer.write("evaluation_8x4x3/labels", 0, np.zeros((8, 4, 3), np.uint32))
    (sequence,) = FolderSource(tmp_path).sequences().values()
    assert sequence.fields() == {"evaluation_8x4x3/labels"}


def test_empty_folders_and_folders_without_params_are_no_fields(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data") / SCANS
    (root / "predictions").mkdir()
    (root / "depth").mkdir()
    (root / "depth" / "000000.label").write_bytes(bytes(4))
    assert FolderSource(root).sequences()[""].fields() == {
        "points",
        "labels",
        "seconds",
        "sensor",
        "origins",
    }


def test_frames_are_sorted_whatever_the_order_of_the_files(tmp_path: Path) -> None:
    frames = [int(number) for number in np.random.default_rng(0).permutation(200)]
    writer = FolderSink(tmp_path).sequence(WHOLE)
    for frame in frames:
        writer.write("labels", frame, np.zeros(1, np.uint32))
    assert FolderSource(tmp_path).sequences()[WHOLE].frames("labels").tolist() == sorted(frames)


def test_a_grid_is_removed_and_other_files_in_its_folder_stay(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    (root / WHOLE / "evaluation" / "notes.txt").write_text("mine")
    FolderSink(root).sequence(WHOLE).remove_grid("evaluation")
    assert [entry.name for entry in (root / WHOLE / "evaluation").iterdir()] == ["notes.txt"]
    fields = FolderSource(root).sequences()[WHOLE].fields()
    assert {"evaluation_8x4x3/labels", "evaluation_8x4x3/occupied"} <= fields
    FolderSink(root).sequence(WHOLE).remove_grid("evaluation_8x4x3")  # it has every optional field
    assert not list((root / WHOLE / "evaluation_8x4x3").iterdir())
    with pytest.raises(FormatError, match="leads out of it"):
        FolderSink(root).sequence(WHOLE).remove_grid("../cartesian/velodyne")


def test_unfinished_files_of_a_killed_run_are_removed_inside_the_sequence_only(
    tmp_path: Path,
) -> None:
    root = write_dataset(tmp_path / "data")
    script = "import sys; from carlasc.storage import files; from pathlib import Path; import os; "
    script += "files.write_atomic(Path(sys.argv[1]), lambda file: os._exit(0))"
    for folder in (root / WHOLE / "velodyne", tmp_path / "elsewhere"):
        subprocess.run([sys.executable, "-c", script, str(folder / "000009.bin")], check=True)
        assert [entry for entry in folder.iterdir() if entry.suffix == ".part"]
    FolderSink(root).sequence(WHOLE)
    assert not [entry for entry in (root / WHOLE / "velodyne").iterdir() if entry.suffix == ".part"]
    with pytest.raises(FormatError, match="leads out of it"):
        FolderSink(root).sequence("../elsewhere")
    assert list((tmp_path / "elsewhere").iterdir())


@pytest.mark.posix("pipes")
def test_a_pipe_and_a_device_are_no_scans(tmp_path):
    folder = tmp_path / "Train" / "Town01_Light" / "cartesian" / "velodyne"
    folder.mkdir(parents=True)
    os.mkfifo(folder / "000000.bin")  # opening it would wait for a writer
    (folder / "000001.bin").symlink_to("/dev/zero")
    (sequence,) = FolderSource(tmp_path).sequences().values()
    for frame in (0, 1):
        with pytest.raises(
            FormatError,
            match=rf"00000{frame}\.bin: expected a file, found a folder, a pipe or a device",
        ):
            sequence.read("points", frame)


@pytest.mark.parametrize("value", ["nan", "inf", "1.7e18"])
def test_a_frame_whose_time_or_pose_is_no_number_is_refused_alone(
    tmp_path: Path, value: str
) -> None:
    root = write_dataset(tmp_path)
    folder = next(root.rglob(WHOLE))
    for name in ("times.txt", "poses.txt"):
        first, second, *rest = (folder / name).read_text().splitlines()
        wrong = f"{second.rpartition(' ')[0]} {value}"
        (folder / name).write_text("\n".join([first, wrong, *rest]) + "\n")
    (sequence,) = FolderSource(folder).sequences().values()
    assert np.isfinite(sequence.read_pose(0)).all()
    assert np.isfinite(sequence.read_time(0))
    with pytest.raises(
        FormatError,
        match=f"times.txt: line 2: expected times in seconds, below .*, found {value[:3]}",
    ):
        sequence.read_time(1)
    if value != "1.7e18":
        with raises(
            FormatError,
            where="poses.txt: line 2",
            expected="finite numbers",
            found="NaN or infinity",
        ):
            sequence.read_pose(1)
