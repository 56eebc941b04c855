"""How good a grid is: confusion matrix, IoU, completeness, the masks that say where it counts, and scores over data sets."""

from carlasc.metrics.confusion import Completeness, ConfusionMatrix
from carlasc.metrics.masks import distance_band, field_of_view, known, semantickitti
from carlasc.metrics.truth import TruthScore, score_truth

__all__ = [
    "Completeness",
    "ConfusionMatrix",
    "TruthScore",
    "distance_band",
    "field_of_view",
    "known",
    "score_truth",
    "semantickitti",
]
