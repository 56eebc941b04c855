"""Observations to votes to grid: the ground truth and how a run over a data set makes it."""

from carlasc.groundtruth.observations import Observation
from carlasc.groundtruth.run import FrameFailure, RegridResult, regrid
from carlasc.groundtruth.voting import Ballot, Votes, count_votes

__all__ = ["Ballot", "FrameFailure", "Observation", "RegridResult", "Votes", "count_votes", "regrid"]
