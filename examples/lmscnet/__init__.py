"""LMSCNet: lightweight multiscale 3D semantic completion (Roldao et al., 3DV 2020)."""
