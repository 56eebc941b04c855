"""`Dataset`: samples for training, from any Source."""

from carlasc.dataset.labels import RemapLike
from carlasc.dataset.samples import FIELDS, Dataset, collate
from carlasc.dataset.transforms import Flip, Sample

__all__ = ["FIELDS", "Dataset", "Flip", "RemapLike", "Sample", "collate"]
