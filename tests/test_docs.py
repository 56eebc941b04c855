"""The documentation is true: its commands and scripts run, its figures are up to date, each command
and option exists and has a page.
"""

import ast
import os
import re
import shlex
import shutil
import subprocess
import sys
from doctest import ELLIPSIS, NORMALIZE_WHITESPACE, OutputChecker
from functools import cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import carlasc
from carlasc import cli
from carlasc.cli.flags import declared_by
from carlasc.converting import converter_names, exporter_names

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = {str(path.relative_to(DOCS)): path for path in sorted(DOCS.rglob("*.md"))}
START = "start.md"
FENCE = re.compile(r"^```(\w+)([^\n]*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
END = "\x1e"  # between the outputs of two commands


def blocks(page, language):
    """Return (options, text) of the fenced blocks of a page in a language."""
    return [
        (match[2], match[3])
        for match in FENCE.finditer(PAGES[page].read_text())
        if match[1] == language
    ]


def scripts(page):
    """Return the scripts that a page tells its reader to save, by name."""
    named = [
        (re.search(r'title="([^"]+)"', options), text) for options, text in blocks(page, "python")
    ]
    return {name[1]: text for name, text in named if name}


def session(page):
    """Return the (command, expected output) of a page's console blocks, in order."""
    steps = []
    for _, text in blocks(page, "console"):
        for line in text.splitlines():
            if line.startswith("$ "):
                steps.append((line[2:], []))
            else:
                steps[-1][1].append(line)
    return [(command, "\n".join(lines)) for command, lines in steps]


def packages_for(page):
    """Return (extras, packages) that a page tells its reader to install before its last session;
    "start here" has told to install `demo`.
    """
    before = PAGES[page].read_text().rpartition("```console")[0]
    lines = [
        line
        for block in re.findall(r"```(?:sh|bash)\n(.*?)```", before, re.DOTALL)
        for line in block.splitlines()
    ]
    wanted = " ".join(line.partition("#")[0] for line in lines if line.startswith("pip install "))
    extras = {
        extra for group in re.findall(r"\.\[([\w,]+)\]", wanted) for extra in group.split(",")
    }
    return extras | {"demo"}, set(re.findall(r"(?<= )[a-z][\w-]+", wanted)) - {"install"}


@pytest.fixture(scope="session")
def environment(tmp_path_factory):
    """Makes the environment of a page's reader, with nothing but what the page tells to install;
    the folder of its programs.
    """
    made = {}

    def make(page):
        extras, packages = packages_for(page)
        key = (*sorted(extras), *sorted(packages))
        if key not in made:
            folder = tmp_path_factory.mktemp("environment") / ".venv"
            subprocess.run([sys.executable, "-m", "venv", folder], check=True)
            torch = ["torch==2.13.0"] if {"train", "torch"} & extras else []
            wanted = [
                *torch,
                *sorted(packages),
                "--editable",
                f"{ROOT}[{','.join(sorted(extras))}]",
            ]
            wanted += ["--constraint", str(ROOT / "constraints.txt")]
            python = folder / "bin" / "python"
            ways = (
                [sys.executable, "-m", "uv", "pip", "install", "--python", python],
                [python, "-m", "pip", "install"],
            )
            for way in ways:  # uv is faster and does not read pip's settings, such as a mirror
                ran = subprocess.run(
                    [*way, "--quiet", *wanted], check=False, capture_output=True, text=True
                )
                if ran.returncode == 0:
                    break
            if ran.returncode and re.search(
                r"Could not find a version|No matching distribution|Connection", ran.stderr
            ):
                pytest.skip(f"no package index within reach: {ran.stderr.strip().splitlines()[-1]}")
            assert ran.returncode == 0, ran.stderr
            made[key] = python.parent
        return made[key]

    return make


def play(page, folder, programs):
    """Run a page's commands in one shell, with the programs of an environment; return (command,
    expected, found, exit code) of each.
    """
    for name, text in scripts(page).items():
        (folder / name).write_text(text)
    steps = session(page)
    script = "".join(
        f"{command}\n__code=$?; printf '%d{END}' $__code; (exit $__code)\n" for command, _ in steps
    )
    environment = os.environ | {"PATH": f"{programs}:{os.environ['PATH']}", "COLUMNS": "160"}
    ran = subprocess.run(
        ["bash"],
        check=False,
        input=script,
        cwd=folder,
        env=environment,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    # on slow machines; after "...", it is in the line of a step
    progress = rf"(?:^|(?<={END})|(?<=\.\.\.))[^{END}\n.]+: \d+ of \d+ [\w ]+, \d+ s\n"
    printed = re.sub(progress, "", ran.stdout, flags=re.MULTILINE)
    outputs = [
        re.fullmatch(r"(.*?)(\d+)", output, re.DOTALL).groups()
        for output in printed.split(END)[:-1]
    ]
    assert len(outputs) == len(steps), ran.stdout
    return [(*step, found, int(code)) for step, (found, code) in zip(steps, outputs, strict=True)]


def check(results):
    """Compare what commands printed; those whose output is an error must have failed, the others
    not.
    """
    checker = OutputChecker()
    for command, expected, found, code in results:
        assert checker.check_output(
            f"{expected}\n",
            found if found.endswith("\n") else f"{found}\n",
            ELLIPSIS | NORMALIZE_WHITESPACE,
        ), f"$ {command}\nexpected:\n{expected}\nfound:\n{found}"
        assert (code != 0) == expected.startswith("carlasc: "), (
            f"$ {command}\nexit code {code}:\n{found}"
        )


@pytest.fixture(scope="session")
def started(tmp_path_factory, environment):
    """The folder of a reader who followed "start here", and what each command printed."""
    folder = tmp_path_factory.mktemp("start")
    return folder, play(START, folder, environment(START))


@pytest.mark.slow
def test_start_here_works_from_the_demo_to_the_training_step(started):
    folder, results = started
    check(results)
    assert any(command.startswith("python") for command, *_ in results)
    assert (folder / "town" / "fine.png").stat().st_size > 10_000
    assert (folder / "town" / "Train" / "Demo_Heavy" / "mine.png").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if page != START and session(page)])
def test_commands_of_a_page_print_what_it_shows(page, started, environment, tmp_path):
    shutil.copytree(started[0] / "town", tmp_path / "town", copy_function=os.link)
    check(play(page, tmp_path, environment(page)))


def command_lines():
    """Return (page, line) of every line in the documentation that runs carlasc."""
    for page, path in PAGES.items():
        texts = [
            text for language in ("bash", "sh", "console") for _, text in blocks(page, language)
        ]
        texts += re.findall(r"(?:^    .*\n)+", path.read_text(), re.MULTILINE)
        for line in "\n".join(texts).splitlines():
            found = re.match(r"\s*(?:\$ )?(carlasc [a-z]+(?: .*)?)$", line)
            if found and "[" not in found[1].split("#")[0]:  # a synopsis is no command
                yield page, found[1]


@pytest.mark.slow
@pytest.mark.parametrize(("page", "line"), sorted(set(command_lines())))
def test_commands_in_the_docs_have_the_options_that_they_are_given(page, line):
    name, *arguments = shlex.split(line, comments=True)[1:]
    command = group().commands[name]
    arguments = arguments[
        : next((i for i, part in enumerate(arguments) if part in (">", "|", "&&")), None)
    ]
    command.make_context(name, arguments)  # reads the arguments and runs nothing


@cache
def group():
    from typer.main import get_command

    return get_command(cli.app)


def inline_code():
    """Return (page, text) of the code between backticks in the prose of the documentation and of
    the README.
    """
    for page, path in {"README.md": ROOT / "README.md", **PAGES}.items():
        prose = re.sub(r"^```.*?^```$", "", path.read_text(), flags=re.MULTILINE | re.DOTALL)
        yield from ((page, text) for text in re.findall(r"`([^`\n]+)`", prose))


def options_named_in(text):
    return re.findall(r"(?<!\S)--[a-z][a-z0-9-]*", text)


def options_of_examples():
    """Return the options of the scripts in examples/: those that are declared, and those made of
    the names of parameters.
    """
    found = set()
    for path in (ROOT / "examples").rglob("*.py"):
        found.update(re.findall(r'Option\(\s*"(--[a-z-]+)"', path.read_text()))
        found.update(
            "--" + name.replace("_", "-")
            for name in re.findall(r"^    (\w+): Annotated", path.read_text(), re.M)
        )
    return found


def problems_of(page, text, commands):
    """Return what is wrong with a piece of inline code that names a command or an option."""
    everywhere = {"--help", "--version"}
    if named := re.match(r"carlasc ([a-z]+)\b", text):
        if named[1] not in commands:
            return [f"{page}: `{text}`: there is no command {named[1]}"]
        known = commands[named[1]] | everywhere
    elif text.startswith(("-", "carlasc -")):
        known = set().union(*commands.values()) | everywhere | options_of_examples()
    else:  # another program
        return []
    return [
        f"{page}: `{text}`: there is no option {option}"
        for option in options_named_in(text)
        if option not in known
    ]


@cache
def options_of_commands():
    return {
        name: options_of(command) | declared_options(name)
        for name, command in group().commands.items()
    }


def options_of(command):
    return {
        option
        for parameter in command.params
        for option in (*parameter.opts, *parameter.secondary_opts)
    }


def declared_options(name):
    """Return the options that converters or exporters declare, where the command takes them."""
    if name not in ("convert", "export"):
        return set()
    names = converter_names() if name == "convert" else exporter_names()
    kind = import_module(f"carlasc.cli.{name}").DECLARED_BY
    declared = [declared_by(kind, [one]) for one in names]
    commands = [cli.make_command(name, options) for options in declared if options]
    documented = {"--above-m"} if name == "export" else set()  # of the exporter that a page writes
    return documented.union(*map(options_of, commands))


def test_commands_and_options_in_the_text_exist():
    commands = options_of_commands()
    assert not [
        problem for page, text in inline_code() for problem in problems_of(page, text, commands)
    ]


@pytest.mark.parametrize(
    ("text", "sound"),
    [
        ("carlasc info --json", True),
        ("carlasc info --workers 2", False),
        ("carlasc mend", False),
        ("--overwrite", True),
        ("--overwrite=yes --nonsense", False),
        ("pytest --nonsense", True),
    ],
)
def test_a_command_or_option_that_does_not_exist_is_found(text, sound):
    assert (problems_of("page.md", text, options_of_commands()) == []) is sound


def messages(part):
    """Return patterns of the texts that the errors of the package have in a part."""
    for folder in ("carlasc", "converters"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.keyword) and node.arg == part:
                    for text in ast.walk(node.value):
                        if isinstance(text, ast.Constant) and isinstance(text.value, str):
                            yield re.escape(text.value)
                        elif isinstance(text, ast.JoinedStr):
                            pieces = (
                                re.escape(str(getattr(piece, "value", "")))
                                if isinstance(piece, ast.Constant)
                                else ".+"
                                for piece in text.values
                            )
                            yield "".join(pieces)


def quoted_errors():
    """Return (page, what was expected) of each error message that the documentation quotes."""
    for page, path in PAGES.items():
        for text in re.findall(r"(?:carlasc: |\")[^\n\"]*?expected ([^\n\"]*)", path.read_text()):
            yield page, re.split(r", found |\.\.\.", text)[0].strip()


@pytest.mark.slow
def test_error_messages_that_are_quoted_exist():
    quoted = sorted(set(quoted_errors()))
    patterns = [re.compile(pattern) for pattern in messages("expected")]
    assert len(quoted) > 5
    for page, expected in quoted:
        assert any(pattern.fullmatch(expected) for pattern in patterns), (
            f"{page}: no error says: expected {expected}"
        )


@pytest.fixture(scope="session")
def hooks():
    sys.path.insert(0, str(DOCS))
    try:
        import hooks
    finally:
        sys.path.remove(str(DOCS))
    return hooks


def test_the_site_names_the_repository_once_it_has_an_address(hooks, monkeypatch):
    page = SimpleNamespace(meta={}, file=SimpleNamespace(src_uri="howto/page.md"))
    text = "      - uses: ./carlasc\n"
    monkeypatch.setattr(hooks, "_REPOSITORY", "")
    config = hooks.on_config(SimpleNamespace(nav=[], docs_dir=str(DOCS)))
    assert not hasattr(config, "repo_url") and carlasc.__version__ in config.copyright
    assert hooks.on_page_markdown(text, page) == text
    monkeypatch.setattr(hooks, "_REPOSITORY", "https://github.com/org/carlasc")
    config = hooks.on_config(config)
    assert config.repo_url == "https://github.com/org/carlasc"
    assert config.site_url == "https://org.github.io/carlasc/"
    assert f"uses: org/carlasc@v{carlasc.__version__}" in hooks.on_page_markdown(text, page)


def test_every_command_has_a_page_and_every_page_a_command(hooks):
    pages = {
        page.removeprefix("commands/").removesuffix(".md")
        for page in PAGES
        if page.startswith("commands/")
    }
    assert pages == {hooks.PAGE_OF.get(command, command) for command in group().commands}
    for command, page in hooks.PAGE_OF.items():
        assert f"## carlasc {command}\n" in PAGES[f"commands/{page}.md"].read_text()


def test_option_tables_name_every_option(hooks):
    options_of, command_names = hooks.options_of, hooks.command_names
    assert command_names() == list(group().commands)
    for name, command in group().commands.items():
        table = options_of(name)
        for parameter in command.params:
            names = (
                parameter.opts if parameter.opts[0].startswith("-") else [parameter.name.upper()]
            )
            for option in names:
                if option != "--help":
                    assert f"`{option}`" in table, f"{name}: {option}"


def test_pages_hold_the_tables_that_the_code_has_now(hooks):
    filled = [
        page
        for page, path in PAGES.items()
        if path.read_text() != hooks.fill(path.read_text(), page)
    ]
    assert not filled, "python docs/hooks.py"
    assert all(
        "<!-- generated: options -->" in PAGES[page].read_text()
        for page in PAGES
        if page.startswith("commands/")
    )


def test_the_api_lists_every_public_name():
    listed = re.findall(r"`(?:carlasc\.)?(\w+)`", PAGES["api/index.md"].read_text())
    assert set(carlasc.__all__) <= set(listed)


def test_no_page_is_only_api():
    for page, path in PAGES.items():
        prose = re.sub(r"^:::.*\n(?: {4}.*\n)*|^#.*\n", "", path.read_text(), flags=re.MULTILINE)
        assert len(prose.split()) >= 12, page


@pytest.fixture(scope="session")
def figures():
    for package in ("matplotlib", "PIL", "embreex"):
        pytest.importorskip(package)
    sys.path.insert(0, str(DOCS))
    try:
        import figures
    finally:
        sys.path.remove(str(DOCS))
    return figures


@pytest.mark.parametrize(
    "name",
    ["frames.svg", "votes.svg", "steps.svg", "../assets/logo.svg"],
    ids=lambda name: name[-9:],
)
def test_drawings_are_those_that_the_script_draws(name, figures):
    if (
        f"matplotlib=={version('matplotlib')}"
        not in (ROOT / "constraints.txt").read_text().splitlines()
    ):
        pytest.skip("drawn by another version of matplotlib")
    assert figures.draw(name).decode() == (figures.IMAGES / name).read_text()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["town.png", "grids.png"])
def test_pictures_are_those_that_the_script_draws(name, figures, tmp_path):
    from PIL import Image

    (tmp_path / name).write_bytes(figures.draw(name))
    ours, theirs = (
        np.asarray(Image.open(folder / name).convert("RGB"), int)
        for folder in (tmp_path, figures.IMAGES)
    )
    assert ours.shape == theirs.shape
    assert np.abs(ours - theirs).mean() < 2  # of 255; quantising may choose other colours elsewhere


def test_pictures_are_small_and_shown_on_a_page(figures):
    shown = "".join(path.read_text() for path in (*PAGES.values(), ROOT / "README.md"))
    for image in figures.IMAGES.iterdir():
        assert image.stat().st_size < 300_000, image.name
        assert f"images/{image.name}" in shown, image.name


@pytest.mark.slow
def test_help_loads_nothing_heavy():
    heavy = {"numba", "scipy", "trimesh", "torch", "zarr", "h5py", "pyarrow", "matplotlib"}
    heavy |= {"PIL", "fsspec"}
    for name in group().commands:
        code = (
            "import sys; from carlasc.cli import main; sys.argv = ['carlasc', sys.argv[1], "
            "'--help']\n"
            f"try: main()\nfinally: print('loaded:', sorted({heavy} & set(sys.modules)))"
        )
        ran = subprocess.run(
            [sys.executable, "-c", code, name], capture_output=True, text=True, check=True
        )
        assert "Usage: carlasc" in ran.stdout and ran.stdout.rstrip().endswith("loaded: []"), name


@pytest.mark.parametrize(
    ("typed", "offered"), [("carlasc reg", "regrid"), ("carlasc regrid --pre", "--preset")]
)
def test_shells_complete_commands_and_options(typed, offered):
    carlasc = [
        sys.executable,
        "-c",
        "import sys; sys.argv = ['carlasc']; from carlasc.cli import main; main()",
    ]
    asked = {
        "_CARLASC_COMPLETE": "complete_bash",
        "COMP_WORDS": typed,
        "COMP_CWORD": str(len(typed.split()) - 1),
    }
    ran = subprocess.run(
        carlasc, check=False, env=os.environ | asked, capture_output=True, text=True
    )
    assert offered in ran.stdout.split()


def anchors(page):
    """Return the anchors of the headings of a page, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", heading.strip().lower()).replace(" ", "-") for heading in headings
    }


def test_links_lead_somewhere_on_github_too():
    for page in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *PAGES.values()):
        text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
        for target, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)\s]+))?\)", text):
            if "://" not in target:
                file = page.parent / target if target else page
                assert file.exists(), f"{page}: {target}"
                assert not anchor or anchor in anchors(file), f"{page}: {target}#{anchor}"
