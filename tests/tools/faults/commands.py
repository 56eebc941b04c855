"""Every command that writes, on data of two frames.

A case is a folder: the command runs in it with relative paths, so that its whole content can be
compared with that of an undisturbed run.

    build_inputs(base)                   # once: what all commands read
    for command in COMMANDS.values():
        command.copy_inputs(base, case)  # a folder of its own for each case
        run_command(command, case)       # in a child: 0 if it succeeded

`serving()` must be open around commands that download.
"""

from __future__ import annotations

import io
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
import traceback
import zipfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import numpy as np

URL = "{url}"
"""Stands in the arguments of a command for the address of the server that `serving` runs."""

SIMULATED = "--count 2 --sensors 2 --channels 8 --points 800 --range 20 --no-bev"
GRID = "--size 16,16,8"
PICTURE = "--size 64x64"


@dataclass(frozen=True)
class Command:
    """A command that writes.

    Attributes:
        name: what it is called in reports.
        arguments: what a user types after `carlasc`, with spaces between; paths are relative to the
            folder of the case.
        inputs: what it needs in that folder, out of what `build_inputs` made.
        output: what it writes there.
        needs: packages that must be installed.
        workers: processes that it works with; None for a command without `--workers`.
        slow: whether it takes so long that it is tried less often.
    """

    name: str
    arguments: str
    inputs: tuple[str, ...]
    output: str
    needs: tuple[str, ...] = ()
    workers: int | None = 1
    slow: bool = False

    @property
    def argv(self) -> list[str]:
        """The arguments as a list, with the address of the server where it is needed."""
        given = self.arguments.replace(URL, os.environ.get(_ADDRESS, URL)).split()
        return given if self.workers is None else [*given, "--workers", str(self.workers)]

    def copy_inputs(self, base: Path, case: Path) -> None:
        """Copy what the command reads from the folder of `build_inputs` into the new folder of a
        case.
        """
        case.mkdir(parents=True)
        for name in self.inputs:
            if (base / name).is_dir():
                shutil.copytree(base / name, case / name)
            else:
                shutil.copy2(base / name, case / name)


_ZARR, _HDF5, _PARQUET = ("numcodecs", "pcodec"), ("h5py", "hdf5plugin"), ("pyarrow",)
_SAME = "--grid evaluation_16x16x8 --truth-grid evaluation_16x16x8"
_PICTURES = ("embreex", "PIL", "imageio_ffmpeg")

EVERY = (
    Command("simulate", f"simulate out {SIMULATED}", (), "out"),
    Command("simulate-zarr", f"simulate out.zarr {SIMULATED} {GRID}", (), "out.zarr", _ZARR),
    Command("simulate-workers", f"simulate out {SIMULATED}", (), "out", workers=2),
    Command("regrid", f"regrid drive -o out {GRID} --keep-votes", ("drive",), "out"),
    Command("regrid-zarr", f"regrid drive -o out.zarr {GRID}", ("drive",), "out.zarr", _ZARR),
    Command("regrid-hdf5", f"regrid drive -o out.h5 {GRID}", ("drive",), "out.h5", _HDF5),
    Command(
        "regrid-parquet", f"regrid drive -o out.parquet {GRID}", ("drive",), "out.parquet", _PARQUET
    ),
    Command("regrid-workers", f"regrid drive -o out {GRID}", ("drive",), "out", workers=2),
    Command(
        "regrid-zarr-workers", f"regrid drive -o out.zarr {GRID}", ("drive",), "out.zarr", _ZARR, 2
    ),
    Command(
        "regrid-scans", f"regrid scene {GRID} --observe scans --name merged", ("scene",), "scene"
    ),
    Command(
        "regrid-overwrite",
        "regrid scene --size 8,8,4 --observe grid --name evaluation_copy --overwrite",
        ("scene",),
        "scene",
    ),
    Command(
        "regrid-kept",
        f"regrid scene {GRID} --observe scans --name kept --keep-votes --keep-evidence "
        "--keep-actors",
        ("scene",),
        "scene",
    ),
    Command(
        "regrid-grid",
        "regrid scene --size 8,8,4 --observe grid --from-grid evaluation_16x16x8 --name coarse",
        ("scene",),
        "scene",
    ),
    Command("convert", f"convert kitti kitti out {GRID} --force", ("kitti",), "out"),
    Command(
        "convert-zarr",
        f"convert kitti kitti out.zarr {GRID} --force",
        ("kitti",),
        "out.zarr",
        _ZARR,
    ),
    Command(
        "convert-parquet",
        "convert kitti kitti out.parquet --grids none --force",
        ("kitti",),
        "out.parquet",
        _PARQUET,
    ),
    Command("pack-zarr", "pack scene out.zarr", ("scene",), "out.zarr", _ZARR),
    Command("pack-hdf5", "pack scene out.h5", ("scene",), "out.h5", _HDF5),
    Command("pack-parquet", "pack scene out.parquet", ("scene",), "out.parquet", _PARQUET),
    Command("pack-workers", "pack scene out.zarr", ("scene",), "out.zarr", _ZARR, 2),
    Command(
        "pack-zarr-overwrite",
        "pack scene scene.zarr --overwrite",
        ("scene", "scene.zarr"),
        "scene.zarr",
        _ZARR,
    ),
    Command(
        "pack-hdf5-overwrite",
        "pack scene scene.h5 --overwrite",
        ("scene", "scene.h5"),
        "scene.h5",
        _HDF5,
    ),
    Command(
        "pack-parquet-overwrite",
        "pack scene scene.parquet --overwrite",
        ("scene", "scene.parquet"),
        "scene.parquet",
        _PARQUET,
    ),
    Command("unpack", "unpack scene.zarr out", ("scene.zarr",), "out", _ZARR),
    Command("export-kitti", "export kitti scene out", ("scene",), "out"),
    Command("export-occ3d", "export occ3d scene out", ("scene",), "out"),
    Command("convert-scans", f"convert scans scans out {GRID} --force", ("scans",), "out"),
    Command(
        "convert-bag", "convert bag bag out --grids none --force", ("bag",), "out", ("rosbags",)
    ),
    Command(
        "convert-ncore",
        f"convert ncore ncore out {GRID} --force",
        ("ncore",),
        "out",
        ("cbor2", "numcodecs"),
    ),
    Command("label", "label scene -o out --from labels", ("scene", "labels"), "out"),
    Command("label-motion", "label scene -o out --from motion", ("scene",), "out"),
    Command("label-images", "label seen -o out --from images", ("seen",), "out", _PICTURES),
    Command("refine", "refine scene -o out --refine always", ("scene",), "out"),
    Command("map", "map scene out.ply", ("scene",), "out.ply"),
    Command("map-actors", "map scene out.ply --actors --mesh out.glb", ("scene",), "out_actors"),
    Command("map-bag", "map bag out.ply --force", ("bag",), "out.ply", ("rosbags",)),
    Command(
        "map-grid", "map scene out.ply --grid evaluation_16x16x8 --frames 1", ("scene",), "out.ply"
    ),
    Command("audit-keep", "audit merged merged --keep out", ("merged",), "out"),
    Command(
        "capture",
        "capture out --count 2 --sensors 2 --traffic light --no-bev",
        (),
        "out",
        ("carla",),
        None,
    ),
    Command("demo", "demo out --count 2 --sensors 1", (), "out", _PICTURES, slow=True),
    Command("view-page", "view scene -o out.html --overwrite", ("scene",), "out.html", (), None),
    Command("view-folder", "view scene -o out --overwrite", ("scene",), "out", (), None),
    Command(
        "view-foxglove",
        "view scene -o out.mcap --overwrite",
        ("scene",),
        "out.mcap",
        ("mcap",),
        None,
    ),
    Command(
        "evaluate-plot",
        f"evaluate scene scene {_SAME} --plot out.png",
        ("scene",),
        "out.png",
        ("matplotlib",),
    ),
    Command(
        "scores",
        "scores scores.json -o out.html --overwrite",
        ("scores.json",),
        "out.html",
        (),
        None,
    ),
    Command(
        "render-picture", f"render scene -o out.png {PICTURE}", ("scene",), "out.png", _PICTURES
    ),
    Command("render-gif", f"render scene -o out.gif {PICTURE}", ("scene",), "out.gif", _PICTURES),
    Command("render-film", f"render scene -o out.mp4 {PICTURE}", ("scene",), "out.mp4", _PICTURES),
    Command(
        "report",
        "report scene --html out.html --save --remake --holdout",
        ("scene",),
        "out.html",
    ),
    Command("report-save", "report scene --save", ("scene",), "scene"),
    Command(
        "card",
        "card scene -o out --license cc0-1.0 --published 2026-11-22 --no-pictures --overwrite",
        ("scene",),
        "out",
    ),
    Command(
        "stats",
        "stats scene --grid evaluation_16x16x8 --plot out.png",
        ("scene",),
        "out.png",
        ("matplotlib",),
    ),
    Command("download", f"download out --split val --base-url {URL}", (), "out", workers=None),
    Command(
        "download-extract",
        f"download out --split val --extract --base-url {URL}",
        (),
        "out",
        workers=None,
    ),
    Command("finish", "finish parts.zarr --incomplete", ("parts.zarr",), "parts.zarr", _ZARR, None),
)

READ_ONLY = ("info", "validate", "doctor")
"""The commands that only print."""

COMMANDS = {
    command.name: command
    for command in EVERY
    if all(find_spec(package) for package in (*command.needs, "trimesh", "embreex"))
}
"""The commands whose packages are installed, by name.

The data come from the simulated town, which needs two packages itself.
"""


_MADE_BY = {
    "drive": (f"simulate drive {SIMULATED}",),
    "scene": (
        f"regrid drive -o scene {GRID}",
        "regrid scene --observe grid --size 8,8,4 --name evaluation_copy",
    ),
    "seen": (f"simulate seen {SIMULATED} {GRID} --cameras front",),
    "merged": (
        f"regrid drive -o merged {GRID} --name evaluation",
        f"regrid merged {GRID} --observe scans --name evaluation --overwrite",
    ),
    **{f"scene.{kind}": (f"pack scene scene.{kind}",) for kind in ("zarr", "h5", "parquet")},
    "parts.zarr": (f"regrid drive -o parts.zarr {GRID} --frames 0 --part 1/2",),
}
_MADE_FROM = {
    "scene": "drive",
    "scene.zarr": "scene",
    "scene.h5": "scene",
    "scene.parquet": "scene",
    "parts.zarr": "drive",
    "merged": "drive",
}


def build_inputs(base: Path, commands: Iterable[Command] | None = None) -> None:
    """Write what commands read: a capture, scans with grids, the same as a store, one part of a
    store, and KITTI's files.

    Args:
        base: a folder, which is made.
        commands: those whose inputs are needed; None for all.

    Raises:
        RuntimeError: a command that makes them fails.
    """
    from helpers.datasets.tiny_kitti import write_tiny_kitti

    base.mkdir(parents=True)
    wanted = {name for command in (commands or COMMANDS.values()) for name in command.inputs}
    if "kitti" in wanted:
        write_tiny_kitti(base / "kitti", frames=2, voxels=True)
    for name in wanted & {"scans", "bag", "ncore"}:
        from faults.foreign import DATA_SETS

        DATA_SETS[name](base / name)
    if "labels" in wanted:
        _make("scene", base)
        (labels,) = (base / "scene").rglob("labels")
        shutil.copytree(labels, base / "labels")
    for name in wanted & _MADE_BY.keys():
        _make(name, base)
    if "scores.json" in wanted:
        _make("scene", base)
        _run_step(f"evaluate scene scene {_SAME} --json", base)
        printed = (base / MESSAGES).read_text()
        (base / "scores.json").write_text(printed[printed.index("{") : printed.rindex("}") + 1])


def _make(name: str, base: Path) -> None:
    """Make an input, after what it is made from, unless it exists."""
    if (base / name).exists():
        return
    if name in _MADE_FROM:
        _make(_MADE_FROM[name], base)
    for step in _MADE_BY[name]:
        _run_step(step, base)


def _run_step(step: str, base: Path) -> None:
    if code := wait(start([*step.split(), "--workers", "1"], base), 120):
        raise RuntimeError(f"carlasc {step}: exit code {code}: {(base / MESSAGES).read_text()}")


MESSAGES = "messages.txt"
"""What a command printed, in the folder of its case."""
TEMPORARY = "tmp"
"""The folder for temporary files, in the folder of a case."""


def start(
    argv: list[str],
    case: Path,
    before: Callable[[], None] | None = None,
    after: Callable[[], None] | None = None,
) -> int:
    """Run a command in a forked child, in the folder of a case, as the leader of a process group of
    its own.

    The child starts with the modules that this process has imported, so that most of its time is
    the command's own work.

    Args:
        argv: the arguments of `carlasc`.
        case: the folder; `MESSAGES` is written there.
        before: called in the child before the command.
        after: called in the child after it.

    Returns:
        The child's process id.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    child = os.fork()
    if child:
        with suppress(OSError):  # the child does the same; whichever is first
            os.setpgid(child, child)
        return child
    code = 70
    try:
        os.setpgid(0, 0)
        _become_fresh(case)
        if before is not None:
            before()
        code = run_here(argv)
        if after is not None:
            after()
    except KeyboardInterrupt:
        code = 130  # Ctrl-C before the command had begun
    finally:
        if code == 70:
            traceback.print_exc()
        threading._shutdown()  # type: ignore[attr-defined]  # as the interpreter does at its end: it waits for threads, also after Ctrl-C
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _become_fresh(case: Path) -> None:
    """Make a forked child behave as a process that a shell has just started."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    # a worker process imports the file of this one again
    sys.modules["__main__"] = ModuleType("__main__")
    os.chdir(case)
    Path(TEMPORARY).mkdir(exist_ok=True)  # what is left there is seen, too
    os.environ["TMPDIR"], tempfile.tempdir = str(case / TEMPORARY), None
    null, messages = (
        os.open(os.devnull, os.O_RDONLY),
        os.open(MESSAGES, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644),
    )
    os.dup2(null, 0)
    os.dup2(messages, 1)
    os.dup2(messages, 2)
    # pytest has replaced both
    sys.stdout, sys.stderr = (os.fdopen(number, "w", 1, closefd=False) for number in (1, 2))


def run_here(argv: list[str]) -> int:
    """Run a command in this process, and return its exit code."""
    from carlasc.cli import app

    if argv[0] == "capture":
        from helpers.servers.carla_server import FakeServer

        sys.modules["carla"] = FakeServer()  # type: ignore[assignment]
    try:
        app(argv, prog_name="carlasc")
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


def warm(command: Command, base: Path, case: Path) -> None:
    """Run a command once in this process, so that children which are forked from now on have its
    modules and its compiled code.

    For a process that is itself a child: it stays in the folder `case`, and has no input and no
    output any more.

    Raises:
        RuntimeError: the command fails.
    """
    command.copy_inputs(base, case)
    _become_fresh(case)
    if code := run_here(command.argv):
        raise RuntimeError(
            f"carlasc {command.arguments}: exit code {code}: {(case / MESSAGES).read_text()}"
        )


def run_command(command: Command, case: Path, limit_s: float = 60.0) -> int:
    """Run a command in a child to its end and return its exit code; minus the number of the signal
    that ended it, as `subprocess` does.
    """
    return wait(start(command.argv, case), limit_s)


def wait(child: int, limit_s: float) -> int:
    """Wait for a child, and end its process group when it takes longer than `limit_s`.

    Returns:
        Its exit code; minus the number of the signal that ended it, as `subprocess` does.

    Raises:
        TimeoutError: it took longer.
    """
    end = time.monotonic() + limit_s
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > end:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            raise TimeoutError(f"a command did not end in {limit_s:g} s")
        time.sleep(0.002)


_ADDRESS = "CARLASC_FAULTS_URL"


@contextmanager
def serving() -> Iterator[None]:
    """Serve the zip that `download` fetches, in a process of its own: a thread would not live on in
    forked children.
    """
    from helpers.servers.http_server import Site, serve

    readable, writable = os.pipe()
    child = os.fork()
    if not child:
        with serve(Site({"/val_cartesian.zip": _zip()})) as site:
            os.write(writable, site.url.encode())
            os.close(writable)
            signal.pause()
    os.close(writable)
    with open(readable) as file:
        os.environ[_ADDRESS] = file.read()
    try:
        yield
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        del os.environ[_ADDRESS]


def _zip() -> bytes:
    rng, buffer = np.random.default_rng(0), io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for frame in range(6):
            name = f"Val/Town07_Light/cartesian/velodyne/{frame:06d}.bin"
            archive.writestr(zipfile.ZipInfo(name), rng.bytes(100_000))
    return buffer.getvalue()
