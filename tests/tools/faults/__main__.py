"""`python -m faults`: many faults of every kind, a row for each, and the figures in the
documentation.

The figures are kept in `docs/studies/faults.json`. The table of `docs/reliability.md` and a line of
`README.md` are made from it.
"""

from __future__ import annotations

import argparse
import datetime
import shutil
import sys
import tempfile
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from measuring.figures import Figures, publish

from faults.commands import COMMANDS
from faults.figures import KINDS, code_changed, keep, read, write


def chosen_commands(wanted: list[str]) -> list[str]:
    """Return the names of commands, given without what follows: "regrid" for all of regrid."""
    return [name for name in COMMANDS if any(f"{name}-".startswith(f"{one}-") for one in wanted)]


def main() -> int:
    """Run the kinds that are asked for; returns 1 if a fault was found."""
    parser = argparse.ArgumentParser(prog="faults", description=__doc__)
    parser.add_argument(
        "--size", choices=("quick", "long"), default="quick", help="minutes or hours"
    )
    parser.add_argument(
        "--only",
        choices=tuple(KINDS),
        action="append",
        help="only this kind; may be given several times",
    )
    parser.add_argument(
        "--count", type=int, help="number of cases of each kind, instead of those of the size"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers")
    parser.add_argument(
        "--keep-figures",
        action="store_true",
        help="leave the figures in the documentation as they are",
    )
    parser.add_argument(
        "--command",
        action="append",
        help="only this command, such as `regrid` (all of its cases); may be given several times",
    )
    parser.add_argument(
        "--add", action="store_true", help="add the cases to those of earlier seeds in the figures"
    )
    parser.add_argument(
        "--publish", action="store_true", help="only write the pages, with when the code changed"
    )
    given = parser.parse_args()
    if given.publish:
        write(read())
        publish(Figures.read())
        return 0
    found = []
    for name in given.only or KINDS:
        kind = KINDS[name]
        if not find_spec(kind.module):
            print(f"{name}: there is no {kind.module}")
            continue
        folder = Path(tempfile.mkdtemp(prefix=f"faults-{name}-"))
        chosen = {"names": chosen_commands(given.command)} if given.command else {}
        code = code_changed()
        outcome = import_module(kind.module).run(
            given.count or getattr(kind, given.size), given.seed, folder, **chosen
        )
        print(
            f"{name}: {outcome.tried:,} tried, {len(outcome.found)} faults, {outcome.seconds:.0f} s",
            flush=True,
        )
        print(*outcome.found, sep="\n", end="\n" if outcome.found else "")
        found += outcome.found
        if not outcome.found:
            shutil.rmtree(folder)
        if not given.keep_figures:
            date = datetime.datetime.now(datetime.UTC).date()
            keep(outcome, date, code, add=given.add)
            publish(Figures.read())
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
