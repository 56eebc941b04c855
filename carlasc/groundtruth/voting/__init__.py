"""Voting: observations give votes, and votes give a grid."""

from carlasc.groundtruth.voting.ballot import Ballot, Observation, VoteRule, Votes, count_votes

__all__ = ["Ballot", "Observation", "VoteRule", "Votes", "count_votes"]
