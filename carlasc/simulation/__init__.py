"""A small procedural town, LiDARs in it, and the raw capture they record."""
