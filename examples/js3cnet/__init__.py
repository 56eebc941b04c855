"""JS3C-Net: joint segmentation of points and completion of scenes (Yan et al., AAAI 2021)."""
