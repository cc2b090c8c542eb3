"""What `suggest_domain` returns: a domain, what ends it in each joint, and the fit that confirms it."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

from orthocas.checks import Array
from orthocas.domains import Domain
from orthocas.fitting.fit import Fit
from orthocas.postures.probe import Bounds
from orthocas.problem import Problem
from orthocas.showing import Shown, listed, number_list

JUDGES = 30_000  #: samples that judge the fit

Reason = Literal["joint limit", "unlimited", "idle", "cyclic", "leak", "conditioning", "singularity", "half a turn"]
_WORDS: dict[Reason, str] = {
    "joint limit": "to the joint limit",
    "unlimited": "as far as tried",
    "idle": "idle, whole range",
    "cyclic": "cyclic, whole range",
    "leak": "ended by the leak",
    "conditioning": "ended by conditioning",
    "singularity": "ended by singularity",
    "half a turn": "ended by half a turn",
}


@dataclass(frozen=True)
class JointWidth:
    """How wide a suggested box is in one joint, and what ends it.

    The reasons "leak", "conditioning", "singularity" and "half a turn" (of the tool, from the reference) name the bound
    that breaks first if this joint alone moves a fifth further. A joint is "unlimited" if it reaches a full turn, or
    1 m, without breaking a bound.
    """

    joint: str
    half_width: float  #: [rad] or [m]
    reason: Reason

    @property
    def explanation(self) -> str:
        """The reason in words."""
        return _WORDS[self.reason]


@dataclass(frozen=True, eq=False, repr=False)
class DomainSuggestion(Shown):
    """A domain with the quality that was asked for, and the fit that confirms it; see `suggest_domain`."""

    fit: Fit  #: the fit on the suggested domain
    home: Array  #: the posture, (n,) [rad] or [m]
    home_source: str  #: where it comes from, in words
    joints: tuple[JointWidth, ...]  #: one per joint
    asked: Bounds
    leak_deg: float  #: of the fit, root mean square over the domain [deg]
    conditioning: float  #: of the fit: the smallest at samples, of which two thirds lie near faces and corners
    worst_point: tuple[float, ...]  #: where the conditioning is smallest [rad] or [m]
    seconds: float

    @property
    def problem(self) -> Problem:
        """Robot, task, metric and suggested domain."""
        return self.fit.chart.problem

    @property
    def domain(self) -> Domain:
        """The suggested domain."""
        return self.problem.domain

    def facts(self) -> dict[str, str]:
        """The box, what limits it, and the quality of the fit."""
        reasons = dict.fromkeys(joint.reason for joint in self.joints)
        ends = {_WORDS[why]: listed(joint.joint for joint in self.joints if joint.reason == why) for why in reasons}
        label = self.fit.chart.coordinates.label
        worst = f"{self.conditioning:.3g} at {JUDGES} samples, most near faces and corners"
        return {
            "suggestion": f"half-width {number_list(self.domain.half_width)}, {self.seconds:.3g} s",
            "home": f"{number_list(self.home)} ({self.home_source})",
            **ends,
            "leak": f"{self.leak_deg:.3g} deg with {label}, asked <= {self.asked.leak_deg:g}",
            "conditioning": f"at least {worst}, asked >= {self.asked.conditioning:g}",
        }

    def as_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {
            "home": self.home.tolist(),
            "home_source": self.home_source,
            "joints": [asdict(joint) for joint in self.joints],
            "leak_deg": self.leak_deg,
            "conditioning": self.conditioning,
            "worst_point": list(self.worst_point),
            "asked": asdict(self.asked),
            "seconds": self.seconds,
        }
