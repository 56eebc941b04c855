"""The table of boxes, and its files."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.errors import raises
from numpy.testing import assert_array_equal

from carlasc import Boxes
from carlasc.core.geometry import rotation_z, translation
from carlasc.errors import ArgumentError, FormatError, MissingDataError
from carlasc.motion import BOX_ENDINGS, BoxTable, tracks_from_boxes

ROW = [1.0, -2.0, 0.5, 4.5, 1.8, 1.5, 0.25, 3.0, 0.0, 0.1, 0.75, 4.0, 1.7, 1.5, 6.0, 1.9, np.nan]
TABLE = BoxTable(
    np.array([0.0, 0.1, 0.1]),
    np.array([7, 7, 8]),
    ("Vehicle", "Vehicle", "a, b"),
    np.array([ROW, ROW, ROW]) + np.arange(3)[:, None],
)


@pytest.mark.parametrize("ending", BOX_ENDINGS)
def test_what_is_written_is_read(ending, tmp_path):
    if ending == ".parquet":
        pytest.importorskip("pyarrow")
    TABLE.write(tmp_path / f"boxes{ending}")
    read = BoxTable.read(tmp_path / f"boxes{ending}")
    for name, value in vars(TABLE).items():
        assert_array_equal(getattr(read, name), value)
    if ending != ".parquet":
        assert "nan" not in (tmp_path / f"boxes{ending}").read_text().lower()


def test_velocity_confidence_and_intervals_may_be_absent(tmp_path):
    names = "time number class x y z length width height heading".split()
    row = dict(zip(names, [0.5, 3, "Car", 1, 2, 3, 4, 2, 1, 0], strict=True))
    (tmp_path / "a.json").write_text(json.dumps([row]))
    assert_array_equal(
        BoxTable.read(tmp_path / "a.json").values[0, 7:], [np.nan] * 3 + [1] + [np.nan] * 6
    )


CSV = "time,number,class,x,y,z,length,width,height,heading"


@pytest.mark.parametrize(
    ("text", "where", "found"),
    [
        (f"{CSV}\n", "", "no box"),
        (f"{CSV[5:]}\n1,Car,0,0,0,4,2,1,0\n", "", "time absent"),
        (f"{CSV}\n0,1,Car,0,0,0,4,2,1,0\n0,1,Car,9,0,0,4,2,1,0\n", ": row 2", "[0.0, 1.0, 9.0"),
        (f"{CSV}\n0,1,Car,0,0,0,4,0,1,0\n", ": row 1", "0.0"),
        (f"{CSV}\n0,1,Car,0,0,0,4,nan,1,0\n", ": row 1", "nan"),
        (f"{CSV}\nnan,1,Car,0,0,0,4,2,1,0\n", ": row 1", "nan"),
        (f"{CSV}\n0,1,Car,0,0,zero,4,2,1,0\n", "", "zero"),
        (f"{CSV}\n0,1,Car,0,0,0,4,2\n", "", "height, heading absent"),
    ],
)
def test_bad_tables_are_named(text, where, found, tmp_path):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(FormatError) as error:
        BoxTable.read(tmp_path / "a.csv")
    assert error.value.where == f"{tmp_path / 'a.csv'}{where}"
    assert found in error.value.found and "\n" not in str(error.value)


def test_files_that_are_no_tables_are_named(tmp_path):
    for name, content in (
        ("a.json", b"{"),
        ("b.json", b"[1]"),
        ("c.json", b"3"),
        ("d.csv", b"\xff"),
    ):
        (tmp_path / name).write_bytes(content)
        with raises(FormatError, where=str(tmp_path / name)):
            BoxTable.read(tmp_path / name)
    with raises(MissingDataError, where=str(tmp_path / "e.csv")):
        BoxTable.read(tmp_path / "e.csv")
    with raises(ArgumentError, where="boxes", found=str(tmp_path / "e.txt")):
        BoxTable.read(tmp_path / "e.txt")
    with raises(FormatError, where="row 1"):
        replace(TABLE, values=np.zeros_like(TABLE.values))


def test_boxes_of_tracks_are_placed_in_the_frame_of_the_table():
    turns, sizes = np.tile([1.0, 0, 0, 0], (1, 1)), np.array([[4.0, 2, 1]])
    boxes = {
        frame: Boxes(
            np.array([3], np.uint32),
            np.array([2], np.uint32),
            np.array([[10.0 * frame, 5, 0]]),
            turns,
            sizes,
            np.array([True]),
        )
        for frame in range(5)
    }
    poses, times = dict.fromkeys(boxes, np.eye(4)), {frame: 1.0 * frame for frame in boxes}
    (track,) = tracks_from_boxes(boxes, poses, times)
    table_T_world = translation((0, 0, 1)) @ rotation_z(np.pi / 2)
    frames = {frame: (times[frame], table_T_world) for frame in boxes}
    table = BoxTable.of_tracks({8: track}, frames, {2: "Car"}, left=False)
    assert table.numbers.tolist() == [8] * 5 and table.classes == ("Car",) * 5
    assert np.allclose(table.values[3, :3], [-5, 30, 1], atol=0.1)
    assert np.allclose(table.values[3, 6:10], [np.pi / 2, 0, 10, 0], atol=0.1)
    left = BoxTable.of_tracks({8: track}, frames, {2: "Car"}, left=True, numbers={8: 3})
    assert set(left.numbers.tolist()) == {3}
    assert np.allclose(left.values[3, :3], [-5, -30, 1], atol=0.1)


def test_a_box_is_of_the_frame_that_is_nearest_in_time_and_an_object_has_one_there():
    times = np.array([0.0, 0.03, 0.07, 0.14, 0.2, 0.251, 0.1])
    table = BoxTable(times, np.array([7] * 6 + [8]), ("Car",) * 7, np.array([ROW] * 7))
    frames = np.array([0.0, 0.1, 0.2])
    poses = np.tile(np.eye(4), (3, 1, 1))
    found = table.frames_of(frames, poses, "a.csv", "drive")
    assert found.tolist() == [0, -1, 1, -1, 2, -1, 1]
    with raises(FormatError, where="a.csv", expected="boxes at 1 to 1.2 s", found="0 to 0.251 s$"):
        table.frames_of(frames + 1, poses, "a.csv", "drive")
    poses[:, 0, 3] = 600
    with raises(FormatError, where="a.csv", expected="within 500 m", found="599 m away"):
        table.frames_of(frames, poses, "a.csv", "drive")
