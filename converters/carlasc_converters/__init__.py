"""Converters of other data sets into the CarlaSC layout.

`carlasc` finds them through the entry-point group `carlasc.converters`.
"""
