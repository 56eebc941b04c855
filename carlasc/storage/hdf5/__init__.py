"""Packed stores in one HDF5 file. The format is described in docs/storage.md."""
