"""The card of a data set, judged by the readers that it is for: the Hub's own parser, mlcroissant
and datasets.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import re
import shutil
import subprocess
import sys
import warnings
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets.sequences import files_of, write_dataset
from helpers.datasets.tiny_kitti import write_tiny_kitti
from storage.transport.test_zipped import write_zip
from typer.testing import CliRunner

import carlasc
from carlasc import CardDetails, Run
from carlasc.captures.settings import Lidar
from carlasc.cli import app
from carlasc.core.grids import GridSpec
from carlasc.errors import ArgumentError, CarlascError, ConflictError, FormatError, MissingDataError
from carlasc.inspection.cards.facts import STATEMENTS
from carlasc.motion import PoseOptions
from carlasc.testing.data import SCANS, WHOLE

TOWN = "Train/Demo/cartesian"
STATED: dict[str, Any] = {
    "place": "Ann Arbor",
    "citation": "@misc{data}",
    "statements": {"personalSensitiveInformation": "Faces are blurred."},
}
SAID: dict[str, Any] = {"license": "cc-by-4.0", "published": "2026-11-22"}


def write_card(source: Any, out: Path | None = None, **given: Any) -> carlasc.inspection.CardResult:
    """Write a card; what the author says of the data is given beside the other arguments."""
    details = {
        field.name: given.pop(field.name) for field in fields(CardDetails) if field.name in given
    }
    return carlasc.card(source, out, about=CardDetails(**STATED | details), **given)


def front_matter(folder: Path) -> dict[str, Any]:
    """Return what the Hub's own parser reads at the head of README.md."""
    hub = pytest.importorskip("huggingface_hub")
    return hub.DatasetCard.load(folder / "README.md").data.to_dict()


def croissant(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "croissant.json").read_text())


def validated(folder: Path, caplog: pytest.LogCaptureFixture) -> Any:
    """Return the data set as mlcroissant reads it, which must find nothing to complain about."""
    mlcroissant = pytest.importorskip("mlcroissant")
    with warnings.catch_warnings(), caplog.at_level(logging.WARNING):
        warnings.simplefilter("error", UserWarning)
        found = mlcroissant.Dataset(folder / "croissant.json")
    issues = found.metadata.ctx.issues
    assert (issues.errors, issues.warnings) == (set(), set())
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]
    return found


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny simulated town with a grid, as the demo makes one."""
    root = tmp_path_factory.mktemp("simulated") / "town"
    sequence = root / "Train" / "Demo"
    carlasc.simulate(
        sequence,
        count=2,
        sensors=2,
        lidar=Lidar(channels=16, points=4000),
        bev=False,
        run=Run(workers=1),
    )
    carlasc.regrid(sequence, GridSpec.published().with_resolution(1.6), run=Run(workers=1))
    return root


@pytest.fixture(scope="module")
def tables(town: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The town as a Parquet store, with its card."""
    store = tmp_path_factory.mktemp("packed") / "town.parquet"
    carlasc.pack(town, store)
    statements = {name: f"What the author knows of {name}." for name in STATEMENTS}
    write_card(store, pictures=False, authors=["Town Lab"], statements=statements, **SAID)
    return store


@pytest.fixture
def mixed(tmp_path: Path) -> Path:
    """Two converted sequences and one that was converted from nothing."""
    return licensed(
        write_dataset(tmp_path / "mixed"), {WHOLE: "CC BY-NC-SA 4.0", SCANS: "CC BY 4.0"}
    )


def licensed(root: Path, licenses: dict[str, object]) -> Path:
    """Write what a conversion writes of source and licence."""
    for path, license_ in licenses.items():
        file = root / path / "carlasc.json"
        values = json.loads(file.read_text()) if file.exists() else {"format": 2}
        file.write_text(json.dumps(values | {"source": f"set of {path[:3]}", "license": license_}))
    return root


@pytest.mark.needs("mlcroissant", "pyarrow")
def test_the_statements_of_the_author_are_the_responsible_fields_of_valid_croissant(
    tables: Path, caplog: pytest.LogCaptureFixture
) -> None:
    found = validated(tables, caplog).metadata
    content = croissant(tables)
    assert content["conformsTo"] == [
        "http://mlcommons.org/croissant/1.1",
        "http://mlcommons.org/croissant/RAI/1.0",
    ]
    for name in STATEMENTS:
        assert content[f"rai:{name}"][0] == f"What the author knows of {name}."
    required = (
        "data_biases",
        "data_limitations",
        "data_use_cases",
        "data_social_impact",
        "personal_sensitive_information",
    )
    for name in required:
        assert len(str(getattr(found, name))) > 30, name
    assert [activity["prov:label"] for activity in content["prov:wasGeneratedBy"]] == [
        "Data collection",
        "Ground truth",
    ]
    assert all(value not in ("", [], [""], None) for value in content.values())
    assert content["license"] == "https://creativecommons.org/licenses/by/4.0/"
    assert content["creator"] == [{"@type": "sc:Organization", "name": "Town Lab"}]


@pytest.mark.needs("mlcroissant", "pyarrow")
def test_mlcroissant_reads_records_of_the_tables(
    tables: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data, sequence = validated(tables, caplog), carlasc.open(tables).sequences()[TOWN]
    point = next(iter(data.records("points")))
    assert [point[f"points/{axis}"] for axis in "xyz"] == sequence.read("points", 0)[0, :3].tolist()
    frames = list(data.records("frames"))
    assert [frame["frames/frame"] for frame in frames] == [0, 1]
    assert np.array_equal(np.reshape(frames[1]["frames/pose"], (3, 4)), sequence.read_pose(1)[:3])
    assert {record["sequences/path"] for record in data.records("sequences")} == {TOWN}
    labels = sequence.read("evaluation_32x32x2/labels", 0).reshape(-1)
    read = [
        record["evaluation_32x32x2_labels/label"]
        for record in data.records("evaluation_32x32x2_labels")
    ]
    assert read[: len(labels)] == labels.tolist()


@pytest.mark.needs("pyarrow")
def test_checksums_are_those_of_the_files(tables: Path) -> None:
    objects = [
        file for file in croissant(tables)["distribution"] if file["@type"] == "cr:FileObject"
    ]
    assert {file["contentUrl"] for file in objects} == {
        path
        for path in files_of(tables)
        if path.endswith(".parquet") and not path.endswith("documents.parquet")
    }
    for file in objects:
        data = (tables / file["contentUrl"]).read_bytes()
        assert (file["sha256"], file["contentSize"]) == (
            hashlib.sha256(data).hexdigest(),
            f"{len(data)} B",
        )


@pytest.mark.slow
@pytest.mark.needs("datasets", "pyarrow")
def test_load_dataset_opens_the_store_as_it_is_and_the_readme_shows_how(
    tables: Path, tmp_path: Path
) -> None:
    blocks = re.findall(r"```python\n(.*?)```", (tables / "README.md").read_text(), re.DOTALL)
    assert len(blocks) == 2
    asked = """
import json, datasets
points = columns
both = load_dataset(data, split="train")
labels = load_dataset(data, "evaluation_32x32x2_labels", split="train")
print(json.dumps({
    "xyz": [points[axis][5].item() for axis in "xyz"], "rows": len(one), "frames": list(both["frame"]), "path": both[0]["path"],
    "pose": both[1]["pose"], "cells": labels.num_rows, "labels": list(labels.filter(lambda row: row["frame"] == 1)["label"]),
    "grid": list(grid.labels.shape), "samples": len(dataset),
    "configs": datasets.get_dataset_config_names(data),
}))
"""
    offline = {
        "HF_HUB_OFFLINE": "1",
        "HF_HOME": str(tmp_path),
        "HF_DATASETS_CACHE": str(tmp_path / "cache"),
    }
    ran = subprocess.run(
        [sys.executable, "-c", "".join(blocks) + asked],
        cwd=tables,
        env=os.environ | offline,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    found, sequence = (
        json.loads(ran.stdout.splitlines()[-1]),
        carlasc.open(tables).sequences()[TOWN],
    )
    assert found["xyz"] == sequence.read("points", 0)[5, :3].tolist()
    assert found["rows"] == len(sequence.read("points", 0))
    assert (found["frames"], found["path"]) == ([0, 1], TOWN)
    assert np.array_equal(np.reshape(found["pose"], (3, 4)), sequence.read_pose(1)[:3])
    assert found["labels"] == sequence.read("evaluation_32x32x2/labels", 1).reshape(-1).tolist()
    assert found["cells"] == 2 * 32 * 32 * 2
    assert (found["grid"], found["samples"]) == ([32, 32, 2], 2)
    assert found["configs"][0] == "frames" and "points" in found["configs"]


@pytest.mark.needs("pyarrow")
def test_the_hub_reads_the_head_of_the_readme(tables: Path) -> None:
    found = front_matter(tables)
    assert (found["license"], found["pretty_name"]) == ("cc-by-4.0", "town")
    assert (found["task_categories"], found["size_categories"]) == (["other"], ["n<1K"])
    points = next(config for config in found["configs"] if config["config_name"] == "points")
    assert points["data_files"] == [{"split": "train", "path": [f"{TOWN}/points.parquet"]}]
    assert [config["config_name"] for config in found["configs"] if config.get("default")] == [
        "frames"
    ]


@pytest.mark.needs("datasets", "pyarrow", "mlcroissant")
def test_sequences_with_other_columns_and_several_splits_are_opened(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = tmp_path / "x.parquet"
    carlasc.pack(write_dataset(tmp_path / "data"), store)
    write_card(store, **SAID, pictures=False)
    names = {
        config["config_name"]: config["data_files"] for config in front_matter(store)["configs"]
    }
    frames = [name for name in names if name.startswith("frames")]
    assert len(frames) > 1  # one sequence has no poses, one no scans
    assert {entry["split"] for entry in names["points"]} == {"train", "validation"}
    found = validated(store, caplog)
    assert sum(len(list(found.records(name))) for name in frames) == sum(
        sequence.frames for sequence in carlasc.info(store).sequences
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["folder", "zip", "zarr", "h5"])
def test_other_stores_are_valid_and_say_how_they_are_opened(
    kind: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    published = write_dataset(tmp_path / "data")
    source, extra = published, {"zarr": "[zarr]", "h5": "[hdf5]"}.get(kind, "")
    if kind == "zip":
        source = write_zip(files_of(published), tmp_path / "x.zip")
    elif kind != "folder":
        source = tmp_path / f"x.{kind}"
        carlasc.pack(published, source)
    result = write_card(source, **SAID, pictures=False)
    assert result.folder == (published if kind == "folder" else tmp_path)
    found = front_matter(result.folder)
    assert "configs" not in found and found["viewer"] is False
    text = (result.folder / "README.md").read_text()
    assert f"`carlasc{extra}`" in text
    (block,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    code = block.replace(f'"{source.name}"', repr(str(source))).replace('"."', repr(str(source)))
    exec(code.partition("\ndataset")[0], names := {})  # what the card tells its reader to run
    assert names["sequence"].path in carlasc.open(source).sequences()
    validated(result.folder, caplog)
    objects = {
        file["@id"]
        for file in croissant(result.folder)["distribution"]
        if file["@type"] == "cr:FileObject"
    }
    assert (
        objects
        == {"folder": set(), "zip": {"x.zip"}, "zarr": {"x.zarr/zarr.json"}, "h5": {"x.h5"}}[kind]
    )


@pytest.mark.parametrize("kind", ["folder", "zarr"])
def test_the_patterns_of_a_folder_find_its_files(kind: str, tmp_path: Path) -> None:
    from fnmatch import fnmatch

    root = write_dataset(tmp_path / "data")
    if kind == "zarr":
        carlasc.pack(root, tmp_path / "x.zarr")
        root = tmp_path
    names = (
        set(files_of(root))
        if kind == "folder"
        else {name for name in files_of(root) if name.startswith("x.zarr")}
    )
    write_card(root if kind == "folder" else root / "x.zarr", **SAID, pictures=False)
    sets = [file for file in croissant(root)["distribution"] if file["@type"] == "cr:FileSet"]
    for one in sets:
        assert any(fnmatch(name, pattern) for name in names for pattern in one["includes"]), one
    found = {
        name
        for name in names
        for one in sets
        for pattern in one["includes"]
        if fnmatch(name, pattern)
    }
    assert names == found


def test_counts_and_classes_are_those_of_stats(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    write_card(root, **SAID, pictures=False)
    counted = carlasc.stats(root, remap=None).to_dict()["total"]["points"]
    (records,) = [
        one["data"] for one in croissant(root)["recordSet"] if one["@id"] == "classes-carla"
    ]
    for row in records:
        share = counted[row["classes-carla/name"]] / sum(counted.values())
        assert row["classes-carla/points"] == pytest.approx(share, abs=1e-6)
    assert len(records) == sum(count > 0 for count in counted.values())


def test_pictures_are_drawn_and_shown(town: Path, tmp_path: Path) -> None:
    for package in ("embreex", "PIL"):
        pytest.importorskip(package)
    result = write_card(town, tmp_path / "card", **SAID)
    assert [path.relative_to(tmp_path / "card").as_posix() for path in result.files] == [
        "README.md", "croissant.json", "images/grid.png", "images/scan.png",
    ]  # fmt: skip
    assert "](images/grid.png)" in (tmp_path / "card" / "README.md").read_text()
    assert all(path.stat().st_size > 5000 for path in result.files[2:])


def test_a_card_without_the_packages_that_draw_says_so(
    town: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "PIL.Image", None)
    result = write_card(town, tmp_path / "card", **SAID)
    assert len(result.files) == 2
    notes = [note for note in result.notes if "picture" in note]
    assert len(notes) == 2 and all("[render]'" in note for note in notes)


def test_a_non_commercial_set_stays_so_and_each_source_keeps_its_licence(mixed: Path) -> None:
    result = write_card(mixed, license="cc0-1.0", pictures=False, published="2026-11-22")
    assert result.licenses == ("CC BY-NC-SA 4.0", "CC BY 4.0", "CC0 1.0")  # the strictest first
    assert front_matter(mixed)["license"] == ["cc-by-nc-sa-4.0", "cc-by-4.0", "cc0-1.0"]
    assert croissant(mixed)["license"][0] == "https://creativecommons.org/licenses/by-nc-sa/4.0/"
    assert croissant(mixed)["prov:wasDerivedFrom"] == ["set of Tra", "set of Val"]
    text = (mixed / "README.md").read_text()
    row = next(line for line in text.splitlines() if line.startswith("| set of Tra"))
    assert "non-commercial use only" in row and "carlasc.json of the sequences" in row
    assert "- set of Tra: see the page of its publishers" in text


@pytest.mark.parametrize(
    "license_",
    [
        "CC BY-NC-ND 3.0",
        "cc-by-nd-4.0",
        "https://creativecommons.org/licenses/by-nc-nd/3.0/deed.fr",
    ],
)
def test_a_set_that_forbids_passing_on_is_refused_with_the_reason(
    tmp_path: Path, license_: str
) -> None:
    root = licensed(write_dataset(tmp_path / "data"), {SCANS: license_})
    with pytest.raises(CarlascError) as caught:
        write_card(root, **SAID, pictures=False)
    assert "ND" in caught.value.found and "set of Val" in caught.value.found
    assert not (root / "README.md").exists()


@pytest.mark.slow
@pytest.mark.parametrize("license_", ["ask the authors", 4, ["CC BY 4.0"], "CC BY-NC-SA"])
def test_a_licence_in_the_data_that_nobody_knows_is_one_line(
    tmp_path: Path, license_: object
) -> None:
    root = licensed(write_dataset(tmp_path / "data"), {WHOLE: license_})
    with pytest.raises(FormatError) as caught:
        write_card(root, **SAID, pictures=False)
    assert (caught.value.where, caught.value.found) == (
        f"{root / WHOLE}/carlasc.json",
        repr(license_),
    )


def test_an_unknown_licence_names_those_that_are_near(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    with pytest.raises(ArgumentError) as caught:
        write_card(root, license="cc-by-sa-5.0", pictures=False)
    assert caught.value.where == "license" and "cc-by-sa-4.0" in caught.value.expected


def test_a_licence_of_your_own_is_named_by_its_address(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    root = write_dataset(tmp_path / "data")
    write_card(root, license="https://lab.example/terms", published="2026-11-22", pictures=False)
    found = front_matter(root)
    assert (found["license"], found["license_link"]) == ("other", "https://lab.example/terms")
    assert re.fullmatch(r"[a-z0-9.-]+", found["license_name"])
    assert validated(root, caplog).metadata.license == ["https://lab.example/terms"]


def test_simulated_data_need_a_licence_from_their_author(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    result = CliRunner().invoke(app, ["card", str(root), "--no-pictures"])
    assert (result.exit_code, len(result.stderr.splitlines())) == (2, 1)
    assert "--license: expected license, statements" in result.stderr
    licensed(root, {WHOLE: None, SCANS: None})
    with pytest.raises(ArgumentError) as caught:
        write_card(root, pictures=False)
    assert "set of Tra and set of Val" in caught.value.expected


def test_a_given_licence_does_not_replace_that_of_the_source(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    licensed(root, dict.fromkeys(carlasc.open(root).sequences(), "CC BY-NC-SA 3.0"))
    with pytest.raises(ArgumentError) as caught:
        write_card(root, license="mit", pictures=False)
    assert caught.value.found == "MIT" and caught.value.expected.startswith("CC BY-NC-SA 3.0")
    assert write_card(root, pictures=False).licenses == ("CC BY-NC-SA 3.0",)


def test_an_existing_readme_is_not_replaced_unasked(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    (root / "README.md").write_text("mine")
    with pytest.raises(ConflictError) as caught:
        write_card(root, **SAID, pictures=False)
    assert Path(caught.value.where) == root / "README.md"
    assert (root / "README.md").read_text() == "mine"
    write_card(root, **SAID, pictures=False, overwrite=True)
    assert (root / "README.md").read_text().startswith("---\n")


def test_an_existing_picture_is_found_before_anything_is_counted(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    (root / "images").mkdir()
    (root / "images" / "grid.png").write_bytes(b"mine")
    with pytest.raises(ConflictError) as caught:
        write_card(root, **SAID, run=Run(1, progress=lambda done, total: pytest.fail("counted")))
    assert Path(caught.value.where).name == "grid.png"
    assert not (root / "README.md").exists()


def test_a_run_that_was_killed_is_finished_by_the_next(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    write_card(root, **SAID, pictures=False)
    whole = (root / "README.md").read_bytes()
    (root / "README.md").unlink()  # the last file
    write_card(root, **SAID, pictures=False)
    assert (root / "README.md").read_bytes() == whole
    (root / "README.md").unlink()
    (root / "croissant.json").write_text('{"name": "mine"}')
    with pytest.raises(ConflictError) as caught:
        write_card(root, **SAID, pictures=False)
    assert Path(caught.value.where).name == "croissant.json"


def test_data_behind_a_url_have_their_card_in_a_folder_here(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    fsspec = pytest.importorskip("fsspec")
    source = write_zip(files_of(write_dataset(tmp_path / "data")), tmp_path / "x.zip")
    fsspec.filesystem("memory").pipe("/cards/x.zip", source.read_bytes())
    with pytest.raises(ArgumentError) as caught:
        write_card("memory://cards/x.zip", **SAID, pictures=False)
    assert caught.value.where == "out" and "memory://cards/x.zip" in caught.value.expected
    write_card("memory://cards/x.zip", tmp_path / "card", **SAID, pictures=False)
    (file,) = [
        file
        for file in croissant(tmp_path / "card")["distribution"]
        if file["@type"] == "cr:FileObject"
    ]
    assert (file["contentUrl"], file["encodingFormat"]) == ("x.zip", "application/zip")
    assert file["sha256"] == hashlib.sha256(source.read_bytes()).hexdigest()
    assert front_matter(tmp_path / "card")["pretty_name"] == "x"
    validated(tmp_path / "card", caplog)


def test_a_source_without_sequences_is_one_line(town: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for source in (tmp_path / "empty", town / "Train" / "Demo" / "raw"):
        with pytest.raises((MissingDataError, ArgumentError)) as caught:
            write_card(source, **SAID)
        assert "\n" not in str(caught.value)
        assert not (source / "README.md").exists()


@pytest.mark.parametrize(
    "given",
    [
        {"version": "new"},
        {"published": "yesterday"},
        {"url": "huggingface.co/x"},
        {"every": 0},
        {"out": "README.md"},
    ],
)
def test_wrong_arguments_are_named(tmp_path: Path, given: dict[str, Any]) -> None:
    root = write_dataset(tmp_path / "data")
    (root / "README.md").write_text("mine")
    (name,) = given
    if name == "out":
        given = {"out": root / given["out"]}
    with pytest.raises(ArgumentError) as caught:
        write_card(root, **{**SAID, "overwrite": True, "pictures": False, **given})
    assert caught.value.where == name
    assert name == "out" or caught.value.found == repr(given[name]).strip()


def test_names_in_the_data_make_no_markup(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    root = write_dataset(tmp_path / "data")
    table = {
        "name": "evil|<b>",
        "names": {"0": "free", "1": "<script>alert(1)</script>|x", "2": "a\n# b"},
    }
    colors = {"colors": {index: [0, 0, 0] for index in table["names"]}}
    table["names"] |= {str(k): f"c{k}" for k in range(3, 23)}
    colors["colors"] |= {str(k): [0, 0, 0] for k in range(3, 23)}
    (root / WHOLE / "carlasc.json").write_text(
        json.dumps({"format": 2, "classes": table | colors, "sensor": "[x](http://evil)"})
    )
    write_card(root, **SAID, name="x: [1] # `y`\n---", pictures=False)
    text = (root / "README.md").read_text()
    assert "<script>" not in text and "\n# b" not in text and "[x](http://evil)" not in text
    assert front_matter(root)["pretty_name"] == "x: [1] # `y`\n---"
    validated(root, caplog)


@pytest.mark.needs("pyarrow")
def test_a_published_store_is_addressed_at_the_hub(
    tables: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_card(
        tables,
        tmp_path / "card",
        url="https://huggingface.co/datasets/lab/town",
        pictures=False,
        **SAID,
    )
    content = croissant(tmp_path / "card")
    address = (
        f"https://huggingface.co/datasets/lab/town/resolve/main/town.parquet/{TOWN}/points.parquet"
    )
    assert address in [file.get("contentUrl") for file in content["distribution"]]
    text = (tmp_path / "card" / "README.md").read_text()
    assert (
        'data = "lab/town"' in text
        and 'carlasc.open("hf://datasets/lab/town/town.parquet")' in text
    )
    validated(tmp_path / "card", caplog)


def test_frames_that_cannot_be_read_are_listed_and_end_with_1(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    (root / WHOLE / "labels" / "000005.label").write_bytes(b"123")
    result = CliRunner().invoke(
        app, ["card", str(root), "--license", "mit", "--no-pictures", "--draft"]
    )
    assert result.exit_code == 1
    assert "000005.label" in result.stderr
    assert "1 files could not be read" in (root / "README.md").read_text()


def test_a_grid_that_cannot_be_described_is_not_left_out(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    (root / WHOLE / "evaluation" / "params.json").write_text("{}")
    with pytest.raises(FormatError) as caught:
        write_card(root, **SAID, pictures=False)
    assert "params.json" in str(caught.value) and "\n" not in str(caught.value)
    assert not (root / "README.md").exists()


def test_the_command_prints_what_it_wrote(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    (tmp_path / "cite.bib").write_text("@misc{town}")
    arguments = [
        "--license",
        "mit",
        "--author",
        "A",
        "--author",
        "B",
        "--citation",
        str(tmp_path / "cite.bib"),
    ]
    result = CliRunner().invoke(
        app, ["card", str(root), *arguments, "--no-pictures", "--json", "-o", str(tmp_path / "c")]
    )
    assert result.exit_code == 2
    assert "--statements: expected statements (personalSensitiveInformation), place" in (
        result.stderr
    )
    arguments += ["--place", "Ann Arbor", "--draft"]
    result = CliRunner().invoke(
        app, ["card", str(root), *arguments, "--no-pictures", "--json", "-o", str(tmp_path / "c")]
    )
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert found["files"] == [
        str(tmp_path / "c" / name) for name in ("README.md", "croissant.json")
    ]
    assert croissant(tmp_path / "c")["citeAs"] == "@misc{town}"
    assert [author["name"] for author in croissant(tmp_path / "c")["creator"]] == ["A", "B"]


def test_the_card_of_converted_data_keeps_their_licence_and_names_their_authors(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_tiny_kitti(tmp_path / "kitti", frames=2)
    carlasc.convert(
        "kitti",
        tmp_path / "kitti",
        tmp_path / "out",
        poses=PoseOptions(source="file"),
        grids=None,
        run=Run(workers=1),
    )
    made = write_card(tmp_path / "out", pictures=False, published="2026-11-22", citation=None)
    assert made.licenses == ("CC BY-NC-SA 3.0",)
    text, content = (tmp_path / "out" / "README.md").read_text(), croissant(tmp_path / "out")
    assert front_matter(tmp_path / "out")["license"] == "cc-by-nc-sa-3.0"
    assert "- kitti kitti: J. Behley et al., SemanticKITTI, ICCV 2019" in text
    assert "Velodyne HDL-64E" in text and "nearer than 2.5 m" in text
    assert content["citeAs"].startswith("J. Behley et al., SemanticKITTI")
    assert content["prov:wasDerivedFrom"] == ["kitti kitti"]
    validated(tmp_path / "out", caplog)


def test_data_are_called_simulated_only_if_they_say_so(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    claims = ("simulat", "CARLA server", "MotionSC", "pip install", "hasSyntheticData")
    for licenses in ({}, dict.fromkeys(carlasc.open(root).sequences(), "MIT")):
        licensed(root, licenses)
        given = {"statements": {}, "draft": True, **({} if licenses else SAID)}
        result = write_card(root, pictures=False, overwrite=True, **given)
        for file in result.files:
            assert not [claim for claim in claims if claim in file.read_text()]
        assert any("personal data" in note for note in result.notes)
        assert "Not stated by the author: " in (root / "README.md").read_text()
        assert "**This is a draft. " in (root / "README.md").read_text()
        assert croissant(root)["creativeWorkStatus"] == "Draft"
        assert "rai:personalSensitiveInformation" not in croissant(root)
    paths = list(carlasc.open(root).sequences())
    for number, path in enumerate(paths, 1):
        file = root / path / "carlasc.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | {"simulated": True}))
        write_card(root, pictures=False, overwrite=True)
        assert croissant(root)["rai:hasSyntheticData"] is True
        assert "simulation" in front_matter(root)["tags"]
        part = "" if number == len(paths) else f"{number} of {len(paths)} sequences "
        assert f", {part}recorded in a simulator" in croissant(root)["description"]


def test_statements_are_shown_as_the_author_wrote_them(tmp_path: Path) -> None:
    root = write_dataset(tmp_path / "data")
    (tmp_path / "said.toml").write_text('personalSensitiveInformation = "Faces are blurred."')
    command = ["card", str(root), "--license", "mit", "--no-pictures", "--overwrite"]
    command += ["--place", "Ann Arbor", "--draft"]
    result = CliRunner().invoke(app, [*command, "--statements", str(tmp_path / "said.toml")])
    assert result.exit_code == 0, result.output
    assert "Personal data\n\nFaces are blurred.\n" in (root / "README.md").read_text()
    assert croissant(root)["rai:personalSensitiveInformation"] == ["Faces are blurred."]
    (tmp_path / "said.toml").write_text("personal")
    result = CliRunner().invoke(app, [*command, "--statements", str(tmp_path / "said.toml")])
    assert (result.exit_code, len(result.stderr.splitlines())) == (1, 1)
    with pytest.raises(ArgumentError) as caught:
        CardDetails(statements={"personal": "x"})
    assert caught.value.where == "statements" and "'x'" in caught.value.found


@pytest.mark.needs("pyarrow")
def test_rounded_coordinates_are_said(town: Path, tmp_path: Path) -> None:
    from carlasc.storage.packed.stores import PackOptions
    from carlasc.storage.parquet.parquet_sink import ParquetSink

    with (
        ParquetSink(tmp_path / "x.parquet", PackOptions(lossy_mm=2)) as sink,
        sink.sequence(SCANS) as writer,
    ):
        writer.write("points", 0, np.ones((3, 4), np.float32))
    write_card(tmp_path / "x.parquet", **SAID, pictures=False)
    text = (tmp_path / "x.parquet" / "README.md").read_text()
    assert "`x`, `y` and `z` are whole numbers of 2 mm." in text
    assert "Coordinates of points are rounded to steps of 2 mm." in text


def test_each_line_of_a_card_is_what_the_data_say(town: Path, tmp_path: Path) -> None:
    """Five kinds of sources: simulated, packed, converted, own recordings, and a mixture."""
    write_tiny_kitti(tmp_path / "kitti", frames=2)
    carlasc.convert(
        "kitti",
        tmp_path / "kitti",
        tmp_path / "converted",
        poses=PoseOptions(source="file"),
        grids=None,
        run=Run(workers=1),
    )
    carlasc.pack(town, tmp_path / "town.h5", run=Run(workers=1))
    mixture = write_dataset(tmp_path / "mixture")
    shutil.copytree(town / "Train" / "Demo", mixture / "Train" / "Demo")
    sources = {
        "simulated": town,
        "packed": tmp_path / "town.h5",
        "converted": tmp_path / "converted",
        "own": write_dataset(tmp_path / "own"),
        "mixture": mixture,
    }
    for kind, source in sources.items():
        out = tmp_path / "cards" / kind
        about = carlasc.open(source).sequences()
        simulated = [one.metadata.extra.get("simulated") is True for one in about.values()]
        assert all(simulated) == (kind in ("simulated", "packed"))
        if kind != "converted":
            with pytest.raises(ArgumentError) as caught:
                carlasc.card(source, out, pictures=False)
            needed = "license" if all(simulated) else "license, statements .*, place, citation"
            assert caught.value.where == "license" and not out.exists()
            assert re.match(needed + " of /", caught.value.expected)
        license_ = None if kind == "converted" else "cc-by-4.0"
        details = CardDetails(license=license_, published="2026-11-22")
        draft = carlasc.card(source, out, about=details, draft=True, pictures=False)
        text = (out / "README.md").read_text()
        assert ("This is a draft" in text) != all(simulated)
        assert any("This is a draft" in note for note in draft.notes) != all(simulated)
        checked = dict(STATED) if not all(simulated) else {}
        carlasc.card(
            source,
            out,
            about=CardDetails(license=license_, published="2026-11-22", **checked),
            pictures=False,
            overwrite=True,
        )
        check_lines(out, about, checked)


def check_lines(out: Path, about: Any, stated: dict[str, Any]) -> None:
    """Check each statement of README.md and croissant.json about the origin of the data."""
    text, content = (out / "README.md").read_text(), croissant(out)
    glance = dict(
        [cell.strip() for cell in line.strip("|").split(" | ")]
        for line in text.partition("## Open it")[0].splitlines()
        if line.startswith("| ") and line.count(" | ") == 1
    )
    said = [one.metadata for one in about.values()]
    simulated = sum(one.extra.get("simulated") is True for one in said)
    shown = {0: None, len(said): "all"}.get(simulated, f"{simulated} of {len(said)} sequences")
    assert glance.get("simulated") == shown
    assert content.get("rai:hasSyntheticData", False) is bool(simulated)
    assert ("simulation" in front_matter(out)["tags"]) is bool(simulated)
    assert ("recorded in a simulator" in text) is bool(simulated)
    frames = sum(len(one.scan_frames()) for one in about.values())
    assert glance["frames"] == f"{frames} in {len(said)} sequence{'s' * (len(said) > 1)}"
    assert (
        glance["sensors"] == ", ".join(sorted({s.sensor for s in said if s.sensor})) or "not named"
    )
    assert glance["axes"] == " and ".join(sorted({one.axes for one in said})) + "-handed"
    assert glance.get("place") == stated.get("place") == content.get("spatialCoverage")
    assert ("Faces are blurred." in text) is bool(stated)
    assert "Personal data" not in text or stated
    sources = {one.source: one.extra.get("citation") for one in said if one.source}
    citation = text.partition("## Citation")[2]
    for source, paper in sources.items():
        assert f"- {source}: {paper}" in citation
    assert ("@misc{data}" in citation) is bool(stated)
    assert "MotionSC" not in text and "MotionSC" not in json.dumps(content)
    assert "pip install" not in text and "This is a draft" not in text
    assert "creativeWorkStatus" not in content
    assert set(content.get("prov:wasDerivedFrom", [])) == set(sources)
    (licence,) = {one.extra.get("license", "CC BY 4.0") for one in said}
    assert glance["licence"] == licence
