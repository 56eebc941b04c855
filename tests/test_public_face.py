"""The public names as a type checker sees them: `mypy --strict` runs once, on scripts as users
write them.
"""

from __future__ import annotations

import subprocess
import sys

import pytest

import carlasc

pytest.importorskip("mypy")
pytest.importorskip("torch")

pytestmark = pytest.mark.slow

GOOD = {
    "train": """
        from carlasc import Dataset, Flip, ShardSampler
        from torch.utils.data import DataLoader

        fields = ("occupancy", "labels", "known")
        dataset = Dataset("CarlaSC", split="train", history=5, fields=fields)
        dataset.transform = Flip(dataset.spec, seed=0)
        sampler = ShardSampler(dataset, seed=0)
        position: int = sampler.state_dict(trained=2)["position"]
        loader = DataLoader(dataset, batch_size=2, sampler=sampler)
        for batch in loader:
            batch["occupancy"]
        names = dataset.classes.names[0].lower()
        side: str = dataset.axes
        """,
    "make": """
        import carlasc
        from carlasc import GridSpec

        source = carlasc.open("CarlaSC")
        for path, sequence in source.sequences().items():
            voxels: int = sequence.grid("evaluation", 0).labels.size
        spec = GridSpec.published().with_resolution([0.2])
        result = carlasc.regrid("CarlaSC", spec, run=carlasc.Run(workers=1))
        made: int = result.made
        carlasc.render("CarlaSC", "scene.png")
        """,
    "convert": """
        import carlasc

        layout = carlasc.LayoutOptions(classes="semantickitti", axes="right")
        result = carlasc.convert("kitti", "SemanticKITTI", "out", layout=layout, grids=None)
        failed: list[str] = [failure.message for failure in result.failures]
        written: dict[str, str] = carlasc.export("kitti", "out", "back").sequences
        """,
}
BAD = {  # every line from the third is an error
    "misspelt": """
        import carlasc

        carlasc.Dataset("CarlaSC", histroy=5)
        carlasc.convert("kitti", "in", "out", axis="left")
        carlasc.LayoutOptions(axes="up")
        carlasc.regrid("CarlaSC", worker=1)
        carlasc.no_such_name
        """
}


def revealing() -> str:
    """Return a script that asks for the type of every public name."""
    lines = [f"reveal_type(carlasc.{name})" for name in carlasc.__all__]
    return "\n".join(["import carlasc", *lines])


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """Return the lines that mypy prints, by script."""
    folder = tmp_path_factory.mktemp("scripts")
    scripts = GOOD | BAD | {"revealed": revealing()}
    for name, text in scripts.items():
        lines = text.splitlines()
        indent = next((len(line) - len(line.lstrip()) for line in lines if line.strip()), 0)
        (folder / f"{name}.py").write_text(
            "\n".join(line[indent:] for line in lines).strip() + "\n"
        )
    (folder / "mypy.ini").write_text("[mypy]\nstrict = True\n")
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--config-file",
        "mypy.ini",
        "--cache-dir",
        str(folder / "cache"),
        ".",
    ]
    ran = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert ran.returncode == 1, ran.stdout + ran.stderr  # the wrong script has errors
    found: dict[str, list[str]] = {name: [] for name in scripts}
    for line in ran.stdout.splitlines():
        script = line.partition(".py:")[0]
        if script in found:
            found[script].append(line)
    return found


@pytest.mark.parametrize("name", GOOD)
def test_a_sound_script_passes(report: dict[str, list[str]], name: str) -> None:
    assert report[name] == []


def test_a_misspelt_name_or_a_wrong_value_is_an_error_on_its_line(
    report: dict[str, list[str]],
) -> None:
    for number, word in enumerate(("histroy", "axis", "axes", "worker", "no_such_name"), start=3):
        messages = [
            line for line in report["misspelt"] if line.startswith(f"misspelt.py:{number}: error:")
        ]
        assert any(word in message for message in messages), report["misspelt"]


def test_no_public_name_is_any(report: dict[str, list[str]]) -> None:
    types = {}
    for line in report["revealed"]:
        number, _, text = line.partition(".py:")[2].partition(": note: Revealed type is ")
        assert text, line
        types[carlasc.__all__[int(number) - 2]] = text
    assert set(types) == set(carlasc.__all__)
    assert not [
        name for name, text in types.items() if text.strip('"') in ("Any", "builtins.object")
    ]
    assert "carlasc.core.grids.GridSpec" in types["regrid"]
    assert "carlasc.groundtruth" in types["regrid"].rpartition("->")[2]
    assert "carlasc.dataset.samples.Dataset" in types["Dataset"]


def test_a_public_functions_arguments_and_result_are_no_any(report: dict[str, list[str]]) -> None:
    for line in report["revealed"]:
        text = line.partition("Revealed type is ")[2].strip('"')
        if text.startswith("def "):
            assert not text.endswith("-> Any"), line
            assert " Any," not in text.replace("**", ""), line
