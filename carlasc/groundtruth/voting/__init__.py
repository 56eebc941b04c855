"""Voting: observations are turned into votes, and votes into a grid."""

from carlasc.groundtruth.voting.ballot import Ballot, Observation, VoteRule, Votes, count_votes

__all__ = ["Ballot", "Observation", "VoteRule", "Votes", "count_votes"]
