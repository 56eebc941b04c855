"""What is installed: the contents of the wheel, the version, and the packages that it needs."""

import json
import os
import re
import subprocess
import sys
import tarfile
import tomllib
from importlib.metadata import PackageNotFoundError, distribution, requires, version
from pathlib import Path
from zipfile import ZipFile

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import carlasc

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
BUILD_ONLY = {"build.sh", "three.entry.mjs"}  # files of the page that only its bundling needs


def pins():
    """Return the version of each package in constraints.txt."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    return {
        canonicalize_name(name): pin
        for name, pin in (ln.split("==") for ln in lines if not ln.startswith("#"))
    }


def installed_for(name, extras=frozenset()):
    """Return the names of all packages that a package with these extras needs in this environment,
    its own included.
    """
    found, open_ends = {}, [(canonicalize_name(name), frozenset(extras))]
    while open_ends:
        package, chosen = open_ends.pop()
        if chosen | {""} <= found.get(package, set()):
            continue
        found.setdefault(package, set()).update(chosen | {""})
        for line in requires(package) or ():
            needed = Requirement(line)
            if needed.marker is None or any(
                needed.marker.evaluate({"extra": extra}) for extra in chosen | {""}
            ):
                open_ends.append((canonicalize_name(needed.name), frozenset(needed.extras)))
    return set(found)


def test_the_wheel_holds_the_packages_and_nothing_that_only_builds_them(tmp_path):
    pytest.importorskip("hatchling")
    command = [
        sys.executable,
        "-m",
        "hatchling",
        "build",
        "--target",
        "wheel",
        "--directory",
        str(tmp_path),
    ]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.name == f"carlasc-{carlasc.__version__}-py3-none-any.whl"
    with ZipFile(wheel) as archive:
        held = {name for name in archive.namelist() if ".dist-info/" not in name}
        metadata = {Path(name).name for name in archive.namelist() if ".dist-info/" in name}
    folders = {
        "carlasc": ROOT,
        "carlasc_converters": ROOT / "converters",
        "carlasc_recorders": ROOT / "converters",
    }
    there = {
        path.relative_to(parent).as_posix()
        for folder, parent in folders.items()
        for path in (parent / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.name not in BUILD_ONLY
    }
    assert held == there
    assert {"carlasc/py.typed", "carlasc/viewing/page/assets/template.html"} <= held
    assert {"METADATA", "entry_points.txt", "LICENSE"} <= metadata


def test_the_version_is_in_one_place():
    assert "version" in PROJECT["dynamic"]
    assert version("carlasc") == carlasc.__version__
    cited = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited is None or cited[1] == carlasc.__version__


def test_every_requirement_has_a_lowest_version():
    lines = PROJECT["dependencies"] + [
        line for lines in PROJECT["optional-dependencies"].values() for line in lines
    ]
    for needed in map(Requirement, lines):
        # the package's own extras; the stubs follow PyYAML
        if needed.name not in (
            "carlasc",
            "types-PyYAML",
        ):
            assert any(one.operator == ">=" for one in needed.specifier), needed


FOR_DEVELOPERS, SETS = {"dev", "docs", "study", "faults"}, {"all", "demo", "train", "convert"}
HEAVY = {"torch", "view", "rerun", "ray", "carla"}  # large, and carla has few wheels


def test_all_is_every_extra_but_sets_of_others_the_heavy_ones_and_those_of_developers():
    extras = PROJECT["optional-dependencies"]
    (line,) = extras["all"]
    assert Requirement(line).extras == set(extras) - FOR_DEVELOPERS - SETS - HEAVY


def test_the_table_of_extras_names_each_and_nothing_that_is_none():
    page = (ROOT / "docs" / "howto" / "install.md").read_text().partition("## Extras")[2]
    rows = re.findall(r"^\| (`.*?) \|", page, re.MULTILINE)
    assert set(re.findall(r"`([a-z0-9]+)`", " ".join(rows))) == set(
        PROJECT["optional-dependencies"]
    )


@pytest.mark.skipif(
    sys.version_info[:2] != (3, 11) or sys.platform != "linux", reason="where the pins were made"
)
def test_constraints_pin_what_the_tests_install_and_nothing_else():
    try:
        needed = installed_for("carlasc", ("all", "torch", "view", "rerun", "dev")) - {"carlasc"}
    except PackageNotFoundError as error:
        pytest.skip(f"not all extras are installed: {error.name}")
    pinned = pins()
    if distribution("numpy").version != pinned["numpy"]:
        pytest.skip("this environment was not installed with constraints.txt")
    assert needed == set(pinned)
    assert {name for name in needed if version(name).partition("+")[0] != pinned[name]} == set()


def test_links_of_the_readme_lead_to_the_repository_once_it_has_an_address(monkeypatch):
    pytest.importorskip("hatchling")
    monkeypatch.syspath_prepend(str(ROOT))
    import hatch_build

    readme, links = (ROOT / "README.md").read_text(), r"\]\(([^)]+)\)"
    relative = {
        link for link in re.findall(links, readme) if not link.startswith(("https://", "#"))
    }
    assert all((ROOT / link.partition("#")[0]).is_file() for link in relative)
    assert hatch_build.absolute(readme, "") == readme
    made = hatch_build.absolute(readme, "https://host/org/carlasc")
    assert {link for link in re.findall(links, made) if not link.startswith(("https://", "#"))} == (
        set()
    )
    for link in relative:
        assert re.search(rf"\]\(https://host/org/carlasc/(blob|raw)/main/{re.escape(link)}\)", made)
    assert hatch_build.urls("") == {} and "Source" in hatch_build.urls("https://host/org/carlasc")


def test_files_that_contributors_are_sent_to_exist():
    for page in ("CONTRIBUTING.md", "docs/contributing.md", "docs/releasing.md", "SECURITY.md"):
        text = (ROOT / page).read_text()
        named = re.findall(r"`((?:carlasc|converters|docs|tests|examples)/[\w./-]+)`", text)
        linked = [
            (ROOT / page).parent / link
            for link in re.findall(r"\]\(([^)#:]+)[^)]*\)", text)
            if "http" not in link
        ]
        missing = [
            str(path) for path in [*map(ROOT.__truediv__, named), *linked] if not path.exists()
        ]
        assert not missing, f"{page}: {missing}"


@pytest.mark.slow
def test_the_types_are_right_on_macos_too(tmp_path):
    pytest.importorskip("mypy")
    command = [sys.executable, "-m", "mypy", "--platform", "darwin", "--cache-dir", str(tmp_path)]
    ran = subprocess.run(command, cwd=ROOT, check=False, capture_output=True, text=True)
    # names that only Linux has, such as os.sched_getaffinity
    assert ran.returncode == 0, ran.stdout


@pytest.fixture(scope="module")
def from_wheel(tmp_path_factory):
    """Runs `carlasc` from the built wheel in an environment that is made for it, as `uvx` and `pipx
    run` do.
    """
    pytest.importorskip("hatchling")
    pytest.importorskip("uv")
    folder = tmp_path_factory.mktemp("wheel")
    build = [
        sys.executable,
        "-m",
        "hatchling",
        "build",
        "--target",
        "wheel",
        "--directory",
        str(folder),
    ]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    clean = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("PYTHON", "VIRTUAL_ENV"))
    }
    tool = [sys.executable, "-m", "uv", "tool", "run", "--no-config", "--python", sys.executable]

    def run(*arguments, extras="", archive=wheel):
        command = [*tool, "--from", f"carlasc{extras} @ {archive.as_uri()}", "carlasc", *arguments]
        return subprocess.run(
            command, cwd=folder, env=clean, check=False, capture_output=True, text=True
        )

    ran = run("--version")
    if ran.returncode and re.search(
        r"error sending request|No solution found|dns error|not found in the", ran.stderr
    ):
        pytest.skip(f"no package index within reach: {ran.stderr.strip().splitlines()[0]}")
    assert (ran.returncode, ran.stdout.strip()) == (0, carlasc.__version__), ran.stderr
    return run


@pytest.mark.slow
def test_the_wheel_runs_without_extras_and_says_which_are_missing(from_wheel):
    ran = from_wheel("doctor", "--json")
    assert ran.returncode == 0, ran.stdout + ran.stderr
    found = json.loads(ran.stdout)
    assert found["problems"] == [] and "uv" in found["folder"]
    missing = {
        extra["name"]
        for extra in found["extras"]
        if None in [one["version"] for one in extra["packages"]]
    }
    assert {"render", "simulate", "zarr"} <= missing


@pytest.mark.slow
def test_the_demo_runs_from_the_wheel_and_ends_with_the_page(from_wheel, tmp_path):
    ran = from_wheel(
        "demo", str(tmp_path / "town"), "--count", "1", "--sensors", "2", extras="[demo]"
    )
    assert ran.returncode == 0, ran.stderr
    lines = ran.stdout.splitlines()
    assert re.fullmatch(r"simulate a town, Train \.\.\. \d+\.\d s", lines[0])
    page = re.fullmatch(r"page +(\S+) +\(open it in a browser\)", lines[-1])
    assert Path(page[1]).read_text().startswith("<!doctype html>")


@pytest.mark.slow
def test_the_source_archive_installs_and_makes_the_same_wheel(from_wheel, tmp_path):
    command = [
        sys.executable,
        "-m",
        "hatchling",
        "build",
        "--target",
        "sdist",
        "--directory",
        str(tmp_path),
    ]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    (archive,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(archive) as tar:
        tar.extractall(tmp_path, filter="data")
    (folder,) = tmp_path.glob("carlasc-*/")
    assert {"carlasc", "converters", "examples", "docs", "tests"} <= {
        path.name for path in folder.iterdir()
    }
    assert not (folder / "tests" / "data").exists() and not (folder / ".ci").exists()
    held = []
    for place in (ROOT, folder):
        out = tmp_path / f"wheel of {place.name}"
        command = [
            sys.executable,
            "-m",
            "hatchling",
            "build",
            "--target",
            "wheel",
            "--directory",
            str(out),
        ]
        subprocess.run(command, cwd=place, check=True, capture_output=True)
        with ZipFile(next(out.glob("*.whl"))) as wheel:
            held.append(
                {
                    one.filename: one.CRC
                    for one in wheel.infolist()
                    if ".dist-info/" not in one.filename
                }
            )
    assert held[0] == held[1]
    ran = from_wheel("--version", archive=archive)
    assert (ran.returncode, ran.stdout.strip()) == (0, carlasc.__version__), ran.stderr
