"""Hostile checkpoints of the example networks: PyTorch's format is a pickle, in a zip or alone."""

from __future__ import annotations

import io
import pickle
import sys
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from faults.hostile import Case
from faults.hostile_files import Runs, put


def cases() -> Iterator[Case]:
    """Yield the cases."""
    if not find_spec("torch"):
        return

    def read() -> None:
        sys.path.insert(0, str(Path(__file__).parents[3] / "examples"))
        from completion.weights import read_weights

        read_weights(Path("net.pt"))

    def saved(value: object) -> bytes:
        import torch

        buffer = io.BytesIO()
        torch.save(value, buffer)
        return buffer.getvalue()

    table: dict[str, Callable[[], bytes]] = {
        "that runs code": lambda: saved({"a": Runs()}),
        "that is a pickle which runs code": lambda: pickle.dumps({"a": Runs()}),
        "of another type": lambda: saved([1, 2]),
        "cut short": lambda: saved({"a": np.zeros(100)})[:-200],
        "that is no checkpoint": lambda: b"\x80\x02" + bytes(range(256)),
    }
    for name, content in table.items():
        yield Case(
            f"a checkpoint {name}",
            lambda work, content=content: put(work / "net.pt", content),
            "",
            "net.pt",
            read=read,
        )
