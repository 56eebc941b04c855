"""Packed stores: zarr and HDF5, which hold arrays (`arrays`), and Parquet, which holds tables (`tables`)."""
