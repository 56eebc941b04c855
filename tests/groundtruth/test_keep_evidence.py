"""What a run writes of how certain each voxel is, and what it leaves unknown."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.datasets.captures import write_capture
from helpers.datasets.sequences import scan
from typer.testing import CliRunner

import carlasc
from carlasc import FromCapture, FromGrid, FromScans, GridSpec, Run, Voting
from carlasc.cli import app
from carlasc.core.tables import CARLA, SEMANTICKITTI
from carlasc.errors import ArgumentError, ConflictError, FormatError
from carlasc.groundtruth import VoxelCertainty
from carlasc.groundtruth.from_scans.sequences import ScanFrame
from carlasc.groundtruth.voting.ballot import OCCUPIED_DTYPE
from carlasc.groundtruth.voting.certainty import class_shares
from carlasc.storage import FolderSink, field_files, layout

SPEC = GridSpec.published().with_size((8, 8, 4))
GRID = "cartesian/evaluation_8x8x4"
EVIDENCE = VoxelCertainty(
    np.linspace(0, 1, SPEC.num_voxels).reshape(SPEC.size),
    np.array([(3, 7, 65535), (9, 1, 20000)], field_files.VOTES_DTYPE),
    np.full(SPEC.size, 61, np.uint16),
)
FLAGS = np.full(SPEC.size, 5, np.uint8)


@pytest.fixture
def drive(tmp_path):
    """Three scans of random points from one place."""
    rng = np.random.default_rng(0)
    with FolderSink(tmp_path / "data") as sink, sink.sequence("cartesian") as writer:
        for frame in range(3):
            for name, array in scan(rng, 400).items():
                writer.write(name, frame, array)
        writer.write_document("poses.txt", layout.encode_poses(np.tile(np.eye(4), (3, 1, 1))))
    return tmp_path / "data"


@pytest.fixture
def known_evidence(monkeypatch):
    """Make every frame give the same evidence."""
    make = ScanFrame.make
    monkeypatch.setattr(
        ScanFrame,
        "make",
        lambda self, plan: replace(make(self, plan), evidence=EVIDENCE, flags=FLAGS),
    )


def run(drive, *, observe=None, overwrite=False, **settings):
    observe = FromScans() if observe is None else observe
    voting, workers = Voting(**settings), Run(workers=1)
    return carlasc.regrid(
        drive, SPEC, observe=observe, voting=voting, run=workers, overwrite=overwrite
    )


def the_sequence(drive):
    (sequence,) = carlasc.open(drive).sequences().values()
    return sequence


@pytest.mark.slow
@pytest.mark.usefixtures("known_evidence")
def test_evidence_is_written_beside_the_grid_also_of_one_that_is_there(drive):
    run(drive)
    names = {path.suffixes[0] for path in (drive / GRID).glob("0*")}
    assert names == {".label", ".bin", ".flags"}
    before = the_sequence(drive).grid("evaluation_8x8x4", 1)
    result = run(drive, keep_evidence=True)
    assert (result.made, result.failures) == (3, ())
    sequence = the_sequence(drive)
    for part in layout.EVIDENCE_FIELDS:
        field = f"evaluation_8x8x4/{part}"
        assert sequence.frames(field).tolist() == [0, 1, 2]
        wanted = getattr(EVIDENCE, part, FLAGS)
        assert np.array_equal(
            sequence.read(field, 1), wanted.astype("<f2") if part == "occupied" else wanted
        )
    assert np.array_equal(sequence.grid("evaluation_8x8x4", 1).labels, before.labels)
    assert run(drive, keep_evidence=True).skipped == 3
    (drive / GRID / "000001.flags.bin").unlink()
    assert run(drive, keep_evidence=True).made == 1
    assert "min_confidence" not in json.loads((drive / GRID / "params.json").read_text())["carlasc"]


@pytest.mark.slow
@pytest.mark.usefixtures("known_evidence")
def test_the_report_says_how_much_was_inferred(drive):
    report = drive / "cartesian" / layout.report_file("evaluation_8x8x4")
    for complete, share in (("seen", None), ("body", 1)):
        carlasc.regrid(
            drive, SPEC, observe=FromScans(complete=complete), overwrite=True, run=Run(workers=1)
        )
        assert json.loads(report.read_text())["inferred_share"] == share


@pytest.mark.usefixtures("known_evidence")
def test_voxels_that_are_not_certain_enough_become_unknown(drive):
    run(drive)
    whole = the_sequence(drive).grid("evaluation_8x8x4", 1)
    with pytest.raises(ConflictError, match=r"carlasc.min_confidence null where this run has 0.8"):
        run(drive, min_confidence=0.8)
    carlasc.regrid(
        drive,
        SPEC,
        observe=FromScans(),
        voting=Voting(min_confidence=0.8),
        run=Run(workers=1),
        overwrite=True,
    )
    sequence = the_sequence(drive)
    grid = sequence.grid("evaluation_8x8x4", 1)
    p = EVIDENCE.occupied.astype(np.float16)
    certain = (p >= np.float16(0.8)) | (p <= np.float16(0.2))
    assert np.array_equal(grid.labels, np.where(certain, whole.labels, 0))
    assert np.array_equal(grid.counts, np.where(certain, whole.counts, 0))
    assert (whole.known & ~certain).any() and (grid.known & certain).any()
    assert sequence.params("evaluation_8x8x4")["carlasc"]["min_confidence"] == 0.8
    assert not any("occupied" in name for name in sequence.fields())


@pytest.mark.slow
@pytest.mark.parametrize("settings", [{"keep_evidence": True}, {"min_confidence": 0.8}])
def test_a_frame_that_cannot_say_how_certain_it_is_fails(drive, monkeypatch, settings):
    make = ScanFrame.make
    monkeypatch.setattr(
        ScanFrame, "make", lambda self, plan: replace(make(self, plan), evidence=None)
    )
    failures = run(drive, **settings).failures
    assert [failure.message for failure in failures] == [
        f"frame {frame}: expected how certain each voxel is, found nothing" for frame in range(3)
    ]


@pytest.mark.parametrize("min_confidence", [-0.1, 1, float("nan")])
def test_a_confidence_is_a_probability_below_1(min_confidence):
    with pytest.raises(ArgumentError) as error:
        Voting(min_confidence=min_confidence)
    assert error.value.where == "min_confidence"


@pytest.mark.parametrize(
    ("observe", "rule", "found"),
    [
        (FromCapture(), None, "observe=capture, rule=sensor"),
        (FromCapture(), "ray", "observe=capture, rule=ray"),
        (FromGrid(), None, "observe=grid, rule=sensor"),
        (FromScans(), "sample", "observe=scans, rule=sample"),
    ],
)
@pytest.mark.parametrize("name", ["keep_evidence", "min_confidence"])
def test_only_rays_of_scans_say_how_certain_a_voxel_is(drive, observe, rule, found, name):
    voting = Voting(rule, **{name: True if name == "keep_evidence" else 0.9})
    with pytest.raises(ArgumentError) as error:
        carlasc.regrid(drive, SPEC, observe=observe, voting=voting, run=Run(workers=1))
    assert str(error.value).startswith(f"{name}: expected grids from scans with the rule")
    assert str(error.value).endswith(
        f"found {found}: make the grid from scans, or leave out `{name}`"
    )


def test_the_command_names_its_options(tmp_path):
    write_capture(tmp_path)
    result = CliRunner().invoke(
        app, ["regrid", str(tmp_path), "--preset", "coarse", "--keep-evidence"]
    )
    assert result.exit_code == 2
    assert result.stderr.startswith("carlasc: --keep-evidence: expected grids from scans")
    assert result.stderr.strip().endswith(
        "make the grid from scans, or leave out `--keep-evidence`"
    )
    result = CliRunner().invoke(
        app, ["regrid", str(tmp_path), "--preset", "coarse", "--min-confidence", "2"]
    )
    assert result.exit_code == 2 and "--min-confidence: expected a probability" in result.stderr


def test_fields_of_different_shapes_are_refused():
    with pytest.raises(FormatError) as error:
        replace(EVIDENCE, views=np.zeros((8, 8), np.uint16))
    assert error.value.where == "evidence views" and error.value.found == "(8, 8)"


@pytest.mark.parametrize(
    "classes, dtype",
    [(CARLA, field_files.VOTES_DTYPE), (SEMANTICKITTI, field_files.WIDE_VOTES_DTYPE)],
)
def test_the_probability_of_a_class_is_its_share_of_the_votes(classes, dtype):
    rng = np.random.default_rng(0)
    labels = [label for label in classes.names if label]
    rows = np.zeros(500, OCCUPIED_DTYPE)
    # many pairs twice and more
    rows["voxel"], rows["label"] = (
        rng.integers(0, 40, 500),
        rng.choice(labels, 500),
    )
    rows["votes"] = rng.integers(1, 100_000, 500)
    found = class_shares(rows, classes)
    assert found.dtype == dtype
    wanted = []
    for voxel in range(40):
        here = rows[rows["voxel"] == voxel]
        for label in sorted(set(here["label"].tolist())):
            share = here["votes"][here["label"] == label].sum() / here["votes"].sum()
            wanted.append((voxel, label, int(share * 65535)))
    assert found.tolist() == wanted
    assert (np.bincount(found["voxel"], found["votes"]) <= 65535).all()


def test_a_class_alone_is_certain_and_one_with_hardly_any_vote_is_left_out():
    rows = np.array([(2, 7, 1, 1, 1), (2, 1, 100_000, 1, 1), (0, 10, 3, 1, 1)], OCCUPIED_DTYPE)
    assert class_shares(rows, CARLA).tolist() == [(0, 10, 65535), (2, 1, 65534)]
    assert len(class_shares(rows[:0], CARLA)) == 0
