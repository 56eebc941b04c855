"""Converters of other data sets into the CarlaSC layout, found through the entry-point group `carlasc.converters`."""
