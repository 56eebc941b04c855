"""Forecasts: grids of frames ahead, scored by how far ahead they are."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import carlasc
from carlasc import GridSpec, Scoring
from carlasc.cli import app
from carlasc.core import translation
from carlasc.errors import ArgumentError, CarlascError, MissingDataError
from carlasc.metrics import evaluate_forecasts, moved_grid
from carlasc.storage import FolderSink, layout

SPEC = GridSpec("cartesian", (10, 8, 2), (-5.0, -4.0, -1.0), (5.0, 4.0, 1.0))
PATH = "Val/Town01/cartesian"
FRAMES, SECONDS = 6, 0.5


def write(folder, grids, pose=lambda frame: translation((frame, 0, 0)), times=True):
    """Write grids, {name: {frame: labels, counts}}, of a vehicle that drives one voxel in every
    frame of half a second.
    """
    writer = FolderSink(folder).sequence(PATH)
    if pose is not None:
        poses = [pose(frame)[:3].reshape(-1) for frame in range(FRAMES)]
        writer.write_document(
            layout.POSES, "".join(" ".join(map(str, row)) + "\n" for row in poses).encode()
        )
    if times:
        seconds = "".join(f"{SECONDS * f + 0.01 * (f % 2)}\n" for f in range(FRAMES))
        writer.write_document(layout.TIMES, seconds.encode())
    for name, frames in grids.items():
        writer.write_document(layout.params_file(name), json.dumps(SPEC.to_params()).encode())
        for frame, grid in frames.items():
            writer.write(f"{name}/labels", frame, grid.labels.astype(np.uint32))
            writer.write(f"{name}/counts", frame, grid.counts)
    return folder


@pytest.fixture
def world():
    """Six frames of a town that changes, by number."""
    grids = {}
    for frame in range(FRAMES):
        rng = np.random.default_rng(frame)
        labels = np.where(rng.random(SPEC.size) < 0.3, rng.integers(1, 11, SPEC.size), 0).astype(
            np.uint8
        )
        grids[frame] = carlasc.Grid(SPEC, labels, (rng.random(SPEC.size) < 0.9).astype(np.float32))
    return grids


@pytest.fixture
def truth(tmp_path, world):
    return write(tmp_path / "truth", {"evaluation": world})


def exact(world, steps):
    """Return what is known in each frame of the grid some frames later, in the frame's own axes."""
    return {
        f: moved_grid(world[f + steps], translation((steps, 0, 0))) for f in range(FRAMES - steps)
    }


def score(source, truth, **options):
    return evaluate_forecasts(source, truth, convention="own", **options)


def test_a_forecast_that_comes_true_is_perfect_in_the_axes_of_its_own_frame(tmp_path, truth, world):
    source = write(
        tmp_path / "a",
        {"net_0.5s": exact(world, 1), "net_1.0s": exact(world, 2), "evaluation": world},
    )
    found = score(source, truth)
    assert list(found) == [0.5, 1.0]
    assert [result.frames for result in found.values()] == [5, 4]  # the others have no later frame
    assert all(result.matrix.accuracy == 1 and not result.failures for result in found.values())
    assert score(source, truth, frames="2:4")[0.5].frames == 2
    assert found[1.0].matrix.total == sum(
        int(grid.known.sum()) for grid in exact(world, 2).values()
    )
    assert score(source, truth, around="future")[0.5].matrix.accuracy < 0.9


def test_forecasts_around_the_future_sensor_need_no_poses(tmp_path, world):
    bare = write(tmp_path / "bare", {"evaluation": world}, pose=None)
    source = write(tmp_path / "a", {"net_0.5s": {f: world[f + 1] for f in range(FRAMES - 1)}})
    assert score(source, bare, around="future")[0.5].matrix.accuracy == 1
    with pytest.raises(MissingDataError, match=r"expected poses.txt, which moves .*around=future"):
        score(source, bare)


def test_to_repeat_the_present_is_worse_the_farther_ahead(tmp_path, world):
    """A block that moves by a voxel in every frame: repeating what is there now is wrong at its
    ends.
    """
    for frame, grid in world.items():
        grid.labels[:], grid.counts[:] = 0, 1
        grid.labels[frame : frame + 4] = 10
    truth = write(
        tmp_path / "truth", {"evaluation": world}, pose=lambda frame: np.eye(4), times=False
    )
    # ten frames a second without times.txt
    source = write(tmp_path / "a", {"same_0.1s": world, "same_0.2s": world})
    found = score(source, truth)
    assert [result.score.iou for result in found.values()] == pytest.approx([3 / 5, 2 / 6])


def test_a_missing_forecast_is_a_failure_of_its_frame(tmp_path, truth, world):
    frames = exact(world, 1)
    del frames[3]
    found = score(write(tmp_path / "a", {"net_0.5s": frames}), truth)[0.5]
    assert found.frames == 4 and "a prediction for frame 3" in found.failures[0][1]


@pytest.mark.parametrize(
    ("names", "options", "message"),
    [
        (["evaluation"], {}, "expected grids of forecasts such as forecast_1s, found evaluation"),
        (["a_1s", "b_1s"], {}, "grid: expected one forecast grid per horizon, found a_1s and b_1s"),
        (["a_1s"], {"grid": "b"}, "expected grids of forecasts such as b_1s, found a_1s"),
        (["a_9s"], {}, r"evaluation: expected frames that are 9 s apart, found frames of 2.51 s"),
        (
            ["a_1s"],
            {"scoring": Scoring(rays=True)},
            "scoring: expected .* for forecasts, found rays",
        ),
        (
            ["a_1s"],
            {"frames": "5:"},
            "expected labels of a frame to score, found none in the range 5:",
        ),
    ],
)
def test_mistakes_are_one_line(tmp_path, truth, world, names, options, message):
    source = write(tmp_path / "a", {name: exact(world, 2) for name in names})
    with pytest.raises(CarlascError, match=message) as error:
        score(source, truth, **options)
    assert "\n" not in str(error.value)


def test_files_of_other_benchmarks_have_no_later_frames(tmp_path, truth, world):
    source = write(tmp_path / "a", {"a_1s": exact(world, 2)})
    (truth / PATH / layout.params_file("evaluation")).unlink()
    with pytest.raises(
        MissingDataError, match="expected a sequence with poses and times, found files of grids"
    ):
        score(source, truth / PATH / "evaluation")


def test_the_command_prints_a_row_for_each_time_ahead(tmp_path, truth, world):
    source = write(tmp_path / "a", {"net_0.5s": exact(world, 1), "net_1s": exact(world, 2)})
    given = ["evaluate", str(source), str(truth), "--convention", "own", "--forecast", "present"]
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 0, result.output
    assert "frames: 5, 4" in result.output and result.output.count("0.5 s") == 2
    result = CliRunner().invoke(app, [*given, "--by", "distance"])
    assert "By region, 0.5 s" in result.output and "By region, 1 s" in result.output
    values = json.loads(CliRunner().invoke(app, [*given, "--json"]).stdout)["forecasts"]
    assert [(row["horizon_s"], row["accuracy"]) for row in values] == [(0.5, 1), (1, 1)]
    result = CliRunner().invoke(app, [*given, "--all-conventions"])
    assert (result.exit_code, result.output.count("\n")) == (
        2,
        1,
    ) and "--all-conventions" in result.output
    with pytest.raises(ArgumentError):
        score(source, truth, scoring=Scoring(by=("motion",)))
