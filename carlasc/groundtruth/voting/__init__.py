"""Voting: observations are turned into votes, and votes into a grid."""

from carlasc.groundtruth.voting.ballot import Ballot, VoteRule, Votes, count_votes
from carlasc.groundtruth.voting.observations import Observation

__all__ = ["Ballot", "Observation", "VoteRule", "Votes", "count_votes"]
