"""CarlaSC and SemanticKITTI as one data set: free, standing, and what can move."""

import sys

from torch.utils.data import ConcatDataset

from carlasc import Augment, Dataset, GridSpec

GRID = GridSpec.published("coarse")  # both need grids of this geometry: `carlasc regrid`


def mixture(augment: Augment, grid: GridSpec = GRID) -> ConcatDataset[dict[str, object]]:
    """Return the training splits of the folders that are given to the command."""
    parts = []
    for folder in sys.argv[1:]:
        table = Dataset(folder, remap=None).classes
        actors = table.moving | table.movable
        remap = {i: 0 if i == 0 else 1 + (i in actors) for i in table.names}
        part = Dataset(folder, "train", grid=grid, history=2, remap=remap, transform=augment)
        part.axes = "left"  # those of SemanticKITTI are right-handed
        parts.append(part)
    return ConcatDataset(parts)
