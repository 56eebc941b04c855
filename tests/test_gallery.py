import importlib.util
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.readers.pictures import Image

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def gallery():
    spec = importlib.util.spec_from_file_location("gallery", ROOT / "docs" / "gallery.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["gallery"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["gallery"]


def test_the_page_shows_what_its_commands_draw_and_nothing_else(gallery):
    sections = gallery.read_sections()
    shown = [name for section in sections for name in section.images]
    drawn = [
        shlex.split(line) for section in sections for line in section.commands if " render " in line
    ]
    assert [words[words.index("-o") + 1] for words in drawn] == shown
    assert sorted(shown) == sorted(path.name for path in gallery.IMAGES.iterdir())
    assert len([name for name in shown if name.endswith(".png")]) == 26
    assert len([name for name in shown if name.endswith(".webp")]) == 2


def test_every_command_of_the_page_parses(gallery):
    from typer.main import get_command

    from carlasc.cli import app

    commands = get_command(app).commands
    lines = [line for section in gallery.read_sections() for line in section.commands]
    assert len(lines) > 20
    for line in lines:
        program, name, *arguments = shlex.split(line)
        assert program == "carlasc"
        commands[name].make_context(name, arguments)  # reads the arguments and runs nothing


def test_data_are_made_before_they_are_drawn(gallery):
    made = set()
    for section in gallery.read_sections():
        for line in section.commands:
            name, *arguments = shlex.split(line)[1:]
            if name == "simulate":
                made.add(arguments[0])
            for place in re.findall(r"(?:^| )(town|instant|one|four)\b", line):
                assert place in made, line


def test_pictures_are_small_and_whole(gallery):
    for path in gallery.IMAGES.iterdir():
        with Image.open(path) as picture:
            picture.load()
            assert picture.size[0] >= 800 and picture.size[1] >= 300, path.name
            if path.suffix == ".png":
                assert picture.mode == "P" and path.stat().st_size < 450_000, path.name
            else:
                assert picture.n_frames >= 30 and picture.info["loop"] == 0
                assert path.stat().st_size < 3_000_000, path.name
    assert sum(path.stat().st_size for path in gallery.IMAGES.iterdir()) < 6_000_000


def test_the_readme_begins_with_a_picture_of_the_result():
    head = (ROOT / "README.md").read_text()[:1500]
    assert "](docs/images/traces.png)" in head


def test_only_the_data_that_a_section_needs_are_made(gallery):
    sections = gallery.read_sections()
    lines = [line.split()[1:3] for line, _ in gallery._needed(sections, ["A cylindrical grid"])]
    assert lines == [
        ["simulate", "instant"],
        ["regrid", "instant"],
        ["regrid", "instant"],
        ["render", "instant/cylindrical"],
    ]
    lines = [line.split()[1:3] for line, _ in gallery._needed(sections, ["Scene flow"])]
    assert lines == [["simulate", "town"], ["regrid", "town"], ["render", "town"]]
    assert len(list(gallery._needed(sections, []))) == sum(
        len(section.commands) for section in sections
    )
    with pytest.raises(KeyError, match="Nothing"):
        gallery.make(ROOT, ROOT, ["Nothing"])


@pytest.mark.slow
def test_pictures_are_those_that_the_commands_draw(gallery, tmp_path):
    pytest.importorskip("embreex")
    copies = gallery.make(
        tmp_path, tmp_path, ["The published grid", "A cylindrical grid", "How many sensors"]
    )
    assert [copy.name for copy in copies] == ["coarse.png", "cylindrical.png", "sensors.png"]
    for copy in copies:
        ours, theirs = (
            np.asarray(Image.open(folder / copy.name).convert("RGB"), int)
            for folder in (tmp_path, gallery.IMAGES)
        )
        assert ours.shape == theirs.shape
        # of 255; quantising may choose other colours elsewhere
        assert np.abs(ours - theirs).mean() < 2
