"""`Dataset`: samples for training, from any Source."""

from carlasc.dataset.labels import RemapLike
from carlasc.dataset.samples import EVIDENCE_FIELDS, FIELDS, Dataset, collate
from carlasc.dataset.sampling import ShardSampler
from carlasc.dataset.transforms import Flip, Sample

__all__ = ["EVIDENCE_FIELDS", "FIELDS", "Dataset", "Flip", "RemapLike", "Sample", "ShardSampler", "collate"]
