"""Packed stores in zarr v3, which any number of processes write. The format is described in docs/storage.md."""
