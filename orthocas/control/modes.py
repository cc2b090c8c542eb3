"""Modes of the closed loop, linearised at rest where the reference is met (ours)."""

from dataclasses import dataclass

import numpy as np

from orthocas.checks import Array
from orthocas.showing import Shown, number_list


@dataclass(frozen=True, eq=False, repr=False)
class Modes(Shown):
    """Modes of M_phi dde + D de + K e = 0 at one posture (n,) or at several (N, n).

    Mode i has the shape v_i with K v_i = omega_i^2 M_phi v_i and v_i^T M_phi v_i = 1. Its damping ratio is
    v_i^T D v_i / (2 omega_i). This is exact if D is diagonal in the modes, as for coupled laws with `double_diagonal`
    and one damping ratio for all.
    """

    frequencies: Array  #: [Hz], in ascending order
    damping_ratios: Array  #: infinite for a mode without a spring
    delays: Array  #: longest delay of the loop with which the mode alone stays stable [s]

    def facts(self) -> dict[str, str]:
        """Frequencies, damping ratios and delay."""
        return {
            "modes": f"{number_list(np.median(np.atleast_2d(self.frequencies), axis=0))} Hz",
            "fastest": f"{self.frequencies.max():.4g} Hz",
            "damping ratios": f"{self.damping_ratios.min():.3g} to {self.damping_ratios.max():.3g}",
            "delay": f"stable up to {1e3 * self.delays.min():.3g} ms",
        }


def modes_of(mobility: Array, stiffness: Array, damping: Array) -> Modes:
    """Modes for M_phi^-1 (N, n, n), the diagonal of K (n,), and D (N, n, n).

    With S = M_phi^-1/2 and the unit eigenvectors u_i of S K S, v_i = S u_i.
    """
    values, vectors = np.linalg.eigh(mobility)
    half = (vectors * np.sqrt(values.clip(0))[:, None, :]) @ vectors.transpose(0, 2, 1)
    squares, shapes = np.linalg.eigh((half * stiffness) @ half)
    omega = np.sqrt(squares.clip(0))
    rates = np.einsum("kij,kij->kj", shapes, half @ damping @ half @ shapes)  # 2 zeta omega [1/s]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = rates / (2 * omega)
    return Modes(omega / (2 * np.pi), ratios, _longest_delays(omega, rates))


def _longest_delays(omega: Array, rates: Array) -> Array:
    """Delay [s] at which s^2 + (rate s + omega^2) exp(-s T) = 0 gets a root i Omega.

    The modulus gives Omega^2 = rate^2/2 + sqrt(rate^4/4 + omega^4), the phase T = atan(rate Omega / omega^2) / Omega.
    """
    crossing = np.sqrt(rates**2 / 2 + np.sqrt(rates**4 / 4 + omega**4))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.arctan2(rates * crossing, omega**2) / crossing)
