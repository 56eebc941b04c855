"""Stands in for Slurm itself: `sbatch` starts a job script as a process of this machine, and
`scancel` ends it. dask-jobqueue is the real one.
"""

from __future__ import annotations

import os
from pathlib import Path

_SBATCH = """#!/bin/sh
cp "$1" {folder}/job-$$.sh
setsid sh {folder}/job-$$.sh >{folder}/log 2>&1 </dev/null &
echo $! >>{folder}/jobs
echo "Submitted batch job $!"
"""
_SCANCEL = """#!/bin/sh
echo "$1" >>{folder}/cancelled
kill -KILL -- "-$1"
"""


def install(folder: Path) -> dict[str, str]:
    """Write the commands to a folder; return the environment in which they are found, and in which
    Dask asks for small jobs.
    """
    for name, text in (("sbatch", _SBATCH), ("scancel", _SCANCEL)):
        (folder / name).write_text(text.format(folder=folder))
        (folder / name).chmod(0o755)
    return {
        "PATH": f"{folder}{os.pathsep}{os.environ['PATH']}",
        "DASK_JOBQUEUE__SLURM__CORES": "1",
        "DASK_JOBQUEUE__SLURM__MEMORY": "2GB",
        "DASK_JOBQUEUE__SLURM__SCHEDULER_OPTIONS": '{"host": "127.0.0.1", "dashboard_address": '
        '":0"}',
    }


def read_jobs(folder: Path, name: str = "jobs") -> list[int]:
    """Return the numbers of the jobs that were submitted, or "cancelled"."""
    file = folder / name
    return [int(line) for line in file.read_text().split()] if file.exists() else []
