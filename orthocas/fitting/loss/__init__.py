"""The loss of a fit: one module per term, weights, and the residuals of one sample with their derivatives."""

from orthocas.fitting.loss.angles import mutual_cosines, pairs, task_cosines
from orthocas.fitting.loss.length import log_lengths
from orthocas.fitting.loss.metric_angles import leak_sines, metric_mutual_cosines
from orthocas.fitting.loss.registry import register, term_of
from orthocas.fitting.loss.regularity import FOLD_TERM, LEAST_CONDITIONING, REGULAR_VOLUME, gradient_volume
from orthocas.fitting.loss.residuals import Loss, Pairs, coordinates_of
from orthocas.fitting.loss.term import Data, LossTerm, Sizes
from orthocas.fitting.loss.weights import ANGLES, DEFAULT_WEIGHTS, WeightNumbers, Weights

__all__ = [
    "ANGLES",
    "DEFAULT_WEIGHTS",
    "FOLD_TERM",
    "LEAST_CONDITIONING",
    "REGULAR_VOLUME",
    "Data",
    "Loss",
    "LossTerm",
    "Pairs",
    "Sizes",
    "WeightNumbers",
    "Weights",
    "coordinates_of",
    "gradient_volume",
    "leak_sines",
    "log_lengths",
    "metric_mutual_cosines",
    "mutual_cosines",
    "pairs",
    "register",
    "task_cosines",
    "term_of",
]
