"""Reading data: what exists (`info`), how much of each class (`stats`), whether it is sound (`validate`, `holdout`), how it was made (`report`), and all of that to publish (`card`); and what is installed (`doctor`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from carlasc.loading import late_names

if TYPE_CHECKING:
    from carlasc.inspection.cards.card import CardResult, card
    from carlasc.inspection.findings import Finding, ValidationResult
    from carlasc.inspection.heldout import HoldoutResult, holdout
    from carlasc.inspection.heldout_scores import HeldOutScores, RayShares
    from carlasc.inspection.installation import Installation, doctor
    from carlasc.inspection.overview import Overview, info
    from carlasc.inspection.report_page import write_report_page
    from carlasc.inspection.reports import ReportResult, report
    from carlasc.inspection.statistics import Statistics, stats
    from carlasc.inspection.validation import validate
else:
    __getattr__, __dir__ = late_names(
        __name__,
        {
            "cards.card": ("CardResult", "card"),
            "findings": ("Finding", "ValidationResult"),
            "heldout": ("HoldoutResult", "holdout"),
            "heldout_scores": ("HeldOutScores", "RayShares"),
            "installation": ("Installation", "doctor"),
            "overview": ("Overview", "info"),
            "report_page": ("write_report_page",),
            "reports": ("ReportResult", "report"),
            "statistics": ("Statistics", "stats"),
            "validation": ("validate",),
        },
    )

__all__ = [
    "CardResult",
    "Finding",
    "HeldOutScores",
    "HoldoutResult",
    "Installation",
    "Overview",
    "RayShares",
    "ReportResult",
    "Statistics",
    "ValidationResult",
    "card",
    "doctor",
    "holdout",
    "info",
    "report",
    "stats",
    "validate",
    "write_report_page",
]
