"""Observations to votes to grid: the ground truth and how a run over a data set makes it."""

from carlasc.groundtruth.run import FrameFailure, RegridResult, regrid
from carlasc.groundtruth.voting.ballot import Ballot, Votes, count_votes
from carlasc.groundtruth.voting.observations import Observation

__all__ = ["Ballot", "FrameFailure", "Observation", "RegridResult", "Votes", "count_votes", "regrid"]
