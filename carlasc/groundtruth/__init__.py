"""Ground truth: observations are turned into votes and votes into grids, and a run does so for a whole data set."""

from __future__ import annotations

from typing import TYPE_CHECKING

from carlasc.loading import late_names

if TYPE_CHECKING:
    from carlasc.groundtruth.from_grid import resample
    from carlasc.groundtruth.options import (
        Complete,
        Dynamic,
        FromCapture,
        FromGrid,
        FromScans,
        GridOptions,
        Motion,
        Observe,
        PoseSource,
        Voting,
    )
    from carlasc.groundtruth.run import RegridResult, regrid
    from carlasc.groundtruth.voting.ballot import Ballot, Observation, VoteRule, Votes, count_votes
    from carlasc.groundtruth.voting.certainty import VoxelCertainty
    from carlasc.groundtruth.work import FrameFailure
else:
    __getattr__, __dir__ = late_names(
        __name__,
        {
            "from_grid": ("resample",),
            "work": ("FrameFailure",),
            "options": (
                "Complete",
                "Dynamic",
                "FromCapture",
                "FromGrid",
                "FromScans",
                "GridOptions",
                "Motion",
                "Observe",
                "PoseSource",
                "Voting",
            ),
            "run": ("RegridResult", "regrid"),
            "voting.ballot": ("Ballot", "Observation", "VoteRule", "Votes", "count_votes"),
            "voting.certainty": ("VoxelCertainty",),
        },
    )

__all__ = [
    "Ballot",
    "Complete",
    "Dynamic",
    "FrameFailure",
    "FromCapture",
    "FromGrid",
    "FromScans",
    "GridOptions",
    "Motion",
    "Observation",
    "Observe",
    "PoseSource",
    "RegridResult",
    "VoteRule",
    "Votes",
    "Voting",
    "VoxelCertainty",
    "count_votes",
    "regrid",
    "resample",
]
