"""An argument of a wrong type is one line that names it, in every public function and class."""

import inspect
from dataclasses import is_dataclass

import numpy as np
import pytest
from helpers.datasets.drives import write_drive
from helpers.errors import raises

import carlasc
from carlasc.errors import ArgumentError, _kinds_of

PUBLIC = {
    name: value
    for name in dir(carlasc)
    if callable(value := getattr(carlasc, name)) and not name.startswith("_")
}
FUNCTIONS = {
    name: value if not inspect.isclass(value) or is_dataclass(value) else value.__init__
    for name, value in PUBLIC.items()
}
ARGUMENTS = [
    (name, argument)
    for name, function in FUNCTIONS.items()
    for argument in _kinds_of(function)
    if argument in inspect.signature(function).parameters
]
SPEC = carlasc.GridSpec.published()


class NoData(carlasc.Dataset):
    def __init__(self):
        pass

    def __repr__(self):
        return "no data"


TABLE = carlasc.core.REMAPS["carlasc11"].source
FILLED = {  # values of the right type for required arguments
    "spec": SPEC,
    "coordinates": "cartesian",
    "size": (1, 1, 1),
    "lower": (0, 0, 0),
    "upper": (1, 1, 1),
    "names": {},
    "colors": {},
    "mapping": {},
    "samples": [],
    "source": TABLE,
    "target": TABLE,
    "dataset": NoData(),
}
ARRAYS = "tracks labels centers quaternions sizes annotated points".split()


def filled(function, name):
    """Return values for the required arguments of a function."""
    values = dict.fromkeys(ARRAYS, np.zeros(0)) | FILLED
    if name != "Remap":
        values["source"] = "nowhere"
    return {
        argument: values.get(argument, "nowhere")
        for argument, about in inspect.signature(function).parameters.items()
        if about.default is about.empty and about.kind is not about.VAR_KEYWORD
    }


def test_every_public_function_is_checked():
    unchecked = {"Sink", "Source", "VoxelFlag", "FromCapture", "doctor"}
    assert {name for name, _ in ARGUMENTS} == PUBLIC.keys() - unchecked


@pytest.mark.parametrize("name, argument", ARGUMENTS, ids=lambda value: value)
def test_an_argument_of_a_wrong_type_is_named(name, argument, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wrong = object()
    arguments = filled(FUNCTIONS[name], name)
    arguments.pop("self", None)
    with raises(ArgumentError, where=f"^{argument}$", expected=".", found="object"):
        PUBLIC[name](**arguments | {argument: wrong})
    assert not any(tmp_path.iterdir())


@pytest.fixture
def lab(tmp_path):
    write_drive(tmp_path / "lab" / "A" / "cartesian", range(2))
    return tmp_path / "lab"


def test_a_name_or_a_size_is_taken_for_a_grid(lab, tmp_path):
    assert carlasc.GridSpec.of("coarse") == carlasc.GridSpec.of(SPEC) == SPEC
    assert carlasc.GridSpec.of(0.8).size == (64, 64, 4)
    assert carlasc.Flip("fine").spec == carlasc.GridSpec.published("fine")
    for spec in ("coarse", 0.2):  # the grid is taken: the source is what is missing
        with raises(carlasc.errors.MissingDataError, where="nowhere"):
            carlasc.regrid(tmp_path / "nowhere", spec)
    with raises(ArgumentError, where="^spec$", expected="coarse", found="lab"):
        carlasc.regrid(lab, "lab", tmp_path / "out")
    with raises(ArgumentError, where="^spec$", expected="a GridSpec or a text or a number"):
        carlasc.regrid(lab, (3.2, 3.2, 1.5), tmp_path / "out")


@pytest.mark.parametrize(
    "remap, found",
    [({"Vehicle": 1}, "'Vehicle': 1"), ({1: 1.7}, "1: 1.7"), (1.5, "float"), ("lab", "'lab'")],
    ids=str,
)
def test_a_remap_has_ids(lab, remap, found):
    with raises(ArgumentError, where="^remap$", found=found):
        carlasc.Dataset(lab, remap=remap)


def test_one_file_of_scores_is_taken(tmp_path):
    with raises(carlasc.errors.MissingDataError, where="a.json$"):
        carlasc.scores(tmp_path / "a.json")
    with raises(carlasc.errors.MissingDataError, where="a.json$"):
        carlasc.scores("a.json")


@pytest.mark.parametrize("wrong", ["x", None, (), (1, 2), -1], ids=str)
def test_a_resolution_is_one_number_or_three(wrong):
    with raises(ArgumentError, where="^resolution$"):
        SPEC.with_resolution(wrong)
