"""Observations to votes to grid: the ground truth and how a run over a data set makes it."""
