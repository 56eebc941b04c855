"""Packed stores in zarr v3, written by any number of processes.

The format is described in docs/storage.md.
"""
