"""Reading data without changing them: what exists (`info`), how much of each class (`stats`), whether it is sound (`validate`)."""

from carlasc.inspection.findings import Finding, ValidationResult
from carlasc.inspection.overview import Overview, info
from carlasc.inspection.statistics import Statistics, stats
from carlasc.inspection.validation import validate

__all__ = ["Finding", "Overview", "Statistics", "ValidationResult", "info", "stats", "validate"]
