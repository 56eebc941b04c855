"""The training loop, with a score, the best weights and a checkpoint after each epoch."""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from carlasc import Source
from carlasc.errors import ArgumentError, CarlascError, ConflictError
from carlasc.metrics import ConfusionMatrix
from completion.command import Line
from completion.config import Config
from completion.data import (
    TrainLoader,
    class_weights,
    eval_loader,
    open_split,
    soft_target,
    target_of,
)
from completion.inference import check_compiler
from completion.losses import balance_free
from completion.networks import build_network
from completion.processes import Processes
from completion.scoring import score
from completion.tasks import task_of
from completion.tensorboard import Board
from completion.weights import (
    load_weights,
    read_checkpoint,
    read_weights,
    write_checkpoint,
    write_weights,
)

LAST, BEST, CONFIG = "last.pt", "best.safetensors", "config.yaml"


@dataclass
class Progress:
    """The state of a run.

    Attributes:
        epoch: number of finished epochs.
        best_epoch: the epoch with the best weights, counted from 1; 0 before the first.
        best_miou: its mIoU on the validation split.
        losses: mean training loss of each epoch.
        mious: mIoU on the validation split after each epoch.
        samples_per_s: training samples per second in each epoch.
        step: number of finished steps of an unfinished epoch.
        loss_so_far: sum of the losses of these steps.
    """

    epoch: int = 0
    step: int = 0
    loss_so_far: float = 0.0
    best_epoch: int = 0
    best_miou: float = -1.0
    losses: list[float] = field(default_factory=list)
    mious: list[float] = field(default_factory=list)
    samples_per_s: list[float] = field(default_factory=list)

    def is_over(self, config: Config) -> bool:
        """Whether all epochs are done, or the score has not improved for `patience` epochs."""
        stalled = config.patience is not None and self.epoch - self.best_epoch >= config.patience
        return self.epoch >= config.epochs or stalled


def train(
    source: str | Path | Source,
    config: Config,
    out: Path,
    processes: Processes,
    *,
    resume: bool = False,
) -> Progress:
    """Train a network on a data set.

    Writes to `out`: config.yaml, last.pt (to continue from), best.safetensors (the weights of the
    best epoch by mIoU) and TensorBoard's files.

    Args:
        source: the data, anything that `carlasc.open` takes.
        config: the settings.
        out: folder of the run.
        processes: the processes of the run.
        resume: continue from last.pt; the result equals that of a run without interruption.

    Raises:
        CarlascError: a split is empty, the loss is not finite, memory is not sufficient, or `out`
            holds another run.
    """
    data = open_split(source, config.train, config, training=True)
    loader = TrainLoader(data, config, processes.rank, processes.world)
    val = open_split(source, config.val, config)
    val_loader = eval_loader(val, config, processes.rank, processes.world)
    num_classes = max(data.classes.names) + 1
    weights = torch.from_numpy(class_weights(source, data, config)).to(processes.device)

    torch.manual_seed(config.seed)
    network = build_network(config.network, num_classes, data.spec, config.history).to(
        processes.device
    )
    optimizer = torch.optim.Adam(
        network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay, fused=True
    )
    schedule = torch.optim.lr_scheduler.StepLR(optimizer, config.decay_every, config.decay)
    parts: dict[str, Any] = {"network": network, "optimizer": optimizer, "schedule": schedule}
    progress = _resume(out, config, parts) if resume else _begin(out, config, processes)
    stepped = _prepare(network, config, processes)

    def save() -> None:
        if processes.first:
            states = {name: part.state_dict() for name, part in parts.items()}
            write_checkpoint(out / LAST, states | dataclasses.asdict(progress))
        processes.wait()

    with Board(out, data.classes, config, enabled=processes.first) as board:
        while not progress.is_over(config):
            start = time.perf_counter()
            task_of(network).set_epoch(network, progress.epoch)
            first = progress.step
            _train_epoch(
                (network, stepped), optimizer, loader, weights, progress, config, processes, save
            )
            loss = progress.loss_so_far / len(loader)
            elapsed_s = time.perf_counter() - start
            learning_rate = optimizer.param_groups[0]["lr"]
            schedule.step()
            processes.share(network.buffers())
            matrix = score(network, val_loader, num_classes, processes, config.precision == "bf16")

            progress.epoch, progress.step, progress.loss_so_far = progress.epoch + 1, 0, 0.0
            progress.losses.append(loss)
            progress.mious.append(matrix.miou)
            progress.samples_per_s.append(len(data) * (1 - first / len(loader)) / elapsed_s)
            if matrix.miou > progress.best_miou:
                progress.best_miou, progress.best_epoch = matrix.miou, progress.epoch
                if processes.first:
                    write_weights(out / BEST, network)
            save()
            if processes.first:
                board.add_epoch(progress.epoch, loss, learning_rate, matrix)
                board.add_pictures(progress.epoch, network, val, processes.device)
                _print_epoch(progress, config, matrix)
            processes.wait()
    return progress


def _begin(out: Path, config: Config, processes: Processes) -> Progress:
    if (out / LAST).exists():
        raise ConflictError(
            out / LAST,
            expected="no earlier run",
            found="one",
            advice="continue it with `resume=True` (`--resume`), or choose another folder",
        )
    processes.wait()
    if processes.first:
        config.write(out / CONFIG)
    return Progress()


def _resume(out: Path, config: Config, parts: dict[str, Any]) -> Progress:
    """Load last.pt.

    Nothing else is needed, because order, flips and random draws depend only on the seed, the epoch
    and the step.
    """
    before = Config.read(out / CONFIG) if (out / CONFIG).is_file() else config
    changed = [
        f.name
        for f in dataclasses.fields(Config)
        if getattr(before, f.name) != getattr(config, f.name)
    ]
    if changed := [
        name
        for name in changed
        if name not in ("epochs", "patience", "workers", "save_every", "keep_samples", "wandb")
    ]:
        raise ConflictError(
            out / CONFIG,
            expected="the settings of the run that is resumed",
            found=f"others: {', '.join(changed)}",
        )
    read_weights(out / LAST)  # raises if the file does not exist
    state = read_checkpoint(out / LAST)
    load_weights(parts["network"], state["network"], str(out / LAST))
    for name in ("optimizer", "schedule"):
        parts[name].load_state_dict(state[name])
    return Progress(**{f.name: state[f.name] for f in dataclasses.fields(Progress)})


def _prepare(network: nn.Module, config: Config, processes: Processes) -> nn.Module:
    """Wrap the network for several processes and for torch.compile; both share its weights."""
    fixed_shapes = task_of(network).fixed_shapes
    if processes.world > 1:
        ids = [processes.device.index] if processes.device.type == "cuda" else None
        network = DistributedDataParallel(network, device_ids=ids)
    if config.compile and not fixed_shapes:
        raise ArgumentError(
            "compile",
            expected=f"False for {config.network}, whose inputs have no fixed shapes",
            found="True",
        )
    if config.compile:
        check_compiler(processes.device)
        network = torch.compile(network)  # type: ignore[assignment]
    return network


def _train_epoch(
    networks: tuple[nn.Module, nn.Module],
    optimizer: torch.optim.Optimizer,
    loader: TrainLoader,
    class_weights: Tensor,
    progress: Progress,
    config: Config,
    processes: Processes,
    save: Callable[[], None],
) -> None:
    """Make the remaining steps of an epoch, and record them in `progress`.

    `networks` are the network itself, and its wrapped form.
    """
    networks[1].train()
    epoch, line = progress.epoch, Line()
    for step, batch in enumerate(loader.epoch(epoch, progress.step), progress.step):
        try:
            loss = _train_step(
                networks, optimizer, batch, class_weights, (epoch, step), config, processes
            )
        except (torch.OutOfMemoryError, RuntimeError, ValueError) as error:
            # torch's message for a batch norm with a single value
            if "more than 1 value per channel" in str(error):
                raise CarlascError(
                    f"epoch {epoch + 1}, batch {step + 1}",
                    problem=f"{len(batch['frame'])} sample is too little for a batch norm on such "
                    f"a small grid",
                    advice=f"choose a batch_size so that the last batch of the {len(loader.data)} "
                    f"samples has more than one",
                ) from error
            if not _is_out_of_memory(error):
                raise
            smaller = max(1, config.batch_size // 2)
            raise CarlascError(
                f"batch size {config.batch_size}",
                problem="out of memory",
                advice=f"try --set batch_size={smaller}"
                + ("" if config.precision == "bf16" else " or --set precision=bf16"),
            ) from error
        if not math.isfinite(loss):
            names = ", ".join(
                f"{s} {int(f)}" for s, f in zip(batch["sequence"], batch["frame"], strict=True)
            )
            raise CarlascError(
                f"epoch {epoch + 1}, batch {step + 1}",
                problem=f"the loss is {loss} (frames {names})",
                advice=f"try a smaller learning rate; the last finished epoch is in {LAST}",
            )
        progress.step, progress.loss_so_far = step + 1, progress.loss_so_far + loss
        if (
            config.save_every
            and progress.step % config.save_every == 0
            and progress.step < len(loader)
        ):
            save()
        if processes.first:
            mean = progress.loss_so_far / (step + 1)
            line.show(
                f"epoch {epoch + 1}/{config.epochs}  batch {step + 1}/{len(loader)}  loss "
                f"{mean:.4f}"
            )


def _train_step(
    networks: tuple[nn.Module, nn.Module],
    optimizer: torch.optim.Optimizer,
    batch: Mapping[str, Any],
    class_weights: Tensor,
    place: tuple[int, int],
    config: Config,
    processes: Processes,
) -> float:
    """Make one step on the loss of the whole batch, summed over the processes; return this loss."""
    network, wrapped = networks
    task, seed = task_of(network), _mix(config.seed, *place, processes.rank)
    target = target_of(batch, processes.device)
    if config.free_ratio:
        draw = torch.Generator(processes.device).manual_seed(seed)
        target = balance_free(target, config.free_ratio, draw)
    if config.soft_labels:
        target = soft_target(batch, target)
    prepared = task.prepare(batch, processes.device, torch.Generator().manual_seed(seed))
    with torch.autocast(processes.device.type, torch.bfloat16, enabled=config.precision == "bf16"):
        outputs = wrapped(*task.arguments(prepared))
    sums, weights = task.loss(outputs, prepared, target, class_weights)
    weights = processes.sum(weights.detach())
    factors, offset = task.balance(network, sums)
    own = (factors * sums / weights.clamp_min(1e-12)).sum()  # this process's share of the loss
    optimizer.zero_grad(set_to_none=True)
    # gradients are averaged over the processes
    torch.autograd.backward(own * processes.world + offset)
    optimizer.step()
    return float(processes.sum(own.detach()) + offset.detach())


def _mix(*numbers: int) -> int:
    """Return one seed made from several numbers."""
    mixed = 0
    for number in numbers:
        mixed = (mixed * 1_000_003 + number + 1) % (2**63)
    return mixed


def _is_out_of_memory(error: Exception) -> bool:
    return isinstance(error, torch.OutOfMemoryError) or "can't allocate memory" in str(error)


def _print_epoch(progress: Progress, config: Config, matrix: ConfusionMatrix) -> None:
    geometry = matrix.completeness()
    mark = "  best" if progress.best_epoch == progress.epoch else ""
    start = "\r" if sys.stderr.isatty() else ""
    print(
        f"{start}epoch {progress.epoch}/{config.epochs}  loss {progress.losses[-1]:.4f}  mIoU "
        f"{100 * matrix.miou:.2f}  IoU {100 * geometry.iou:.2f}  {progress.samples_per_s[-1]:.1f} "
        f"samples/s{mark}",
        file=sys.stderr,
    )
