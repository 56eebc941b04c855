"""Networks made fast for inference: one call from occupancy to labels, compiled with the weights as constants."""

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

Mode = Literal["eager", "compile"]


class Completer(nn.Module):
    """A network with what stands around it at inference: occupancy goes in as bytes, classes come out as bytes.

    Args:
        network: in eval mode.
        dtype: what the network computes in.
    """

    def __init__(self, network: nn.Module, dtype: torch.dtype = torch.float32) -> None:
        super().__init__()
        self.network = network
        self.dtype = dtype

    def forward(self, occupancy: Tensor) -> Tensor:
        """Take (B, T, X, Y, Z) occupancy, uint8 or float, to (B, X, Y, Z) uint8 labels."""
        logits: Tensor = self.network(occupancy.to(self.dtype))
        return logits.argmax(-1).to(torch.uint8)


class Compiled:
    """A module compiled with its weights frozen into the code, one program a shape of input.

    Batch norms fold into convolutions, and weights are laid out for the processor once: on a CPU that is nearly all of the gain.
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
            with inductor.patch(self._settings):  # read while compiling, here, not when the program is made
                labels: Tensor = self._program(occupancy)
        self._shapes.add(occupancy.shape)
        return labels


def prepare(
    network: nn.Module, device: torch.device, mode: Mode = "compile", *, bf16: bool | None = None
) -> Callable[[Tensor], Tensor]:
    """Make a network ready for inference.

    Args:
        network: is put into eval mode, moved, and, for bf16, converted in place.
        device: what to compute on.
        mode: "eager" runs it as it stands; "compile" compiles it at the first call (a minute or so) and is several times faster then. On CUDA
            the compiled program is replayed as a CUDA graph, with channels last.
        bf16: compute in bfloat16; None does so on CUDA in the mode "compile".

    Returns:
        A function from (B, T, X, Y, Z) occupancy, uint8 or float, on the device, to (B, X, Y, Z) uint8 labels.

    Raises:
        DependencyError: there is no C++ compiler for torch.compile.
        ArgumentError: there is no such mode.
    """
    if mode not in ("eager", "compile"):
        raise ArgumentError("mode", expected="eager or compile", found=f"{mode!r}")
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
    """Raise DependencyError where torch.compile would not find the compiler that it needs."""
    names = [os.environ["CXX"]] if "CXX" in os.environ else ["g++", "clang++"]
    if device.type == "cpu" and sys.platform != "win32" and not any(shutil.which(name) for name in names):
        raise DependencyError(
            f"torch.compile needs a C++ compiler, and there is no {' or '.join(names)}: install one (Debian: apt install g++), or run eagerly"
        )
