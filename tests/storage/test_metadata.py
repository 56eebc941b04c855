import json

import pytest
from helpers.errors import raises

from carlasc.core.classes import ClassTable
from carlasc.core.tables import CARLA, SEMANTICKITTI
from carlasc.errors import FormatError
from carlasc.storage import FolderSource, Metadata
from carlasc.storage.layout import FORMAT

LAB = ClassTable(
    "lab", {0: "none", 300: "floor"}, {0: (0, 0, 0), 300: (1, 2, 3)}, ground=frozenset({300})
)


@pytest.mark.parametrize(
    "metadata",
    [
        Metadata(),
        Metadata("right", SEMANTICKITTI, "a LiDAR", 2.5, 70, "elsewhere", {"poses": "file"}),
        Metadata("left", LAB, extra={"more": [1, 2]}),
    ],
)
def test_metadata_come_back(metadata):
    assert Metadata.from_json(metadata.to_json(), "carlasc.json") == metadata


def test_metadata_are_written_in_this_version_of_the_format():
    assert json.loads(Metadata("right").to_json()) == {
        "format": FORMAT,
        "axes": "right",
        "classes": "carla",
    }
    assert json.loads(Metadata(classes=LAB).to_json())["classes"] == LAB.to_dict()


@pytest.mark.parametrize(
    ("values", "axes"),
    [
        ({}, "left"),
        ({"frame": "carlasc"}, "left"),
        ({"frame": "kitti"}, "right"),
        ({"format": 1, "frame": "kitti"}, "right"),
        ({"axes": "right"}, "right"),
        ({"format": 2, "axes": "right"}, "right"),
        ({"format": 2}, "left"),
        ({"frame": "kitti", "axes": "right"}, "right"),
    ],
)
def test_axes_are_read_from_this_version_and_the_one_before(values, axes):
    metadata = Metadata.from_json(json.dumps(values).encode(), "carlasc.json")
    assert metadata == Metadata(axes)
    assert metadata.classes is CARLA


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"format": 3},
            "c.json: expected format 2 or older, found format 3: upgrade carlasc to read it",
        ),
        ({"format": 0}, "c.json: expected an integer above 0 in format, found 0"),
        ({"format": "2"}, "c.json: expected an integer above 0 in format, found '2'"),
        ({"format": True}, "c.json: expected an integer above 0 in format, found True"),
        ({"frame": "left"}, "c.json: expected carlasc or kitti in frame, found 'left'"),
        ({"axes": "kitti"}, "c.json: expected left or right in axes, found 'kitti'"),
        (
            {"frame": "kitti", "axes": "left"},
            "c.json: expected the axes right, as frame kitti says, found left",
        ),
        ({"classes": "lab"}, "c.json: classes: expected one of carla, .*found 'lab'"),
        ({"classes": {"name": "lab"}}, "c.json: classes: expected the key 'names', found name"),
        ({"min_range_m": "3"}, "c.json: expected a number of metres in min_range_m, found '3'"),
        ({"max_range_m": -1}, "c.json: expected a number of metres in max_range_m, found -1"),
        ([], "c.json: expected a JSON object, found list"),
    ],
)
def test_damaged_and_newer_files_are_named(values, message):
    with pytest.raises(FormatError, match=f"^{message}"):
        Metadata.from_json(json.dumps(values).encode(), "c.json")


@pytest.mark.parametrize("classes", ["carlasc11", LAB.to_dict()])
def test_a_grid_may_have_classes_of_its_own(tmp_path, classes):
    folder = tmp_path / "cartesian"
    (folder / "evaluation_own").mkdir(parents=True)
    params = {
        "grid_size": [1, 1, 1],
        "min_bound": [0, 0, 0],
        "max_bound": [1, 1, 1],
        "coordinates": "cartesian",
    }
    (folder / "evaluation_own/params.json").write_text(
        json.dumps(params | {"carlasc": {"classes": classes}})
    )
    (folder / "evaluation_own/000000.label").write_bytes(bytes(4))
    (sequence,) = FolderSource(folder).sequences().values()
    assert sequence.classes_of("evaluation_own").name == (
        classes if isinstance(classes, str) else "lab"
    )
    (folder / "evaluation_own/params.json").write_text(
        json.dumps(params | {"carlasc": {"format": 9, "classes": classes}})
    )
    (sequence,) = FolderSource(folder).sequences().values()
    with raises(
        FormatError,
        where="evaluation_own/params.json: carlasc",
        expected="format 2 or older",
        found="format 9",
    ):
        sequence.classes_of("evaluation_own")
