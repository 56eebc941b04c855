"""Time of the example networks for one frame, eagerly and compiled."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from measuring.figures import Figure
from measuring.sizes import Size

_EXAMPLES = Path(__file__).parents[3] / "examples"


def measure_networks(size: Size, folder: Path) -> Iterator[tuple[str, Figure]]:
    """Yield the times of `examples/latency.py`: the least of the repetitions, wall time."""
    for threads in size.threads:
        for network in size.networks:
            arguments = ["latency.py", network, "--device", "cpu", "--json"]
            arguments += ["--threads", str(threads), "--repetitions", str(2 * size.repeats)]
            ran = subprocess.run(
                [sys.executable, *arguments],
                cwd=_EXAMPLES,
                stdout=subprocess.PIPE,
                text=True,
                check=True,
            )
            for found in json.loads(ran.stdout):
                key = f"networks.{found['network']}.{found['history']}.{found['mode']}.{threads}"
                text = (
                    f"{found['network']} T={found['history']}, {found['mode']}, {threads} threads: "
                    "least wall time per frame of 128 x 128 x 8"
                )
                yield key, Figure(found["fastest_ms"], "ms", text)
                if found["mode"] != "eager":
                    yield f"{key}.ratio", Figure(found["speedup"], "", f"{text}, eager / this")
                    yield (
                        f"{key}.differing",
                        Figure(
                            found["differing"],
                            "",
                            f"{text}: voxels per million whose label differs",
                        ),
                    )
