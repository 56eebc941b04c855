"""Data cards: what a data set holds, how it was made and who may use it, for people (README.md) and for programs (croissant.json)."""
