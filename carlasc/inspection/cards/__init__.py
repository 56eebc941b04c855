"""Data cards: contents, origin and licence of a data set, for people (README.md) and for programs
(croissant.json).
"""
