"""The loss of the paper's figures: its cosines with Euclidean norms, also for A = M, and no search for folds."""

from orthocas.fitting.terms import Weights

PAPER_LOSS = Weights(folds=0.0, angles="paper")  #: other weights by default, the angles of [AS2023] eq. (24)
