"""Reading data: what exists (`info`), how much of each class (`stats`), whether it is sound (`validate`, `holdout`), how it was made (`report`)."""

from carlasc.inspection.findings import Finding, ValidationResult
from carlasc.inspection.heldout import HoldoutResult, holdout
from carlasc.inspection.heldout_scores import HeldOutScores, RayShares
from carlasc.inspection.overview import Overview, info
from carlasc.inspection.report_page import write_report_page
from carlasc.inspection.reports import ReportResult, report
from carlasc.inspection.statistics import Statistics, stats
from carlasc.inspection.validation import validate

__all__ = [
    "Finding",
    "HeldOutScores",
    "HoldoutResult",
    "Overview",
    "RayShares",
    "ReportResult",
    "Statistics",
    "ValidationResult",
    "holdout",
    "info",
    "report",
    "stats",
    "validate",
    "write_report_page",
]
