"""Packed stores: zarr and HDF5, which hold arrays, and Parquet, which holds tables."""
