"""`carlasc validate --holdout`: what it prints, and the exit codes that scripts rely on."""

import json

import pytest
from helpers.scenes import passing_car
from typer.testing import CliRunner

import carlasc
from carlasc import FromScans, GridSpec, Run
from carlasc.cli import app

OPTIONS = ("--holdout", "--holdout-every", "3", "--window=-2:2", "--workers", "1")


def run(*arguments):
    return CliRunner().invoke(app, ["validate", *map(str, arguments)])


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    folder = passing_car.write_sequence(tmp_path_factory.mktemp("street"), frames=8)
    assert run(folder, "--accept", "poses-on-scans").exit_code == 0  # nothing faces along the walls
    return folder


def test_held_out_rays_are_printed_below_the_checks(street):
    result = run(street, *OPTIONS, "--res", "0.8")
    assert result.exit_code == 0, result.output
    assert "sound (0 errors" in result.output
    assert "held-out rays, cartesian 64 x 64 x 4, 2 scans left out" in result.output
    assert "Vehicle" in result.output
    assert "10-20 m" in result.output
    assert "that the vehicle itself drove through are occupied" in result.output


@pytest.mark.slow
def test_the_grid_that_exists_is_measured_and_ends_in_a_verdict(tmp_path):
    folder = passing_car.write_sequence(tmp_path, frames=8)
    spec = GridSpec.published().with_resolution(0.8)
    carlasc.regrid(folder, spec, observe=FromScans(window=(-2, 2)), run=Run(workers=1))
    arguments = ("--holdout", "--holdout-every", "3", "--workers", "1")
    result = run(folder, *arguments, "--accept", "poses-on-scans")
    assert result.exit_code == 0, result.output
    assert "held-out rays, cartesian 64 x 64 x 4, 2 scans left out" in result.output
    assert result.output.endswith("held-out rays: tested and right\n")


@pytest.mark.slow
def test_held_out_rays_are_part_of_the_json(street):
    values = json.loads(run(street, *OPTIONS, "--json").stdout)
    assert values["ok"]
    assert values["holdout"]["every"] == 3
    assert values["holdout"]["total"]["rays"]["occupied"] > 0.9
    assert len(values["holdout"]["sequences"]) == 1
    assert "holdout" not in json.loads(run(street, "--json").stdout)


@pytest.mark.slow
def test_dynamic_changes_what_is_measured(street):
    shares = [
        json.loads(run(street, *OPTIONS, "--json", "--dynamic", dynamic).stdout)["holdout"][
            "total"
        ]["rays"]
        for dynamic in ("tube", "align")
    ]
    assert shares[0]["passed_object"] > shares[1]["passed_object"]


@pytest.mark.parametrize(
    "arguments",
    [
        ("--res", "0.4"),
        ("--window=-3:3",),
        ("--holdout", "--holdout-every", "1"),
        ("--holdout", "--res", "0.4", "--size", "1,1,1"),
        ("--holdout", "--window", "3:1"),
        ("--holdout", "--preset", "cylindrical"),
    ],
)
def test_options_that_make_no_sense_exit_2(street, arguments):
    assert run(street, *arguments).exit_code == 2


def test_a_drive_without_poses_is_one_line_and_exit_1(tmp_path):
    folder = passing_car.write_sequence(tmp_path, frames=2, poses=False)
    result = run(folder, "--holdout")
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert "poses" in result.stderr


def test_a_scan_that_cannot_be_read_is_listed_and_exits_1(tmp_path):
    folder = passing_car.write_sequence(tmp_path, frames=8)
    (folder / "cartesian" / "labels" / "000004.label").write_bytes(b"odd")
    result = run(folder, *OPTIONS)
    assert result.exit_code == 1
    assert "000004.label" in result.stderr
    assert "1 of 2 scans failed" in result.stderr
