"""Ground truth: observations are turned into votes and votes into grids, and a run does so for a whole data set."""

from __future__ import annotations

from typing import TYPE_CHECKING

from carlasc.loading import late_names

if TYPE_CHECKING:
    from carlasc.groundtruth.from_grid import resample
    from carlasc.groundtruth.jobs import FrameFailure
    from carlasc.groundtruth.options import (
        Complete,
        Dynamic,
        FromCapture,
        FromGrid,
        FromScans,
        GridOptions,
        Observe,
        Voting,
    )
    from carlasc.groundtruth.run import RegridResult, regrid
    from carlasc.groundtruth.voting.ballot import Ballot, VoteRule, Votes, count_votes
    from carlasc.groundtruth.voting.evidence import Evidence
    from carlasc.groundtruth.voting.observations import Observation
else:
    __getattr__, __dir__ = late_names(
        __name__,
        {
            "from_grid": ("resample",),
            "jobs": ("FrameFailure",),
            "options": (
                "Complete",
                "Dynamic",
                "FromCapture",
                "FromGrid",
                "FromScans",
                "GridOptions",
                "Observe",
                "Voting",
            ),
            "run": ("RegridResult", "regrid"),
            "voting.ballot": ("Ballot", "VoteRule", "Votes", "count_votes"),
            "voting.evidence": ("Evidence",),
            "voting.observations": ("Observation",),
        },
    )

__all__ = [
    "Ballot",
    "Complete",
    "Dynamic",
    "Evidence",
    "FrameFailure",
    "FromCapture",
    "FromGrid",
    "FromScans",
    "GridOptions",
    "Observation",
    "Observe",
    "RegridResult",
    "VoteRule",
    "Votes",
    "Voting",
    "count_votes",
    "regrid",
    "resample",
]
