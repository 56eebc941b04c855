"""Scores of grids: confusion and completeness, rays, segments, uncertainty and time; the conventions of the benchmarks; scores over data sets."""

from __future__ import annotations

from typing import TYPE_CHECKING

from carlasc.loading import late_names

if TYPE_CHECKING:
    from carlasc.metrics.casting import cast_rays, rayiou_directions
    from carlasc.metrics.comparison import Outcome, compare_grids
    from carlasc.metrics.confusion import Completeness, ConfusionMatrix
    from carlasc.metrics.conventions import CONVENTIONS, Convention, ConventionScore, convention_named, own_convention
    from carlasc.metrics.evaluation import evaluate, evaluate_by_all_conventions
    from carlasc.metrics.leaderboard import ScoreTable, scores
    from carlasc.metrics.masks import distance_band, field_of_view, known
    from carlasc.metrics.panoptic import PanopticQuality, PanopticScore
    from carlasc.metrics.rays import RayIoU, RayPQ, RayScore, ray_origins
    from carlasc.metrics.regions import Breakdown, distance_bands, height_bands, motion, visibility
    from carlasc.metrics.results import Evaluation, FrameScore, geometric_table, semantic_table
    from carlasc.metrics.sampling import Comparison, Interval, bootstrap, compare
    from carlasc.metrics.tables import Table
    from carlasc.metrics.temporal import Consistency, Forecasting, ForecastScore, moved_grid, shape_consistency
    from carlasc.metrics.truth import TruthScore, score_truth
    from carlasc.metrics.uncertainty import Reliability, Uncertainty, UncertaintyScore
else:
    __getattr__, __dir__ = late_names(
        __name__,
        {
            "casting": ("cast_rays", "rayiou_directions"),
            "comparison": ("Outcome", "compare_grids"),
            "confusion": ("Completeness", "ConfusionMatrix"),
            "conventions": ("CONVENTIONS", "Convention", "ConventionScore", "convention_named", "own_convention"),
            "evaluation": ("evaluate", "evaluate_by_all_conventions"),
            "leaderboard": ("ScoreTable", "scores"),
            "masks": ("distance_band", "field_of_view", "known"),
            "panoptic": ("PanopticQuality", "PanopticScore"),
            "rays": ("RayIoU", "RayPQ", "RayScore", "ray_origins"),
            "regions": ("Breakdown", "distance_bands", "height_bands", "motion", "visibility"),
            "results": ("Evaluation", "FrameScore", "geometric_table", "semantic_table"),
            "sampling": ("Comparison", "Interval", "bootstrap", "compare"),
            "tables": ("Table",),
            "temporal": ("Consistency", "Forecasting", "ForecastScore", "moved_grid", "shape_consistency"),
            "truth": ("TruthScore", "score_truth"),
            "uncertainty": ("Reliability", "Uncertainty", "UncertaintyScore"),
        },
    )

__all__ = [
    "CONVENTIONS",
    "Breakdown",
    "Comparison",
    "Completeness",
    "ConfusionMatrix",
    "Consistency",
    "Convention",
    "ConventionScore",
    "Evaluation",
    "ForecastScore",
    "Forecasting",
    "FrameScore",
    "Interval",
    "Outcome",
    "PanopticQuality",
    "PanopticScore",
    "RayIoU",
    "RayPQ",
    "RayScore",
    "Reliability",
    "ScoreTable",
    "Table",
    "TruthScore",
    "Uncertainty",
    "UncertaintyScore",
    "bootstrap",
    "cast_rays",
    "compare",
    "compare_grids",
    "convention_named",
    "distance_band",
    "distance_bands",
    "evaluate",
    "evaluate_by_all_conventions",
    "field_of_view",
    "geometric_table",
    "height_bands",
    "known",
    "motion",
    "moved_grid",
    "own_convention",
    "ray_origins",
    "rayiou_directions",
    "score_truth",
    "scores",
    "semantic_table",
    "shape_consistency",
    "visibility",
]
