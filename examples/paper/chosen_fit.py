"""What takes the place of the paper's network in a figure of a fit: by default a polynomial, on demand a network."""

from dataclasses import dataclass

from orthocas.bases import Parametrisation
from orthocas.charts.chart import Chart
from orthocas.fitting.fit import fit
from orthocas.fitting.terms import Weights
from orthocas.solvers import LBFGS
from orthocas.tasks.problem import Problem

from .paper_loss import PAPER_LOSS

_FEW, _SHORT = 1000, 300  # samples and iterations of a network in quick figures


@dataclass(frozen=True)
class ChosenFit:
    """A parametrisation for the fits of a figure, and the seed of their samples and of the start of a network."""

    parametrisation: Parametrisation | None = None  #: None: that of the figure
    seed: int = 0

    def chart(
        self,
        problem: Problem,
        usual: Parametrisation,
        quick: bool,
        samples: int | None = None,
        weights: Weights = PAPER_LOSS,
    ) -> Chart:
        """Fit the chosen parametrisation, or the usual one.

        Args:
            problem: what to fit.
            usual: the parametrisation that the figure has by itself.
            quick: whether a network may be trained less.
            samples: number of samples of a parametrisation that is linear in its parameters.
            weights: weights of the loss.
        """
        wanted = self.parametrisation or usual
        if wanted.linear:
            return fit(problem, wanted, weights=weights, samples=samples, seed=self.seed).chart
        solver = LBFGS(max_iterations=_SHORT) if quick else LBFGS()
        return fit(problem, wanted, solver, weights=weights, samples=_FEW if quick else None, seed=self.seed).chart


USUAL = ChosenFit()  #: what a figure has by itself
