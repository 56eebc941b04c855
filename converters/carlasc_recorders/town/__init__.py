"""A small procedural town with traffic, and LiDARs that scan it."""
