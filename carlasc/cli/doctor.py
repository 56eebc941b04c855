"""`carlasc doctor`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import typer

from carlasc.cli.common import FAILED, Json, echo, print_json

if TYPE_CHECKING:
    from carlasc.inspection.installation import Extra, Installation


def doctor(as_json: Json = False) -> None:
    """Print the installed packages and the properties of the machine, as text to paste into an
    issue. User names are left out.
    """
    from carlasc.inspection.installation import doctor as look

    found = look()
    if as_json:
        print_json(found)
    else:
        echo("\n".join(_lines(found)))
    if not found.ok:
        raise typer.Exit(FAILED)


def _lines(found: Installation) -> Iterator[str]:
    names = [one.name for one in found.extras] + [one.name for one in found.packages]
    width = max(map(len, names), default=0)
    yield f"carlasc {found.version}, in {found.folder}"
    yield f"Python {found.python}"
    yield found.system
    yield "\npackages"
    for package in found.packages:
        yield f"  {package.name:{width}}  {package.version or 'missing'}"
    yield "\nextras"
    for extra in found.extras:
        yield f"  {extra.name:{width}}  {_describe_extra(extra)}"
    cpu = found.processor
    yield "\nprocessor"
    yield f"  {cpu.model}, {cpu.cores} cores, {cpu.usable} usable"
    features = " ".join(cpu.features) or "unknown instructions"
    yield f"  Numba compiles for {cpu.target or 'nothing'}: {features}"
    threads = ", ".join(f"{name} {value}" for name, value in found.threads.items())
    yield f"  threads: {threads or 'no settings'}"
    if (code := found.compiled) is not None:
        state = (
            "writable"
            if code.writable
            else "NOT WRITABLE: every process compiles again; set NUMBA_CACHE_DIR to a folder that "
            "is writable"
        )
        yield "\ncompiled code"
        yield f"  {code.folder} ({state}): {code.files} files, {code.bytes / 1e6:.1f} MB"
        yield f"  a loop of one line compiles in {code.compile_s:.2f} s"
    synced = "synced" if found.durable else "not synced"
    yield f"\nfiles are {synced} before they are renamed to their final names"
    yield "\nmissing"
    missing = [extra for extra in found.extras if extra.problems]
    for extra in missing:
        yield f"  {extra.command}"
    if not missing:
        yield "  nothing"
    yield "\nproblems"
    yield from (f"  {problem}" for problem in found.problems or ["none"])


def _describe_extra(extra: Extra) -> str:
    """Return the versions of its packages, or what is wrong with them."""
    if extra.problems:
        return ", ".join(extra.problems)
    return "complete: " + ", ".join(
        f"{package.name} {package.version}" for package in extra.packages
    )
