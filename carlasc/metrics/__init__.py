"""How good a grid is: confusion and completeness, rays, segments, uncertainty, time; the conventions of the benchmarks; scores over data sets."""

from carlasc.metrics.casting import cast_rays, rayiou_directions
from carlasc.metrics.confusion import Completeness, ConfusionMatrix
from carlasc.metrics.conventions import CONVENTIONS, Convention, ConventionScore, convention_named
from carlasc.metrics.evaluation import evaluate
from carlasc.metrics.masks import distance_band, field_of_view, known, semantickitti
from carlasc.metrics.panoptic import PanopticQuality, PanopticScore
from carlasc.metrics.rays import RayIoU, RayPQ, RayScore, ray_origins
from carlasc.metrics.regions import Breakdown, distance_bands, height_bands, motion, visibility
from carlasc.metrics.sampling import Comparison, Interval, bootstrap, compare
from carlasc.metrics.scores import Evaluation, geometric_table, semantic_table
from carlasc.metrics.tables import Table
from carlasc.metrics.temporal import Consistency, Forecasting, ForecastScore, moved_grid, shape_consistency
from carlasc.metrics.truth import TruthScore, score_truth
from carlasc.metrics.uncertainty import Reliability, Uncertainty, UncertaintyScore

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
    "Interval",
    "PanopticQuality",
    "PanopticScore",
    "RayIoU",
    "RayPQ",
    "RayScore",
    "Reliability",
    "Table",
    "TruthScore",
    "Uncertainty",
    "UncertaintyScore",
    "bootstrap",
    "cast_rays",
    "compare",
    "convention_named",
    "distance_band",
    "distance_bands",
    "evaluate",
    "field_of_view",
    "geometric_table",
    "height_bands",
    "known",
    "motion",
    "moved_grid",
    "ray_origins",
    "rayiou_directions",
    "score_truth",
    "semantic_table",
    "semantickitti",
    "shape_consistency",
    "visibility",
]
