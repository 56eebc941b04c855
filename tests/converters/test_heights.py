"""Sensors that are higher or lower than CarlaSC's: grids follow the ground, or a note says what is
below them.
"""

import numpy as np
import pytest
from helpers.converters.drive_converter import DriveConverter

import carlasc
from carlasc.converting import LayoutOptions, Sensor, convert
from carlasc.core import GridSpec, translation
from carlasc.groundtruth import FromScans, GridOptions
from carlasc.groundtruth.options import fit_to_ground, fit_to_reach, share_below
from carlasc.motion import MotionOptions
from carlasc.motion.ground import find_ground
from carlasc.running import Run
from carlasc.testing import SimulatedDrive

COARSE = GridSpec.published()
ALONE = FromScans(window=(0, 0), motion=MotionOptions("none"))


def drive_at(height_m):
    class Mounted(DriveConverter):
        drive = SimulatedDrive(frames=2, sensors=(Sensor("lidar", translation((0, 0, height_m))),))

    return Mounted


def converted(height_m, tmp_path, follow_ground=True):
    (tmp_path / "drive").mkdir()
    result = convert(
        drive_at(height_m),
        tmp_path / "drive",
        tmp_path / "out",
        layout=LayoutOptions(axes="right"),
        grids=GridOptions(observe=ALONE, follow_ground=follow_ground),
        run=Run(workers=1),
    )
    (sequence,) = carlasc.open(tmp_path / "out").sequences().values()
    (name,) = sequence.grids
    return (
        sequence,
        name,
        [note for note in result.notes if "below the grid" in note or "grids reach" in note],
    )


@pytest.mark.parametrize("height_m", [1.5, 1.73, 1.8])
def test_grids_keep_the_published_bounds_where_the_ground_is_in_them(height_m, tmp_path):
    sequence, name, notes = converted(height_m, tmp_path)
    assert (name, notes) == ("evaluation", [])
    assert sequence.metadata.extra["sensors"][0]["height_m"] == pytest.approx(height_m, abs=0.02)
    assert sequence.metadata.extra["sensors"][0]["height_from"] == "ground"


@pytest.mark.parametrize("height_m", [2.1, 2.6, 0.6])
def test_grids_follow_the_ground_by_whole_voxels(height_m, tmp_path):
    sequence, name, notes = converted(height_m, tmp_path)
    spec = sequence.grids[name]
    assert spec.size == COARSE.size and np.allclose(spec.voxel_size, COARSE.voxel_size)
    assert spec.lower[2] <= -height_m < spec.lower[2] + 2 * spec.voxel_size[2]
    layers = (spec.lower[2] + 2) / spec.voxel_size[2]
    assert layers == round(layers) != 0
    assert len(notes) == 1 and f"the sensor is {height_m:.2f} m above the ground" in notes[0]
    assert (sequence.grid(name, 1).labels[..., :2] == 7).sum() > 500  # the road is in it


def test_all_recordings_of_a_run_get_the_same_grid(tmp_path):
    class Two(DriveConverter):
        def sequences(self):
            found = [drive_at(height_m)(self.source).sequences()[0] for height_m in (1.7, 2.6)]
            found[1].name = "DRIVE_1"
            return found

    (tmp_path / "in").mkdir()
    result = convert(
        Two,
        tmp_path / "in",
        tmp_path / "out",
        layout=LayoutOptions(axes="right"),
        grids=GridOptions(observe=ALONE),
        run=Run(workers=1),
    )
    grids = [sequence.grids for sequence in carlasc.open(tmp_path / "out").sequences().values()]
    assert len(grids) == 2 and grids[0] == grids[1]
    ((spec,),) = (one.values() for one in grids[:1])
    assert spec.lower[2] < -2.6
    (note,) = [note for note in result.notes if "grids reach" in note]
    assert note.startswith(f"{tmp_path / 'out'}: the sensors are 1.70 to 2.60 m above the ground")


def test_bounds_that_are_given_are_kept_and_a_note_says_what_is_below(tmp_path):
    sequence, name, notes = converted(2.6, tmp_path, follow_ground=False)
    assert name == "evaluation"
    assert (
        len(notes) == 1
        and "100% of the points on the ground are below the grid, which begins at -2 m" in notes[0]
    )
    assert not (sequence.grid(name, 1).labels == 7).any()


@pytest.mark.parametrize(("up", "said"), [(1.0, True), (30.0, False)])
def test_a_note_says_what_share_of_the_points_is_above_the_grid(up, said, tmp_path):
    (tmp_path / "drive").mkdir()
    spec = GridSpec("cartesian", (16, 16, 8), (-25.6, -25.6, -2.0), (25.6, 25.6, up))
    grids = GridOptions(spec, observe=ALONE, follow_ground=False)
    result = convert(
        drive_at(1.8), tmp_path / "drive", tmp_path / "out", grids=grids, run=Run(workers=1)
    )
    notes = [note for note in result.notes if "above it" in note]
    assert len(notes) == said
    if said:
        (sequence,) = carlasc.open(tmp_path / "out").values()
        points = np.concatenate([sequence.scan(frame).points for frame in sequence])
        heights = points[(np.abs(points[:, :2]) < 25.6).all(axis=1), 2]
        share = f"{100 * np.mean(heights >= up):.0f}%"
        assert notes[0].startswith(
            f"{tmp_path / 'out'}: {share} of the points between the sides of the grid are above it "
            f"(z > 1 m)"
        )


def test_a_regrid_says_what_is_below_its_grid(tmp_path):
    sequence, _, _ = converted(2.6, tmp_path)
    result = carlasc.regrid(
        sequence.location, COARSE, tmp_path / "more", observe=ALONE, run=Run(workers=1)
    )
    assert any(
        "100% of the points on the ground are below the grid" in note for note in result.notes
    )
    lower = GridSpec("cartesian", COARSE.size, (-25.6, -25.6, -2.75), (25.6, 25.6, 0.25))
    result = carlasc.regrid(
        sequence.location, lower, tmp_path / "lower", observe=ALONE, run=Run(workers=1)
    )
    assert not any("below the grid" in note for note in result.notes)


def test_no_ground_is_no_height():
    assert find_ground([], 25.0) is None
    assert find_ground([np.full((200, 4), np.nan, np.float32)], 25.0) is None
    wall = np.random.default_rng(0).uniform((5, -10, -1), (5.1, 10, 3), (500, 3)).astype(np.float32)
    ground = find_ground([wall], 25.0)
    assert ground is None or share_below(ground, COARSE) == 0
    assert ground is None or fit_to_ground(COARSE, ground).size == COARSE.size


@pytest.mark.parametrize(
    ("spec", "reach_m", "size", "side_m"),
    [
        (COARSE, 5.0, (128, 128, 32), 6.4),
        (COARSE, 12.0, (128, 128, 16), 12.8),
        (COARSE, 13.0, COARSE.size, 25.6),
        (COARSE.with_resolution(0.2), 5.0, (64, 64, 15), 6.4),
        (GridSpec.published("fine"), 5.0, (256, 256, 16), 25.6),
        (GridSpec.published("cylindrical"), 5.0, (128, 128, 8), 30.0),
    ],
)
def test_grids_fit_the_reach_of_the_points_of_a_room(spec, reach_m, size, side_m):
    fitted = fit_to_reach(spec, reach_m)
    assert fitted.size == size
    assert fitted.upper[0] == pytest.approx(side_m)
    assert fitted.lower[2] == spec.lower[2] and fitted.upper[2] == pytest.approx(spec.upper[2])
