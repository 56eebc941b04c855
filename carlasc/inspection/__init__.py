"""Looking at data without changing them: what exists (`info`), how much of each class (`stats`), whether it is sound (`validate`)."""

from carlasc.inspection.overview import info
from carlasc.inspection.statistics import stats
from carlasc.inspection.validation import validate

__all__ = ["info", "stats", "validate"]
