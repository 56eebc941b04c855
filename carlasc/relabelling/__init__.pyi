from .copies import LabelResult as LabelResult
from .from_images import label_images as label_images
from .from_motion import MotionResult as MotionResult
from .from_motion import label_motion as label_motion
from .predictions import label as label
from .refining import RefineResult as RefineResult
from .refining import refine as refine
