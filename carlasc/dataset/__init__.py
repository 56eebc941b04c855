"""`Dataset`: samples for training, from any Source."""

from carlasc.dataset.samples import Dataset, Sample, collate
from carlasc.dataset.transforms import Flip

__all__ = ["Dataset", "Flip", "Sample", "collate"]
