"""Code that all packed stores share, and array code of zarr and HDF5: the place of a frame, its
columns and its chunks.
"""
