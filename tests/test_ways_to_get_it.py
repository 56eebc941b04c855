"""What installs or runs carlasc elsewhere: the image, the recipe, the action, the guide for agents,
and the check before a release.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
import release
from packaging.requirements import Requirement

import carlasc

ROOT = Path(__file__).parents[1]
GUIDE = (ROOT / "skills" / "carlasc" / "SKILL.md").read_text()
COMMANDS = [
    line
    for block in re.findall(r"^```sh\n(.*?)^```$", GUIDE, re.MULTILINE | re.DOTALL)
    for line in block.splitlines()
]
SCRIPT = ROOT / ".github" / "check.sh"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


@pytest.mark.parametrize("line", COMMANDS)
def test_commands_of_the_guide_have_the_options_that_they_are_given(line):
    from typer.main import get_command

    from carlasc import cli

    _, name, *arguments = shlex.split(line)
    if name not in ("convert", "export"):  # their converters declare options of their own
        get_command(cli.app).commands[name].make_context(name, arguments)


@pytest.mark.slow
@pytest.mark.needs("embreex", "PIL", "rosbags", "foxglove", "kiss_icp")
def test_commands_of_the_guide_run_in_their_order(tmp_path, monkeypatch):
    from carlasc_recorders import SimulatedCapture

    from carlasc import cli
    from carlasc.captures import Lidar

    (demo, *others), lidar = COMMANDS, Lidar(channels=16, points=8_000)
    assert demo.startswith("carlasc demo town") and len(others) > 12
    # a smaller town than that of the demo, which has tests of its own
    town = SimulatedCapture(count=3, sensors=1, bev=False, lidar=lidar)
    carlasc.regrid(town, carlasc.GridSpec.published(), tmp_path / "town/Train/Demo_Heavy")
    monkeypatch.chdir(tmp_path)
    for line in others:
        monkeypatch.setattr("sys.argv", shlex.split(line))
        with pytest.raises(SystemExit) as ended:
            cli.main()
        # three scans of one LiDAR may be undetermined or have faults, which the command says
        judges = line.split()[1] in ("validate", "audit")
        assert ended.value.code == 0 or (judges and ended.value.code == 1), line
    assert {"page.html", "scene.png", "clean.ply", "audit.html"} <= {
        path.name for path in tmp_path.iterdir()
    }


def run_check(folder, **inputs):
    """Run the script of the action with a `carlasc` that prints its arguments, one a line, and
    fails where one of them is `bad`; return its result and the summary.
    """
    program = folder / "bin" / "carlasc"
    program.parent.mkdir(exist_ok=True)
    program.write_text('#!/bin/bash\nprintf "<%s>\\n" "$@"\n[[ " $* " != *" bad "* ]]\n')
    program.chmod(0o755)
    environment = {"PATH": f"{program.parent}:{os.environ['PATH']}"}
    environment["GITHUB_STEP_SUMMARY"] = str(folder / "summary.md")
    ran = subprocess.run(
        ["bash", str(SCRIPT)],
        check=False,
        cwd=folder,
        env=environment | inputs,
        capture_output=True,
        text=True,
    )
    summary = folder / "summary.md"
    return ran, summary.read_text() if summary.exists() else ""


@pytest.mark.posix("it runs a shell script")
def test_the_action_validates_and_audits(tmp_path):
    ran, summary = run_check(
        tmp_path, DATA="my data", GRIDS="grids", AUDIT_OPTIONS="--made-from -30:30", PAGE="a.html"
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.split("\n") == [
        *("<validate>", "<my data>"),
        *("<audit>", "<grids>", "<my data>", "<--html>", "<a.html>", "<--made-from>", "<-30:30>"),
        "",
    ]
    assert summary.count("```") == 4 and "<my data>" in summary


@pytest.mark.posix("it runs a shell script")
@pytest.mark.parametrize(
    ("inputs", "code", "said"),
    [
        ({"DATA": "bad", "GRIDS": "grids", "SCANS": "scans"}, 1, "<audit>"),  # both run
        ({"DATA": "data", "GRIDS": "bad"}, 1, "<validate>"),
        ({"GRIDS": "grids"}, 2, "expected scans"),
        ({}, 2, "expected data or grids"),
    ],
)
def test_the_action_fails_if_one_of_them_does(tmp_path, inputs, code, said):
    ran, _ = run_check(tmp_path, **inputs)
    assert ran.returncode == code
    assert said in ran.stdout + ran.stderr


def test_the_action_gives_its_script_every_input_that_it_reads():
    yaml = pytest.importorskip("yaml")
    action = yaml.safe_load((ROOT / "action.yml").read_text())
    *_, check = action["runs"]["steps"]
    assert set(re.findall(r"\$\{([A-Z]+(?:_OPTIONS)?):-", SCRIPT.read_text())) == set(check["env"])
    given = " ".join(json.dumps(step) for step in action["runs"]["steps"])
    assert set(re.findall(r"inputs\.([\w-]+)", given)) == set(action["inputs"])
    assert SCRIPT.relative_to(ROOT).as_posix() in check["run"]


def test_the_image_copies_what_the_package_is_built_from():
    text = (ROOT / "Dockerfile").read_text()
    kept = {
        line[1:]
        for line in (ROOT / ".dockerignore").read_text().splitlines()
        if line.startswith("!")
    }
    packages = PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    assert {package.partition("/")[0] for package in packages} <= kept
    assert {"hatch_build.py", "pyproject.toml", "README.md", "LICENSE", "constraints.txt"} <= kept
    assert all((ROOT / name).exists() for name in kept)
    (extras,) = re.findall(r"\.whl\)\[(\w+)\]", text)
    assert extras in PROJECT["project"]["optional-dependencies"]
    # the version with which constraints.txt was made
    assert set(re.findall(r"^FROM python:(\S+)-slim", text, re.MULTILINE)) == {"3.11"}


def test_the_recipe_needs_what_the_package_needs():
    yaml = pytest.importorskip("yaml")
    text = (ROOT / "recipe" / "meta.yaml").read_text()
    plain = re.sub(r"\{\{ (\w+) \}\}", r"\1", re.sub(r"^\{%.*%\}$", "", text, flags=re.MULTILINE))
    recipe = yaml.safe_load(plain)

    def named(lines):
        return {
            re.sub("[_-]+", "-", one.name): str(one.specifier) for one in map(Requirement, lines)
        }

    needed = named(PROJECT["project"]["dependencies"])
    needed["python"] = PROJECT["project"]["requires-python"]
    assert named(line.replace(" ", "") for line in recipe["requirements"]["run"]) == needed
    (host,) = PROJECT["build-system"]["requires"]
    assert host.replace(">=", " >=") in recipe["requirements"]["host"]
    assert recipe["build"]["entry_points"] == [
        f"{name} = {target}" for name, target in PROJECT["project"]["scripts"].items()
    ]


def test_the_container_for_developers_installs_the_tests():
    made = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text())
    assert "-c constraints.txt -e '.[all,dev]'" in made["postCreateCommand"]


FILES = (
    "pyproject.toml",
    "carlasc/__init__.py",
    "recipe/meta.yaml",
    "CITATION.cff",
    "CHANGELOG.md",
)


@pytest.fixture
def checkout(tmp_path):
    """A copy of the files that a release depends on, ready for it."""
    for name in FILES:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    change(tmp_path, "pyproject.toml", 'repository = ""', 'repository = "https://host/org/carlasc"')
    change(tmp_path, "CITATION.cff", "license:", "date-released: 2030-01-02\nlicense:")
    change(tmp_path, "CHANGELOG.md", "## Unreleased (0.1.0)", "## 0.1.0 (2030-01-02)")
    return tmp_path


def change(folder, name, old, new):
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new))


def test_a_release_needs_the_address_of_the_repository(checkout):
    assert release.missing(checkout, f"v{carlasc.__version__}") == []
    change(checkout, "pyproject.toml", "https://host/org/carlasc", "")
    (problem,) = release.missing(checkout)
    assert problem.startswith("pyproject.toml: repository is empty")


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("CITATION.cff", "date-released", "released"),
        ("CITATION.cff", "version: 0.1.0", "version: 9.9.9"),
        ("recipe/meta.yaml", '"0.1.0"', '"9.9.9"'),
        ("CHANGELOG.md", "## 0.1.0", "## Unreleased"),
    ],
)
def test_a_release_needs_one_version_and_a_date(checkout, name, old, new):
    change(checkout, name, old, new)
    (problem,) = release.missing(checkout)
    assert problem.startswith(f"{name}:")


def test_a_tag_is_the_version(checkout):
    (problem,) = release.missing(checkout, "v9.9.9")
    assert "the tag is v9.9.9" in problem
