"""SSCNet: semantic scene completion from a single view (Song et al., CVPR 2017)."""
