"""The loss of the paper's figures: its cosines with Euclidean norms, also for A = M."""

from orthocas.fitting.loss import Weights

PAPER_LOSS = Weights(angles="paper")  #: default weights, the angles of [AS2023] eq. (24)
