"""How much each set of extras installs: `python docs/studies/sizes.py` prints a row as soon as it
is measured.

Each set is installed from this checkout into an environment of its own, with `-c constraints.txt`,
and deleted. torch is the build that pip finds.
"""

from __future__ import annotations

import subprocess
import time
import venv
from pathlib import Path

import study

ROOT = Path(__file__).parents[2]
SETS = (
    "",
    "demo",
    "convert",
    "train",
    "demo,convert",
    "demo,train",
    "zarr,remote",
    "view",
    "rerun",
    "all",
)


def install(extras: str, folder: Path) -> tuple[float, int, float]:
    """Install carlasc with some extras; return MB of the packages, their number, and seconds."""
    venv.create(folder, with_pip=True)
    (packages,) = folder.glob("lib/python*/site-packages")
    before = measure(packages)
    start = time.perf_counter()
    wanted = f"{ROOT}[{extras}]" if extras else str(ROOT)
    command: list[str | Path] = [
        folder / "bin" / "python",
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-compile",
    ]
    command += ["--no-deps"] if study.is_tiny() else ["--constraint", ROOT / "constraints.txt"]
    subprocess.run([*command, wanted], check=True)
    return (
        measure(packages) - before,
        len([*packages.glob("*.dist-info")]) - 1,
        time.perf_counter() - start,
    )


def measure(folder: Path) -> float:
    """Return MB of the files in a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def main() -> None:
    """Print the table."""
    parser = study.options(__doc__)
    parser.add_argument("--extras", nargs="*", default=SETS)
    print("| extras | MB | packages | seconds |\n|---|---:|---:|---:|")
    with study.begin(parser) as given:
        for extras in study.few(given.extras):
            size, packages, elapsed_s = install(extras, given.work / (extras or "none"))
            print(
                f"| `{extras or '(none)'}` | {size:,.0f} | {packages} | {elapsed_s:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
