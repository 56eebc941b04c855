"""What is there already is continued, replaced or left alone, and never mixed."""

import json

import numpy as np
import pytest
from helpers.datasets.captures import make_recording, read_tree, write_capture
from helpers.scenes import passing_car

from carlasc import Run
from carlasc.captures.writing import CaptureWriter
from carlasc.core.grids import GridSpec
from carlasc.errors import ConflictError, FormatError
from carlasc.groundtruth import Voting, regrid
from carlasc.storage import layout

SMALL = GridSpec.published().with_size((32, 32, 4))
GRID = "cartesian/evaluation_32x32x4"


@pytest.fixture
def made(tmp_path):
    """A capture with one grid made of it."""
    write_capture(tmp_path)
    regrid(tmp_path, SMALL, run=Run(workers=1))
    return tmp_path


@pytest.mark.parametrize(
    ("settings", "difference"),
    [
        ({"voting": Voting(free_step_m=0.5)}, "carlasc.free_step_m 1.5 where this run has 0.5"),
        ({"voting": Voting("sample")}, 'carlasc.voting "sensor" where this run has "sample"'),
        ({"frames": (100, 102)}, 'carlasc.frames "100:" where this run has "100:102"'),
        (
            {"spec": SMALL.with_bounds((-9, -9, -2), (9, 9, 1))},
            r"min_bound .* where this run has \[-9.0, -9.0, -2.0\]",
        ),
    ],
)
def test_other_settings_stop_the_run_and_name_the_difference(made, settings, difference):
    before = read_tree(made)
    arguments = {"spec": SMALL} | settings
    spec = arguments.pop("spec")
    with pytest.raises(
        ConflictError, match=f"params.json: .* found {difference}: .*`name`.*`overwrite=True`"
    ):
        regrid(made, spec, run=Run(workers=1), **arguments)
    assert read_tree(made) == before


def test_another_number_of_sensors_stops_the_run(made):
    writer = CaptureWriter(made)
    for frame in (100, 101, 102):
        writer.write(2, frame, make_recording(seed=frame))
    with pytest.raises(ConflictError, match="carlasc.sensors 2 where this run has 3"):
        regrid(made, SMALL, run=Run(workers=1))


def edit_record(made, **changes):
    """Change keys of the record of the grid; None removes a key."""
    path = made / GRID / "params.json"
    params = json.loads(path.read_bytes())
    record = params["carlasc"] | changes
    params["carlasc"] = {key: value for key, value in record.items() if value is not None}
    path.write_text(json.dumps(params))


def test_another_version_of_the_rule_stops_the_run(made):
    edit_record(made, rule=0)
    with pytest.raises(ConflictError, match="carlasc.rule 0 where this run has 1"):
        regrid(made, SMALL, run=Run(workers=1))


def test_a_grid_of_carlasc_0_1_0_is_continued_and_compared(made):
    old = {"version": "0.1.0", "source": "capture", "vote": "sensor"}
    edit_record(made, format=None, rule=None, observe=None, voting=None, **old)
    (made / GRID / "000001.bin").unlink()
    result = regrid(made, SMALL, run=Run(workers=1))
    assert (result.made, result.skipped) == (1, 2)
    edit_record(made, format=None, rule=None, observe=None, voting=None, **old | {"vote": "sample"})
    with pytest.raises(ConflictError, match='carlasc.voting "sample" where this run has "sensor"'):
        regrid(made, SMALL, run=Run(workers=1))


def test_a_grid_that_carlasc_0_1_0_made_from_scans_is_not_continued_since_scans_give_other_grids_now(
    tmp_path,
):
    street = passing_car.write_sequence(tmp_path, frames=4)
    regrid(street, passing_car.SPEC, name="mine", run=Run(workers=1))
    path = street / "cartesian/mine/params.json"
    params = json.loads(path.read_bytes())
    record = {
        key: value for key, value in params["carlasc"].items() if key not in ("format", "rule")
    }
    path.write_text(json.dumps(params | {"carlasc": {"version": "0.1.0", **record}}))
    before = read_tree(street)
    with pytest.raises(ConflictError, match="carlasc.rule 1 where this run has 5"):
        regrid(street, passing_car.SPEC, name="mine", run=Run(workers=1))
    assert read_tree(street) == before
    assert (
        regrid(street, passing_car.SPEC, name="mine", run=Run(workers=1), overwrite=True).made == 4
    )


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("newer", [2, -1, "two"])
def test_a_record_of_a_newer_format_is_refused_with_the_advice_to_upgrade(made, newer, overwrite):
    edit_record(made, format=newer)
    before = read_tree(made)
    with pytest.raises(
        FormatError,
        match=f"params.json: .* format 1 or older, found format {newer}: upgrade carlasc",
    ):
        regrid(made, SMALL, run=Run(workers=1), overwrite=overwrite)
    assert read_tree(made) == before


def test_another_name_takes_other_settings_beside_the_first(made):
    before = read_tree(made)
    regrid(made, SMALL, run=Run(workers=1), voting=Voting(free_step_m=0.5), name="half_metre")
    after = read_tree(made)
    assert before.items() <= after.items()
    assert {name.split("/")[1] for name in set(after) - set(before)} == {"half_metre"}


def test_overwriting_leaves_nothing_of_the_old_grid(made, tmp_path_factory):
    clean = tmp_path_factory.mktemp("clean")
    write_capture(clean)
    regrid(made, SMALL, run=Run(workers=1), voting=Voting(keep=True))
    for root in (made, clean):
        result = regrid(
            root,
            SMALL,
            run=Run(workers=1),
            voting=Voting(free_step_m=0.5),
            frames=(100, 102),
            overwrite=True,
        )
        assert result.made == 2
    ours, theirs = (
        {name: data for name, data in read_tree(root).items() if name.startswith(GRID)}
        for root in (made, clean)
    )
    reports = [json.loads(files.pop(f"{GRID}/{layout.REPORT}")) for files in (ours, theirs)]
    assert ours == theirs
    for report in reports:
        del report["documents"]  # poses.txt has a line for frames that the grid does not have
    assert reports[0] == reports[1]
    assert len(ours) == 5


def test_several_grids_share_their_scans(made):
    before = read_tree(made)
    regrid(made, GridSpec.published().with_size((16, 16, 4)), run=Run(workers=1), frames=(100, 102))
    after = read_tree(made)
    assert before.items() <= after.items()  # poses.txt too: it stays as long as it was
    assert {name.split("/")[1] for name in set(after) - set(before)} == {"evaluation_16x16x4"}


@pytest.mark.parametrize("overwrite", [False, True])
def test_published_data_is_never_written_to(golden_capture, tmp_path, overwrite):
    write_capture(tmp_path)
    folder = tmp_path / "cartesian/evaluation"
    folder.mkdir(parents=True)
    for name in ("params.json", "000000.label", "000000.bin"):
        (folder / name).write_bytes((golden_capture / "cartesian/evaluation" / name).read_bytes())
    before = read_tree(tmp_path)
    with pytest.raises(ConflictError, match=r"evaluation/params.json: .* published data, .*`name`"):
        regrid(tmp_path, GridSpec.published(), run=Run(workers=1), overwrite=overwrite)
    (folder / "params.json").unlink()
    before.pop("cartesian/evaluation/params.json")
    with pytest.raises(ConflictError, match="found frames without one: this is published data"):
        regrid(tmp_path, GridSpec.published(), run=Run(workers=1), overwrite=overwrite)
    assert read_tree(tmp_path) == before


def test_a_published_sequence_takes_another_grid_beside_its_own(golden_capture, tmp_path):
    for name, data in read_tree(golden_capture / "cartesian").items():
        path = tmp_path / "cartesian" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    before = read_tree(tmp_path)
    regrid(golden_capture, SMALL, tmp_path, run=Run(workers=1))
    assert before.items() <= read_tree(tmp_path).items()


@pytest.mark.parametrize("overwrite", [False, True])
def test_scans_of_another_capture_stop_the_run(made, overwrite):
    path = made / "cartesian/velodyne/000001.bin"
    path.write_bytes(b"\0" * len(path.read_bytes()))
    (made / GRID / "000001.bin").unlink()
    with pytest.raises(
        ConflictError,
        match=r"velodyne/000001.bin: expected the data of this run, found other data at frame 1",
    ):
        regrid(made, SMALL, run=Run(workers=1), overwrite=overwrite)
    assert not np.fromfile(path, np.uint8).any()


@pytest.mark.parametrize("document", ["poses.txt", "times.txt"])
def test_poses_and_times_of_another_capture_stop_the_run(made, document):
    path = made / "cartesian" / document
    lines = path.read_text().splitlines()
    lines[1] = "9" + lines[1].lstrip("-")
    path.write_text("\n".join(lines) + "\n")
    before = read_tree(made)
    with pytest.raises(
        ConflictError,
        match=f"{document}: expected the data of this run, found other data at frame 1",
    ):
        regrid(made, GridSpec.published().with_size((16, 16, 4)), run=Run(workers=1))
    assert read_tree(made) == before


def test_the_last_digits_of_poses_may_differ(made):
    path = made / "cartesian/poses.txt"
    poses = np.loadtxt(path) + 1e-13
    np.savetxt(path, poses)
    before = path.read_bytes()
    regrid(made, GridSpec.published().with_size((16, 16, 4)), run=Run(workers=1))
    assert path.read_bytes() == before


def test_a_sequence_in_another_frame_or_of_other_classes_stops_the_run(made):
    (made / "cartesian/carlasc.json").write_text('{"frame": "kitti"}')
    with pytest.raises(
        ConflictError,
        match="carlasc.json: expected the axes left and the classes carla, found right",
    ):
        regrid(made, SMALL, run=Run(workers=1))


def test_a_conflict_in_one_sequence_is_found_before_any_is_written(tmp_path):
    for name in ("a", "b"):
        write_capture(tmp_path / name)
    regrid(tmp_path / "b", SMALL, run=Run(workers=1))
    with pytest.raises(ConflictError, match="b/cartesian"):
        regrid(tmp_path, SMALL, run=Run(workers=1), voting=Voting(free_step_m=0.5))
    assert not (tmp_path / "a/cartesian").exists()


@pytest.mark.parametrize("document", ["poses.txt", "times.txt"])
def test_poses_and_times_may_differ_by_rounding_and_not_by_more(made, document):
    path = made / "cartesian" / document
    values = np.loadtxt(path)
    for difference, accepted in ((9e-7, True), (2e-6, False)):
        np.savetxt(path, values + difference)
        if accepted:
            regrid(made, GridSpec.published().with_size((16, 16, 4)), run=Run(workers=1))
        else:
            with pytest.raises(ConflictError, match=f"{document}: expected the data of this run"):
                regrid(made, GridSpec.published().with_size((8, 8, 4)), run=Run(workers=1))
