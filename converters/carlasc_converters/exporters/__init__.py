"""Exporters: sequences of the layout as the files of other data sets."""
