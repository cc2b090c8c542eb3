"""Seeded samples of a domain: uniform, boundary-weighted, and evenly spread."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from orthocas.errors import DomainError
from orthocas.tasks.domains import Domain
from orthocas.tools.checks import Array, require_count, require_memory


@dataclass(frozen=True, slots=True)
class SamplingRules:
    """Numbers of the sampling of domains."""

    most: int = 10**12  #: samples of one call
    powers: tuple[float, ...] = (1.0, 0.5, 0.25)  #: of the distance from the centre: uniform, near faces, near corners
    least_fraction: float = 1e-3  #: of the points of the box that must lie in the domain
    tried: int = 10_000  #: points after which that counts
    block: int = 1000  #: fewest points to draw at once, after the first ones


RULES = SamplingRules()


def sample_uniform(domain: Domain, samples: int, seed: int | tuple[int, ...]) -> Array:
    """Draw points uniformly from the domain, (samples, n)."""
    rng = _make_generator(domain, samples, seed)
    return _keep_inside(domain, samples, lambda count: domain.draw(rng, count, 1.0))


def sample_boundary_weighted(domain: Domain, samples: int, seed: int | tuple[int, ...]) -> Array:
    """Draw points of which a third is uniform, a third near faces and a third near corners, (samples, n).

    Charts fail there first. The distances from the centre are |u|^p half-widths, with uniform u and p = 1, 1/2 and 1/4.

    Source:
        ours.
    """
    rng, third = _make_generator(domain, samples, seed), samples // 3
    sizes = (samples - 2 * third, third, third)
    parts = [
        _keep_inside(domain, size, partial(domain.draw, rng, power=power))
        for size, power in zip(sizes, RULES.powers, strict=True)
    ]
    return np.vstack(parts)


def sample_evenly(domain: Domain, samples: int, seed: int | tuple[int, ...]) -> Array:
    """Draw points that fill the domain more evenly than random points, (samples, n).

    They follow the additive recurrence frac(shift + k alpha), alpha_j = g^-j, with g the root of g^(n+1) = g + 1 and a
    random shift. Each point is uniformly distributed, and every part of the sequence is even. Means over the domain
    converge faster than with independent points. Domains that draw points themselves get independent ones.

    Source:
        M. Roberts, docs/reference/references.md [R2018]. The use for training is ours.
    """
    if domain.draws_itself:
        return sample_uniform(domain, samples, seed)
    rng, n = _make_generator(domain, samples, seed), len(domain.centre)
    # The generalised golden ratio, by fixed-point iteration.
    g = 1.5
    for _ in range(64):
        g = (1 + g) ** (1 / (n + 1))
    shift, done = rng.uniform(size=n), 0

    def draw(count: int) -> Array:
        nonlocal done
        k = np.arange(done + 1, done + count + 1)[:, None]
        done += count
        u = 2 * ((shift + k * g ** -np.arange(1.0, n + 1)) % 1.0) - 1
        return np.asarray(domain.centre + domain.half_width * u)

    return _keep_inside(domain, samples, draw)


def _make_generator(domain: Domain, samples: int, seed: int | tuple[int, ...]) -> np.random.Generator:
    """The generator of a seed, after checks of what is asked for."""
    require_count("samples", samples, most=RULES.most)
    for part in seed if isinstance(seed, tuple) else (seed,):
        require_count("seed", part, least=0)
    require_memory(f"{samples} samples", 32.0 * samples * len(domain.centre))
    return np.random.default_rng(seed)


def _keep_inside(domain: Domain, samples: int, draw: Callable[[int], Array]) -> Array:
    """The first points of a sequence that lie in the domain, (samples, n); `draw` returns the next so many points.

    Raises:
        DomainError: if next to none of them does.
    """
    kept = [np.empty((0, len(domain.centre)))]
    drawn, count, size = 0, 0, samples
    while count < samples:
        # Give up where next to no point of the box lies in the domain.
        if drawn >= RULES.tried and count < RULES.least_fraction * drawn:
            raise DomainError(
                f"{count} of {drawn} points of its box lie in the domain, expected at least "
                f"{RULES.least_fraction:.1%}: lower least_singular_value, or raise the radius of the corridor"
            )
        points = draw(size)
        kept.append(points[domain.contains(points)])
        drawn, count = drawn + size, count + len(kept[-1])
        size = max(samples - count, RULES.block)
    return np.concatenate(kept)[:samples]
