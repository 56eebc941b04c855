"""Networks for inference: one call from occupancy to labels, compiled with the weights as
constants.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable
from typing import Any, Literal

import torch
import torch._inductor.config as inductor
from torch import Tensor, nn

from carlasc.errors import ArgumentError, DependencyError
from completion.tasks import task_of

Mode = Literal["eager", "compile"]


class Completer(nn.Module):
    """A network from its inputs, occupancy as bytes, to classes as bytes.

    Args:
        network: in eval mode.
        dtype: the type in which the network computes.
    """

    def __init__(self, network: nn.Module, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        self.network = network
        self.dtype = dtype

    def forward(self, *inputs: Any) -> Tensor:
        """Return (B, X, Y, Z) uint8 labels for (B, T, X, Y, Z) occupancy, uint8 or float, or for
        other inputs of the network.
        """
        outputs = self.network(
            *(given.to(self.dtype) if isinstance(given, Tensor) else given for given in inputs)
        )
        return task_of(self.network).labels(outputs).to(torch.uint8)


class Compiled:
    """A module that is compiled with its weights as constants, once per shape of input.

    Batch norms are folded into convolutions, and the weights are arranged for the processor once,
    which gives most of the speed on a CPU.
    """

    def __init__(self, module: nn.Module, cudagraphs: bool = False) -> None:
        self._program: Any = torch.compile(module, dynamic=False)
        self._settings = {"freezing": True, "triton.cudagraphs": cudagraphs}
        self._shapes: set[torch.Size] = set()

    def __call__(self, occupancy: Tensor) -> Tensor:
        """Run the program; the first call with a shape compiles it."""
        with torch.no_grad():
            if occupancy.shape in self._shapes:
                return self._program(occupancy)
            # the first call compiles, and reads these settings
            with inductor.patch(self._settings):
                labels: Tensor = self._program(occupancy)
        self._shapes.add(occupancy.shape)
        return labels


def prepare(
    network: nn.Module, device: torch.device, mode: Mode = "compile", *, bf16: bool | None = None
) -> Callable[..., Tensor]:
    """Prepare a network for inference.

    Args:
        network: the network. It is put into eval mode, moved to the device and, for bf16,
            converted, all in place.
        device: the device that computes.
        mode: "eager" runs the network without compiling; "compile" compiles it at the first call,
            which takes about a minute; later calls are several times faster. On CUDA, the program
            is replayed as a CUDA graph, with channels last. Networks with inputs of variable shapes
            always run eagerly in float32.
        bf16: compute in bfloat16; None: only on CUDA with "compile".

    Returns:
        A function from (B, T, X, Y, Z) occupancy, uint8 or float, on the device, or from the other
        arguments of the network, to (B, X, Y, Z) uint8 labels.

    Raises:
        DependencyError: torch.compile needs a C++ compiler, and none is installed.
        ArgumentError: `mode` has another value.
    """
    if mode not in ("eager", "compile"):
        raise ArgumentError("mode", expected="eager or compile", found=repr(mode))
    if not task_of(network).fixed_shapes:
        mode, bf16 = "eager", False
    if bf16 is None:
        bf16 = mode == "compile" and device.type == "cuda"
    dtype = torch.bfloat16 if bf16 else torch.float32
    completer = Completer(network.to(device, dtype), dtype).eval()
    if mode == "eager":
        return torch.no_grad()(completer)
    check_compiler(device)
    for module in network.modules() if device.type == "cuda" else ():
        if isinstance(module, nn.Conv2d):
            module.weight.data = module.weight.data.contiguous(memory_format=torch.channels_last)
    return Compiled(completer, cudagraphs=device.type == "cuda")


def check_compiler(device: torch.device) -> None:
    """Raise DependencyError if torch.compile cannot find a C++ compiler."""
    names = [os.environ["CXX"]] if "CXX" in os.environ else ["g++", "clang++"]
    if (
        device.type == "cpu"
        and sys.platform != "win32"
        and not any(shutil.which(name) for name in names)
    ):
        raise DependencyError(
            "torch.compile",
            expected="a C++ compiler",
            found=f"no {' or '.join(names)}",
            advice="install one (Debian: apt install g++), or run eagerly",
        )
