"""Coordinates of the planar arm with two joints, fitted on the whole torus: what Figs. 17 and 18 of [AS2023] share."""

from orthocas import api
from orthocas.chart import Chart
from orthocas.parametrisations import Fourier
from orthocas.problem import Problem


def fitted_chart(problem: Problem, quick: bool) -> Chart:
    """Fourier terms on the torus.

    The paper fits a network. On two cores Fourier terms of degree 12 take some seconds for either metric; MLPs of
    16 x 16 and 32 x 32 are as good for A = I with some seeds, but ended in much worse minima for A = M with all three
    seeds tried.
    """
    return api.fit(problem, Fourier(5 if quick else 12), samples=1500 if quick else 8000).chart
