"""How good a grid is: confusion matrix, IoU, completeness, masks of the voxels that count, and scores of data sets."""

from carlasc.metrics.comparison import Outcome, compare_grids
from carlasc.metrics.confusion import Completeness, ConfusionMatrix
from carlasc.metrics.evaluation import evaluate
from carlasc.metrics.masks import distance_band, field_of_view, known, semantickitti
from carlasc.metrics.scores import Evaluation, geometric_table, semantic_table
from carlasc.metrics.tables import Table
from carlasc.metrics.truth import TruthScore, score_truth

__all__ = [
    "Completeness",
    "ConfusionMatrix",
    "Evaluation",
    "Outcome",
    "Table",
    "TruthScore",
    "compare_grids",
    "distance_band",
    "evaluate",
    "field_of_view",
    "geometric_table",
    "known",
    "score_truth",
    "semantic_table",
    "semantickitti",
]
