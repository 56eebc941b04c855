from .fields import EVIDENCE_FIELDS as EVIDENCE_FIELDS
from .fields import FIELDS as FIELDS
from .fields import Sample as Sample
from .fields import collate as collate
from .labels import RemapLike as RemapLike
from .samples import Dataset as Dataset
from .sampling import ShardSampler as ShardSampler
from .transforms import Flip as Flip
