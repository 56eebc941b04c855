"""Checks of the fields that say how certain a grid is: one wrong value at a time."""

import json

import numpy as np
import pytest

import carlasc
from carlasc.core import GridSpec, VoxelFlag
from carlasc.inspection.contents import check_frames, check_values
from carlasc.storage import FolderSink, FolderSource, field_files, layout

SPEC = GridSpec("cartesian", (2, 2, 2), (-2.0, -2.0, -1.0), (2.0, 2.0, 1.0))


def table(*rows: tuple[int, int, int]) -> np.ndarray:
    return np.array(list(rows), field_files.VOTES_DTYPE)


@pytest.fixture
def writer(tmp_path):
    """A sound frame of a grid with everything that says how certain it is."""
    writer = FolderSink(tmp_path / "data").sequence("cartesian")
    writer.write_document(layout.params_file("evaluation"), json.dumps(SPEC.to_params()).encode())
    writer.write("evaluation/labels", 0, np.full(SPEC.size, 7, np.uint32))
    writer.write("evaluation/counts", 0, np.ones(SPEC.size, np.float32))
    writer.write("evaluation/occupied", 0, np.linspace(0, 1, 8).reshape(SPEC.size))
    # three thirds, each rounded up, are one step more than 1
    writer.write(
        "evaluation/classes", 0, table((0, 7, 65535), (7, 1, 21845), (7, 7, 21846), (7, 10, 21845))
    )
    writer.write("evaluation/flags", 0, np.full(SPEC.size, sum(VoxelFlag), np.uint8))
    writer.write("evaluation/views", 0, np.full(SPEC.size, 65535, np.uint16))
    return writer


def findings(check, writer, *arguments):
    (sequence,) = FolderSource(writer.target.folder.parent).sequences().values()
    return [(f.severity, f.check, str(f)) for f in check(sequence, *arguments)]


def test_a_sound_grid_has_no_findings(writer):
    assert findings(check_values, writer, 0) == []
    assert findings(check_frames, writer) == []


@pytest.mark.parametrize(
    ("part", "array", "message"),
    [
        (
            "occupied",
            np.full(8, 1.25),
            "000000.occupied.bin: expected probabilities of 0 to 1, found 1.25, and 7 other",
        ),
        ("occupied", np.array([0.5, -0.1, np.nan, 1, 0, 0, 0, 0]), "found -0.0999756, and 1 other"),
        (
            "flags",
            np.array([15, 16, 255, 0, 0, 0, 0, 0], np.uint8),
            "expected flags of 0 to 15, found 16, and 1 other",
        ),
        (
            "classes",
            table((0, 7, 1), (8, 7, 1)),
            "expected voxels 0 to 7, found 8, and 0 other such rows",
        ),
        ("classes", table((-1, 7, 1)), "found -1, and 0 other such rows"),
        (
            "classes",
            table((0, 24, 1), (0, 0, 1)),
            "expected class ids of carla other than 0, found 24, and 1 other",
        ),
        (
            "classes",
            table((2, 7, 65535), (2, 8, 5)),
            "at most 65535 per voxel, found 65540 in voxel 2, and 0 other",
        ),
    ],
)
def test_values_out_of_range_are_errors(writer, part, array, message):
    shape = array if array.dtype.names else array.reshape(SPEC.size)
    writer.write(f"evaluation/{part}", 0, shape)
    ((severity, check, text),) = findings(check_values, writer, 0)
    assert (severity, check) == ("error", "evidence")
    assert message in text


def test_a_frame_without_one_of_the_fields_is_an_error_where_others_have_it(writer):
    writer.write("evaluation/labels", 1, np.full(SPEC.size, 7, np.uint32))
    writer.write("evaluation/counts", 1, np.ones(SPEC.size, np.float32))
    found = findings(check_frames, writer)
    assert [(severity, check) for severity, check, _ in found] == [("error", "frame-counts")] * 4
    assert all(
        any(f"evaluation/{part}" in text for *_, text in found) for part in layout.EVIDENCE_FIELDS
    )


def test_info_names_the_fields(writer):
    (sequence,) = carlasc.info(writer.target.folder.parent).sequences
    assert sequence.grids[0].parts == ("labels", "counts", "occupied", "classes", "flags", "views")
