"""Samples of a domain with many points near its faces and corners, where charts fail first (ours)."""

import numpy as np

from orthocas.checks import Array
from orthocas.domains import Domain, sample_uniform

_POWERS = (1.0, 0.5, 0.25)  # of the distance from the middle: uniform, near faces, near corners


def sample_heavily(domain: Domain, samples: int, seed: int) -> Array:
    """Points of which a third is uniform, a third near faces and a third near corners, (samples, n).

    The distances from the centre are |u|^p half-widths, with uniform u and p = 1, 1/2 and 1/4.
    """
    powers = np.repeat(_POWERS, [samples - 2 * (samples // 3), samples // 3, samples // 3])
    unit = (sample_uniform(domain, samples, seed) - domain.centre) / domain.half_width
    points: Array = domain.centre + domain.half_width * np.sign(unit) * np.abs(unit) ** powers[:, None]
    return points
