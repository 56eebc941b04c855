"""`doctor`: the installed packages and the properties of the machine, as a report to paste into an
issue.
"""

from __future__ import annotations

import getpass
import importlib
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from carlasc.errors import DependencyError, carlasc_version, describe, import_extra, install_command
from carlasc.running import count_cores
from carlasc.running.pools import ONE_THREAD
from carlasc.storage.files import is_durable

FOR_DEVELOPERS = ("all", "dev", "docs", "faults", "study")
"""Extras that are not listed: `all` consists of other extras, and the rest is for developers of the
package.
"""

_PACKAGE = Path(__file__).parents[1]  # the folder of carlasc
_FEATURES = "sse4.2 avx avx2 fma bmi2 avx512f avx512bw avx512vl neon asimd sve sve2".split()
_REQUIREMENT = re.compile(
    r"(?P<name>[\w.-]+)(?:\[[\w,-]*\])?(?:>=(?P<lowest>[\w.]+))?"
    r"(?:\s*;\s*extra == ['\"](?P<extra>[\w-]+)['\"])?"
)
_VARIABLES = re.compile("|".join([*ONE_THREAD, "NUMBA_.*", "CARLASC_.*"]))


@dataclass(frozen=True)
class Package:
    """A package that carlasc needs, always or for an extra.

    Attributes:
        name: its name on the package index.
        version: the installed version; None if it is not installed.
        lowest: the lowest version that carlasc works with.
    """

    name: str
    version: str | None
    lowest: str

    @property
    def problem(self) -> str:
        """What is wrong with it; empty if it is installed and new enough."""
        if self.version is None:
            return f"{self.name} is not installed"
        if _numbers(self.version) < _numbers(self.lowest):
            return f"{self.name} {self.version} is older than {self.lowest}"
        return ""


@dataclass(frozen=True)
class Extra:
    """An extra, as in `pip install '.[zarr]'`.

    Attributes:
        name: its name.
        packages: what it installs.
    """

    name: str
    packages: tuple[Package, ...]

    @property
    def problems(self) -> tuple[str, ...]:
        """What is missing or too old."""
        return tuple(package.problem for package in self.packages if package.problem)

    @property
    def command(self) -> str:
        """The command that installs it."""
        # shells expand ~ only outside quotes
        return without_names(install_command(self.name)).replace("'~/", "~/'")


@dataclass(frozen=True)
class Processor:
    """The processor.

    Attributes:
        model: its name.
        cores: number of its cores, as the system counts them.
        usable: number of cores that this process may use; commands start as many workers.
        target: the processor that Numba compiles for; empty if Numba does not load.
        features: instruction sets that Numba uses and that matter for speed.
    """

    model: str
    cores: int
    usable: int
    target: str
    features: tuple[str, ...]


@dataclass(frozen=True)
class CompiledCode:
    """Where compiled code is kept.

    Attributes:
        folder: the folder.
        writable: whether this process may write there; otherwise each process compiles again.
        files: number of files of compiled code in it.
        bytes: their size.
        compile_s: time for compiling a loop of one line, seconds.
    """

    folder: str
    writable: bool
    files: int
    bytes: int
    compile_s: float


@dataclass(frozen=True)
class Installation:
    """What `doctor` found.

    Paths begin with `~` instead of the home folder, and contain no user name.

    Attributes:
        version: version of carlasc.
        python: version of Python.
        system: the operating system.
        folder: where carlasc is installed.
        packages: the packages that it always needs.
        extras: the optional packages.
        processor: the processor.
        compiled: where compiled code is kept; None if Numba does not work.
        threads: the number of threads of Numba, and the variables of the environment that set
            threads, Numba and carlasc.
        durable: whether files are synced before they are renamed to their final names.
        problems: what is broken and needed; empty if carlasc works.
    """

    version: str
    python: str
    system: str
    folder: str
    packages: tuple[Package, ...]
    extras: tuple[Extra, ...]
    processor: Processor
    compiled: CompiledCode | None
    threads: dict[str, str]
    durable: bool
    problems: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether everything that is always needed works. Extras may be missing."""
        return not self.problems


def doctor() -> Installation:
    """Check the installed packages and the machine.

    This takes a few seconds; nothing is sent anywhere.

    Returns:
        What was found.
    """
    needed, extras = _read_requirements()
    problems = [package.problem for package in needed if package.problem]
    if not needed:
        problems.append(
            "carlasc is on the path, but not installed, so its needs are not known: install it "
            "with pip"
        )
    for package in needed:
        if package.version is not None:
            problems += _problems_of_import(package.name)
    numba_loads = not any("numba" in problem or "numpy" in problem for problem in problems)
    compiled = None
    if numba_loads:
        try:
            compiled = _look_at_compiled_code()
        except (RuntimeError, OSError) as error:
            problems.append(
                f"Numba cannot compile, or cannot keep compiled code ({describe(error)}): set "
                f"NUMBA_CACHE_DIR to a folder that is writable"
            )
    return Installation(
        version=carlasc_version(),
        python=f"{platform.python_version()} ({platform.python_implementation()})",
        system=platform.platform(),
        folder=without_names(str(_PACKAGE)),
        packages=needed,
        extras=extras,
        processor=_look_at_processor(numba_loads),
        compiled=compiled,
        threads=_read_threads(numba_loads),
        durable=is_durable(),
        problems=tuple(map(without_names, problems)),
    )


def without_names(text: str) -> str:
    """Return a text with `~` instead of the home folder, and USER instead of the user's name where
    it is a whole word.
    """
    home = str(Path.home())
    if len(home) > 1:
        text = re.sub(rf"{re.escape(home)}(?![\w-])", "~", text)
    with suppress(OSError, KeyError, ImportError):  # raised by getpass for a user without a name
        text = re.sub(
            rf"(?<![A-Za-z0-9]){re.escape(getpass.getuser())}(?![A-Za-z0-9])", "USER", text
        )
    return text


def _read_requirements() -> tuple[tuple[Package, ...], tuple[Extra, ...]]:
    """Return the packages that are always needed, and the extras, as the metadata of the installed
    package list them.
    """
    try:
        lines = metadata.requires("carlasc") or []
    except metadata.PackageNotFoundError:
        return (), ()
    needed: list[Package] = []
    extras: dict[str, list[Package]] = {}
    for line in lines:
        match = _REQUIREMENT.fullmatch(line)
        if match is None or match["extra"] in FOR_DEVELOPERS:
            continue
        try:
            version = metadata.version(match["name"])
        except metadata.PackageNotFoundError:
            version = None
        package = Package(match["name"], version, match["lowest"] or "0")
        (extras.setdefault(match["extra"], []) if match["extra"] else needed).append(package)
    return tuple(needed), tuple(Extra(name, tuple(packages)) for name, packages in extras.items())


def _numbers(version: str) -> tuple[int, ...]:
    """Return the numbers at the start of a version, without trailing zeros: 2.0+cpu is 2."""
    start = re.sub(r"[^\d.].*", "", version)
    return tuple(int(part) for part in re.sub(r"(\.0+)*\.?$", "", start).split(".") if part)


def _problems_of_import(name: str) -> Iterator[str]:
    """Yield why a package that is always needed cannot be imported.

    The module has the name of the package, with underscores.
    """
    try:
        import_extra(name.replace("-", "_"), "")
    except DependencyError as error:
        yield f"{name} cannot be imported ({describe(error.__cause__ or error)})"


def _look_at_processor(numba_loads: bool) -> Processor:
    target = ""
    features = tuple[str, ...]()
    if numba_loads:
        binding: Any = importlib.import_module("llvmlite.binding")
        config: Any = importlib.import_module("numba").config
        offered = binding.get_host_cpu_features()
        target = config.CPU_NAME or binding.get_host_cpu_name()
        features = tuple(
            name
            for name in _FEATURES
            if offered.get(name) and f"-{name}" not in (config.CPU_FEATURES or "")
        )
    return Processor(_model(), os.cpu_count() or 1, count_cores(), target, features)


def _model() -> str:
    """Return the name of the processor."""
    with suppress(OSError):
        if line := re.search(
            r"^(?:model name|Model)\s*: (.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE
        ):
            return line[1]
    if sys.platform == "darwin":
        with suppress(OSError, subprocess.SubprocessError):
            asked = ["sysctl", "-n", "machdep.cpu.brand_string"]
            return subprocess.run(
                asked, capture_output=True, text=True, check=True, timeout=5
            ).stdout.strip()
    return platform.processor() or platform.machine()


def _look_at_compiled_code() -> CompiledCode:
    """Compile a loop of one line.

    Raises:
        RuntimeError: Numba finds no folder for compiled code, so that no module with a compiled
            loop can be imported.
        OSError: as RuntimeError, or the compiler does not work.
    """
    import numba

    from carlasc.core.compiling import cache_folder, cached

    loop: Any = cached(_next)
    start = time.perf_counter()
    numba.njit(_next)(1)  # type: ignore[type-var]
    compile_s = time.perf_counter() - start
    folder = Path(loop.stats.cache_path)
    kept = cache_folder() if folder.is_relative_to(cache_folder()) else _PACKAGE
    root = kept if folder.name == "__pycache__" else folder.parent
    sizes = [*_sizes_in(root)]
    nearest = next(parent for parent in (folder, *folder.parents) if parent.exists())
    return CompiledCode(
        without_names(str(root)), os.access(nearest, os.W_OK), len(sizes), sum(sizes), compile_s
    )


def _sizes_in(root: Path) -> Iterator[int]:
    for path in root.rglob("*.nb[ic]"):
        with suppress(FileNotFoundError):  # other processes replace their files
            yield path.stat().st_size


def _next(number: int) -> int:
    return number + 1


def _read_threads(numba_loads: bool) -> dict[str, str]:
    threads = {}
    if numba_loads:
        threads["numba"] = str(importlib.import_module("numba").config.NUMBA_NUM_THREADS)
    return threads | {
        name: without_names(value)
        for name, value in sorted(os.environ.items())
        if _VARIABLES.fullmatch(name)
    }
