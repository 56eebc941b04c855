"""What all packed stores share, and what zarr and HDF5 share: the place of a frame, its columns and its chunks."""
