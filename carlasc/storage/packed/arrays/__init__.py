"""Packed stores of chunked arrays: zarr and HDF5. The format is described in docs/storage.md, section "Arrays"."""
