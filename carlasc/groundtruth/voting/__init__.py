"""Voting: observations give votes, and votes give a grid."""
