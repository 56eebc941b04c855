from .labels import RemapLike as RemapLike
from .samples import EVIDENCE_FIELDS as EVIDENCE_FIELDS
from .samples import FIELDS as FIELDS
from .samples import Dataset as Dataset
from .samples import collate as collate
from .sampling import ShardSampler as ShardSampler
from .transforms import Flip as Flip
from .transforms import Sample as Sample
