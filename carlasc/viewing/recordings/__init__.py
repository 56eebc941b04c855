"""Recordings for other viewers: Rerun and Foxglove."""
