"""Pictures of real drives: `python docs/studies/real_pictures.py CONVERTER SOURCE OUT [FRAMES]` converts a data set and draws some frames.

OUT gets the converted data set in OUT/data, and two pictures of each frame: the scan by class beside the grid, and the flow. FRAMES are
numbers separated by commas; by default three frames of the first recording. The pictures of most data sets may not be passed on: see the
licence on the page of the data set.
"""

from __future__ import annotations

import sys
from pathlib import Path

import carlasc
from carlasc.groundtruth import FromScans, GridOptions
from carlasc.viewing import Scene

WINDOW = (-30, 30)


def main(converter: str, source: Path, out: Path, chosen: list[int]) -> None:
    """Convert a data set, and draw frames of its first recording."""
    result = carlasc.convert(converter, source, out / "data", grids=GridOptions(observe=FromScans(window=WINDOW)))
    for note in result.notes:
        print(f"note: {note}")
    for failure in result.failures:
        print(f"frame {failure.frame}: {failure.message}", file=sys.stderr)
    sequence = next(iter(carlasc.open(out / "data").sequences().values()))
    frames = sequence.frames("points").tolist()
    for frame in chosen or [frames[len(frames) // 4], frames[len(frames) // 2], frames[3 * len(frames) // 4]]:
        scene = Scene(source=sequence.location, frames=(frame, frame + 1))
        for what in ("scan,grid", "flow"):
            picture = out / f"{sequence.name}_{frame:06d}_{what.replace(',', '_')}.png"
            print(
                carlasc.render(
                    scene, picture, what=what, style=carlasc.StyleOptions(size=(1600, 700)), overwrite=True
                ).out
            )


if __name__ == "__main__":
    if not 4 <= len(sys.argv) <= 5:
        raise SystemExit(__doc__)
    numbers = [int(number) for number in sys.argv[4].split(",")] if len(sys.argv) == 5 else []
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]), numbers)
