"""Complete scans: `python examples/predict.py WEIGHTS DATA [OUT]`, then `carlasc render OUT`.

DATA is anything in the CarlaSC layout, or a folder of raw `.bin` scans. Without OUT the grids are
written to DATA, as another grid.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, cast, get_args

import torch
import typer
from completion.command import progress_bar, run
from completion.inference import Mode
from completion.predicting import Model, predict_dataset, predict_scans

from carlasc import GridSpec
from carlasc.core import FrameRange
from carlasc.core.choices import Preset


def main(
    weights: Annotated[Path, typer.Argument(help="Weights: .safetensors, or a state dict as .pt.")],
    data: Annotated[
        str, typer.Argument(help="A data set, a sequence, or a folder of raw .bin scans.")
    ],
    out: Annotated[
        Path | None, typer.Argument(help="Where grids are written. Default: in DATA.")
    ] = None,
    split: Annotated[str | None, typer.Option(help="Split. Default: all.")] = None,
    grid: Annotated[
        str,
        typer.Option(
            help="Grid of the data whose geometry is predicted, or a published geometry: coarse, "
            "fine, cylindrical."
        ),
    ] = "evaluation",
    frames: Annotated[
        str | None, typer.Option(help="Frames A:B (B not included), A:, :B, or one frame A.")
    ] = None,
    history: Annotated[
        int | None,
        typer.Option(
            help="Number of scans in a stack. Default: that of the run's config.yaml, else 1."
        ),
    ] = None,
    name: Annotated[str, typer.Option(help="Name of the grid in DATA.")] = "completion",
    right_handed: Annotated[
        bool, typer.Option("--right-handed", help="Raw scans with y to the left (KITTI).")
    ] = False,
    eager: Annotated[
        bool, typer.Option("--eager", help="Do not compile the network: faster for a few frames.")
    ] = False,
    device: Annotated[str, typer.Option(help="auto, cuda or cpu.")] = "auto",
) -> None:
    """Complete every scan of a data set, or of a folder of raw scans."""
    own = torch.device(
        ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    )
    mode: Mode = "eager" if eager else "compile"
    model = Model.read(weights, history)
    geometry = GridSpec.published(cast(Preset, grid)) if grid in get_args(Preset) else grid
    raw = Path(data).is_dir() and any(Path(data).glob("*.bin"))
    with progress_bar("Completing") as progress:
        if raw:
            target = out or Path(data).absolute().with_name(f"{Path(data).absolute().name}_{name}")
            spec = geometry if isinstance(geometry, GridSpec) else GridSpec.published()
            made = predict_scans(
                model,
                Path(data),
                target,
                own,
                mode,
                spec=spec,
                right_handed=right_handed,
                progress=progress,
            )
        else:
            made = predict_dataset(
                model,
                data,
                out,
                own,
                mode,
                split=split,
                grid=geometry,
                frames=None if frames is None else FrameRange.parse(frames),
                name=name,
                progress=progress,
            )
    place = target if raw else out or f"{data}, grid {name}"
    print(f"{model.network}: {made} frames completed: {place}")


if __name__ == "__main__":
    run(main)
