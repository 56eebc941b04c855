"""Makes the pictures of the gallery by running the commands of its page: `python docs/gallery.py
[SECTION ...]` writes docs/images/gallery.

Everything is simulated, so nothing has to be downloaded. The script prints how long each command
takes: fourteen minutes in all on two cores that other programs used at the same time. It needs
three gigabytes of disk while it runs. With names of sections, only these are made, with the data
that they need.
"""

from __future__ import annotations

import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

DOCS = Path(__file__).parent
PAGE = DOCS / "gallery.md"
IMAGES = DOCS / "images" / "gallery"
# writes files of other programs by the facts of their formats
WRITERS = DOCS.parent / "tests" / "helpers" / "foreign_voxels.py"


@dataclass(frozen=True)
class Section:
    """A section of the page.

    Attributes:
        title: its heading.
        commands: the lines of its blocks, in order.
        images: names of the files that it shows.
    """

    title: str
    commands: tuple[str, ...]
    images: tuple[str, ...]


def read_sections(page: Path = PAGE) -> list[Section]:
    """Return the sections of the page."""
    sections = []
    for part in re.split(r"^## ", page.read_text(), flags=re.MULTILINE)[1:]:
        blocks = re.findall(r"^```bash\n(.*?)^```", part, re.MULTILINE | re.DOTALL)
        commands = tuple(line for block in blocks for line in block.splitlines() if line.strip())
        images = tuple(re.findall(r"\]\(images/gallery/([^)]+)\)", part))
        sections.append(Section(part.splitlines()[0].strip(), commands, images))
    return sections


def make(folder: Path, images: Path, titles: Sequence[str] = ()) -> list[Path]:
    """Run the commands of the page in a folder and write small copies of the pictures.

    Args:
        folder: an empty folder, or one of an earlier call, whose data are used again.
        images: where the copies are written.
        titles: headings of the sections whose pictures are made; empty makes all. The data of the
            sections before them are made too.

    Returns:
        The copies.

    Raises:
        subprocess.CalledProcessError: a command failed.
        KeyError: there is no section of that name.
    """
    sections = read_sections()
    unknown = set(titles) - {section.title for section in sections}
    if unknown:
        raise KeyError(f"no section of the page is called {', '.join(sorted(unknown))}")
    copies = []
    runpy.run_path(str(WRITERS))["write_all"](folder / "foreign")
    for command, section in _needed(sections, titles):
        started = time.monotonic()
        subprocess.run(
            [sys.executable, "-m", *shlex.split(command)],
            cwd=folder,
            check=True,
            stdout=subprocess.DEVNULL,
        )
        print(f"{time.monotonic() - started:6.1f} s  {command}", flush=True)
        name = _output_of(command)
        if name in section.images:
            copies.append(shrink(folder / name, images / name))
    return copies


def shrink(picture: Path, copy: Path) -> Path:
    """Copy a picture; a PNG in 256 colours, of which rare ones, such as those of the legend, are
    kept.
    """
    if picture.suffix != ".png":
        shutil.copyfile(picture, copy)
        return copy
    with Image.open(picture) as image:
        small = image.convert("RGB").quantize(
            256, Image.Quantize.MAXCOVERAGE, kmeans=3, dither=Image.Dither.NONE
        )
    small.save(copy, "PNG", optimize=True)
    return copy


def _needed(sections: Sequence[Section], titles: Sequence[str]) -> Iterator[tuple[str, Section]]:
    """Yield the commands to run, with their sections: wanted pictures, and before them the data of
    the sequences that they show.
    """
    wanted = [section for section in sections if not titles or section.title in titles]
    words = {
        section.title: [shlex.split(command) for command in section.commands]
        for section in sections
    }
    folders = {line[2] for lines in words.values() for line in lines if line[1] == "simulate"}
    shown = {
        word.split("/")[0]
        for section in wanted
        for line in words[section.title]
        for word in line[2:]
    } & folders
    for section in sections[: 1 + max(map(sections.index, wanted), default=-1)]:
        for command in section.commands:
            _, name, place, *_ = shlex.split(command)
            if section in wanted or (name != "render" and place in shown):
                yield command, section


def _output_of(command: str) -> str:
    """Return the file that a command draws, or ""."""
    words = shlex.split(command)
    return words[words.index("-o") + 1] if words[1] == "render" else ""


def main() -> None:
    """Make the pictures of the sections that the command line names, or all of them."""
    started = time.monotonic()
    IMAGES.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        copies = make(Path(folder), IMAGES, sys.argv[1:])
    for copy in copies:
        print(f"{copy.stat().st_size / 1000:8.0f} kB  {copy.name}")
    print(
        f"{time.monotonic() - started:.0f} s, "
        f"{sum(path.stat().st_size for path in IMAGES.iterdir()) / 1e6:.2f} MB in all"
    )


if __name__ == "__main__":
    main()
