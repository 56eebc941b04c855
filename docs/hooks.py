"""What the documentation takes from the code as it is built: options, the layout, classes, and the
pages of the navigation.

A page says `<!-- generated: layout -->` where a table goes, and the page of a command ends with
`<!-- generated: options -->`. Whoever reads the Markdown sees the tables too: `python
docs/hooks.py` writes them into the pages, up to `<!-- generated end -->`, and a test compares.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import logging
import re
import sys
import tomllib
from collections.abc import Callable, Iterator
from enum import Enum
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
from carlasc_converters.exporters.kitti import TO_PREDICTED, TO_RAW
from carlasc_converters.exporters.opensceneflow import CATEGORIES
from mkdocs.structure.files import File
from typer.models import ArgumentInfo, ParameterInfo

import carlasc
from carlasc import cli
from carlasc.cli.flags import flatten
from carlasc.core.benchmarks import IGNORED, TO_OCC3D, TO_SSCBENCH
from carlasc.core.choices import Preset
from carlasc.core.classes import ClassTable
from carlasc.core.grids import GridSpec
from carlasc.core.tables import CARLA, OCC3D, REMAPS, SEMANTICKITTI, SSCBENCH
from carlasc.metrics import CONVENTIONS
from carlasc.storage import layout

sys.path.insert(0, str(Path(__file__).parent))
import tutorials

# below "mkdocs", so that a strict build counts its warnings
LOG = logging.getLogger("mkdocs.hooks.carlasc")
# commands on the page of another one
PAGE_OF = {
    "unpack": "pack",
    "finish": "pack",
    "scores": "evaluate",
}
# of a module
_MEMBER = re.compile(r'<h2 id="(carlasc[\w.]*)\.(\w+)" class="doc doc-heading">\s*<code[^>]*>')
# without a list of members
_MODULE = re.compile(r"^::: (carlasc[\w.]*)$(?!\n    options:)", re.MULTILINE)
_PICTURE = re.compile(r'(?<!">)<img [^>]*src="([^"]+)"[^>]*>')
_SEARCH = {"api": 0.3, "studies": 0.6, "howto": 3.0, "commands": 1.5}  # folder -> its weight
_PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())
# empty until the first release
_REPOSITORY: str = _PROJECT["tool"]["hatch"]["metadata"]["hooks"]["custom"]["repository"]
_PLACE = re.compile(r"(<!-- generated: ([a-z-]+) -->\n).*?(<!-- generated end -->)", re.DOTALL)


def on_config(config: Any) -> Any:
    """Put the pages that a `folder/*` in the navigation stands for in its place; name the version,
    and the repository once it has an address.
    """
    config.copyright = f"carlasc {carlasc.__version__}, MIT licence"
    if _REPOSITORY:
        config.repo_url, config.repo_name = _REPOSITORY, _REPOSITORY.partition("://")[2]
        host, owner, name = config.repo_name.split("/")
        if host == "github.com":  # where its pages are: links of 404.html begin there
            config.site_url = f"https://{owner}.github.io/{name}/"
    config.nav = _expand(config.nav, Path(config.docs_dir), set(_pages(config.nav)))
    return config


def on_files(files: Any, config: Any) -> Any:
    """Leave scripts and the theme out of the site, and add the notebooks."""
    for file in [f for f in files if f.src_uri.endswith(".py") or f.src_uri.startswith("theme/")]:
        files.remove(file)
    for path, content in tutorials.pages():
        files.append(File.generated(config, path, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Fill in generated tables, whatever the page has in their places, and link the pages of the
    notebooks; search finds guides before studies and the API.
    """
    page.meta["search"] = {"boost": _SEARCH.get(page.file.src_uri.partition("/")[0], 1.0)}
    if _REPOSITORY:
        action = f"{_REPOSITORY.partition('://')[2].partition('/')[2]}@v{carlasc.__version__}"
        markdown = markdown.replace("uses: ./carlasc", f"uses: {action}")
    markdown = _MODULE.sub(lambda match: match[0] + _members(match[1]), markdown)
    # they are pages of the site
    text = re.sub(r"\(\.\./examples/notebooks/(\w+)\.ipynb\)", r"(tutorials/\1.md)", markdown)
    return _PLACE.sub(
        lambda match: match[0].removeprefix(match[1]).removesuffix(match[3]),
        fill(text, page.file.src_uri),
    )


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Give classes and functions the name by which they are imported, not that of the module that
    holds them; a click on a picture opens it in full.
    """
    html = _PICTURE.sub(r'<a class="picture" href="\1">\g<0></a>', html)
    return _MEMBER.sub(lambda match: match[0] + _import_prefix(match[1], match[2]), html)


def _import_prefix(module: str, name: str) -> str:
    """Return "carlasc." or "carlasc.<room>.", whichever exports a name of a module; nothing if none
    does.
    """
    member = getattr(importlib.import_module(module), name, None)
    room = ".".join(module.split(".")[:2])
    homes = ((home, importlib.import_module(home)) for home in ("carlasc", room))
    return next(
        (f"{home}." for home, package in homes if member is getattr(package, name, home)), ""
    )


def _members(module: str) -> str:
    """Return which members of a module are documented if its page names none: its classes, and what
    else of it is exported.
    """
    if importlib.util.find_spec(module) is None:  # it is a function
        return ""
    found = importlib.import_module(module)
    own = re.findall(r"^(?:class |def )?([A-Za-z]\w*)\b", inspect.getsource(found), re.MULTILINE)
    members = {name: vars(found)[name] for name in own if name in vars(found)}
    names = [
        name
        for name, value in members.items()
        if inspect.isclass(value) or _import_prefix(module, name)
    ]
    return f"\n    options: {{ members: {names} }}"


def fill(markdown: str, page: str) -> str:
    """Return the text of a page with its generated tables as the code has them now."""
    return _PLACE.sub(
        lambda match: f"{match[1]}\n{_generate(match[2], page)}\n\n{match[3]}", markdown
    )


def command_names() -> list[str]:
    """Return the names of the commands that there are, in the order of `carlasc --help`."""
    return [name for name in cli._COMMANDS if importlib.util.find_spec(f"carlasc.cli.{name}")]


def options_of(command: str) -> str:
    """Return the section of a command's page that lists its arguments and options, by the panels of
    its `--help`.
    """
    function = flatten(getattr(importlib.import_module(f"carlasc.cli.{command}"), command))
    panels: dict[str, list[str]] = {}
    for row, panel in _parameters(function):
        panels.setdefault(panel, []).append(row)
    parts = [f"## Options of carlasc {command}", ""]
    # those of the command alone come first
    for panel, rows in sorted(panels.items(), key=lambda item: item[0] != ""):
        parts += [f"**{panel}**", ""] if panel else []
        parts += ["| option | default | |", "|---|---|---|", *rows, ""]
    return "\n".join(parts).rstrip()


def _parameters(function: Callable[..., None]) -> Iterator[tuple[str, str]]:
    """Yield a row of the table and its panel for each parameter of a command."""
    hints = get_type_hints(function, include_extras=True)
    for name, parameter in inspect.signature(function).parameters.items():
        annotation, *marks = get_args(hints[name])
        (info,) = (mark for mark in marks if isinstance(mark, ParameterInfo))
        option = f"`{'`, `'.join(_names(name, annotation, info))}`"
        if values := _values(annotation):
            option += f" {values}"
        text, _, default = (info.help or "").removesuffix("]").partition("  [default: ")
        default = f"`{default}`" if default else _default(parameter.default, info)
        row = f"| {option} | {default} | {_escape(text)} |"
        yield row, info.rich_help_panel or ""


def _names(name: str, annotation: Any, info: ParameterInfo) -> list[str]:
    if isinstance(info, ArgumentInfo):
        return [info.metavar or name.upper()]
    # typer keeps the first name where a default would stand
    given = (
        info.default,
        *(info.param_decls or ()),
    )
    declared = [part for part in given if isinstance(part, str) and part.startswith("-")]
    is_switch = annotation in (bool, bool | None)
    if is_switch and len(declared) == 1:
        return declared[0].split("/")
    dashed = name.replace("_", "-")
    return declared or ([f"--{dashed}", f"--no-{dashed}"] if is_switch else [f"--{dashed}"])


def _values(annotation: Any) -> str:
    """Return the values that an option may take, or what kind of value; nothing for a switch."""
    kinds = [kind for kind in get_args(annotation) if kind is not type(None)]
    if get_origin(annotation) is Literal:
        return _escape(" \\| ".join(f"`{value}`" for value in kinds))
    if get_origin(annotation) is list:
        return _values(kinds[0])
    if kinds:
        return _values(kinds[0]) if len(kinds) == 1 else ""
    if inspect.isclass(annotation) and issubclass(annotation, Enum):
        return " \\| ".join(f"`{value.value}`" for value in annotation)
    return {int: "integer", float: "number", Path: "path", str: "text"}.get(annotation, "")


def _default(default: Any, info: ParameterInfo) -> str:
    if default is inspect.Parameter.empty:
        return "required"
    if isinstance(info.show_default, str):
        return info.show_default
    if default is None or default is False or default == "":
        return ""
    return f"`{default.value if isinstance(default, Enum) else default}`"


def _layout() -> str:
    rows = ["| file | field | what it holds |", "|---|---|---|"]
    grid = [layout.field_named(f"{layout.EVALUATION}/{part}") for part in layout.GRID_FIELDS]
    for field in (*layout.SCAN_FIELDS.values(), *grid):
        shape = (
            "(X, Y, Z)"
            if field.per == "voxel"
            else "(N,)"
            if field.columns is None
            else f"(N, {field.columns})"
        )
        special = {
            "picture": "bytes",
            "votes": "npz",
            "velocities": "npz",
            "boxes": "[table](#boxes)",
        }
        kind = (
            special[field.kind]
            if field.kind in special
            else f"{np.dtype(field.dtype).name} {shape}"
        )
        unit = f", {field.unit}" if field.unit in ("m", "m/s") else ""
        ours = "" if field.published else " *(ours)*"
        rows.append(
            f"| `{field.file(0)}` | `{field.name}` | {kind}{unit}: {_escape(field.meaning)}{ours} |"
        )
    return "\n".join(rows)


def _grids() -> str:
    rows = [
        "| grid | `--preset` | cells | lower bounds | upper bounds | cell |",
        "|---|---|---|---|---|---|",
    ]
    for preset in get_args(Preset):
        spec = GridSpec.published(preset)
        bounds = [", ".join(f"{value:.7g}" for value in side) for side in (spec.lower, spec.upper)]
        cell = " x ".join(f"{edge:.4g}" for edge in spec.voxel_size)
        rows.append(
            f"| {spec} | `{preset}` | {spec.num_voxels:,} | {bounds[0]} | {bounds[1]} | {cell} |"
        )
    return "\n".join(rows)


def _classes() -> str:
    remap = REMAPS["carlasc11"]
    rows = ["| id | class | | of the eleven | |", "|---|---|---|---|---|"]
    for index, name in CARLA.names.items():
        target = remap.mapping[index]
        cells = (
            index,
            name,
            _swatch(CARLA, index),
            f"{target} {remap.target.names[target]}",
            _swatch(remap.target, target),
        )
        rows.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(rows)


def _remaps() -> str:
    rows = ["| name | from | to |", "|---|---|---|"]
    rows += [
        f"| `{name}` | `{remap.source.name}` | `{remap.target.name}` |"
        for name, remap in REMAPS.items()
    ]
    return "\n".join(rows)


def _conventions() -> str:
    rows = [
        "| name | benchmark | mean over | an absent class | an unknown voxel | |",
        "|---|---|---|---|---|---|",
    ]
    absent = {
        "zero": "counts 0",
        "skip": "is left out",
        "skip-truth": "is left out if it is absent from the truth",
        "nan": "makes the mean NaN",
    }
    for convention in CONVENTIONS.values():
        free = " with free" if convention.free in convention.averaged else ""
        epsilon = f"; {convention.epsilon:g} is added to each divisor" if convention.epsilon else ""
        unknown = "does not count" if convention.unknown == "left out" else "is free"
        cells = (
            f"`{convention.name}`",
            convention.title,
            f"{len(convention.averaged)} classes{free}",
            absent[convention.absent] + epsilon,
            unknown,
            convention.notes,
        )
        rows.append(f"| {' | '.join(map(_escape, cells))} |")
    return "\n".join(rows)


def _exported_classes(table: ClassTable) -> str:
    """Return what each class of a table becomes in the files of other data sets."""
    columns = (
        "`kitti`",
        "`kitti --predictions`",
        "`occ3d`, `openoccupancy`",
        "`sscbench`",
        "`opensceneflow`",
    )
    rows = [f"| {table.name} | {' | '.join(columns)} |", f"|{'---|' * (len(columns) + 1)}"]
    for index, name in table.names.items():
        occ3d, sscbench = TO_OCC3D[table.name][index], TO_SSCBENCH[table.name][index]
        cells = (
            f"{index} {name}",
            *(
                f"{raw} {SEMANTICKITTI.names[raw]}"
                for raw in (maps[table.name][index] for maps in (TO_RAW, TO_PREDICTED))
            ),
            "unknown" if occ3d == IGNORED else f"{occ3d} {OCC3D.names[occ3d]}",
            "ignored" if sscbench == IGNORED else f"{sscbench} {SSCBENCH.names[sscbench]}",
            CATEGORIES[table.name][index] or "",
        )
        rows.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(rows)


def _swatch(table: ClassTable, index: int) -> str:
    color = "#{:02x}{:02x}{:02x}".format(*table.colors[index])
    return (
        f'<span style="background:{color};border:1px solid #888;padding:0 .9em"></span> `{color}`'
    )


_TABLES: dict[str, Callable[[], str]] = {
    "layout": _layout,
    "grids": _grids,
    "classes": _classes,
    "remaps": _remaps,
    "conventions": _conventions,
    "exported-classes": lambda: _exported_classes(CARLA),
    "exported-classes-of-semantickitti": lambda: _exported_classes(SEMANTICKITTI),
}


def _generate(name: str, page: str) -> str:
    if name == "options":
        title = page.removeprefix("commands/").removesuffix(".md")
        return "\n\n".join(
            options_of(command)
            for command in command_names()
            if PAGE_OF.get(command, command) == title
        )
    if name in _TABLES:
        return _TABLES[name]()
    LOG.warning(
        "%s: expected options or one of %s to generate, found %s", page, ", ".join(_TABLES), name
    )
    return ""


def _escape(text: str) -> str:
    """Keep a text in its cell."""
    return re.sub(r"(?<!\\)\|", r"\\|", text).replace("<", "&lt;")


def _pages(nav: Any) -> Iterator[str]:
    for item in nav if isinstance(nav, list) else [nav]:
        if isinstance(item, dict):
            for value in item.values():
                yield from _pages(value)
        elif isinstance(item, str):
            yield item


def _expand(nav: list[Any], docs: Path, named: set[str]) -> list[Any]:
    """Replace each `folder/*` by the folder's pages that have no place of their own; commands in
    the order of `--help`.
    """
    expanded: list[Any] = []
    order = {f"{name}.md": place for place, name in enumerate(cli._COMMANDS)}
    for item in nav:
        if isinstance(item, dict):
            expanded.append(
                {
                    title: _expand(value, docs, named) if isinstance(value, list) else value
                    for title, value in item.items()
                }
            )
        elif item.endswith("*"):
            pages = sorted(
                docs.glob(f"{item}.md"),
                key=lambda path: (order.get(path.name, len(order)), path.name),
            )
            expanded += [
                uri for page in pages if (uri := page.relative_to(docs).as_posix()) not in named
            ]
        else:
            expanded.append(item)
    return expanded


if __name__ == "__main__":
    docs = Path(__file__).parent
    for path in docs.rglob("*.md"):
        if (text := path.read_text()) != (filled := fill(text, path.relative_to(docs).as_posix())):
            path.write_text(filled)
            print(path)
