"""Masses and inertias of MJCF bodies: from their inertial element, or from their geoms."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from orthocas.robots.mjcf_poses import Angles, pose, shape_pose
from orthocas.robots.mjcf_schema import ORIENTATIONS
from orthocas.robots.xml import Attributes
from orthocas.tools.checks import Array

Placed = tuple[pin.SE3, Attributes]  # an element, with the pose of its frame in the body

_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}
_MASSLESS = ("plane", "hfield")
_FROM_FILE = ("mesh", "sdf")
_ROUNDING = 1e-10  # relative rounding of moments of inertia
_DENSITY = 1000.0  # [kg/m^3] of a geom without mass and density


@dataclass(frozen=True, slots=True)
class MassRules:
    """The settings of <compiler> for masses."""

    source: str  #: inertiafromgeom
    groups: tuple[float, float]  #: first and last geom group that has mass
    least_mass: float  #: [kg]
    least_inertia: float  #: [kg m^2]
    balance: bool  #: whether to average inertias that violate the triangle inequality
    total: float  #: mass to scale all bodies to [kg]; no scaling if not positive

    @classmethod
    def of(cls, compiler: Attributes) -> "MassRules":
        """Read the attributes of <compiler>.

        Raises:
            RobotError: if an attribute is invalid.
        """
        first, last = compiler.numbers("inertiagrouprange", 2, (0, 5))
        return cls(
            source=compiler.keyword("inertiafromgeom", ("auto", "true", "false"), "auto"),
            groups=(first, last),
            least_mass=compiler.number("boundmass", 0),
            least_inertia=compiler.number("boundinertia", 0),
            balance=compiler.flag("balanceinertia"),
            total=compiler.number("settotalmass", -1),
        )


def body_inertia(
    body: Attributes, inertial: Placed | None, geoms: Iterable[Placed], rules: MassRules, angles: Angles
) -> pin.Inertia:
    """Mass, centre and inertia of a body in its own frame.

    Source:
        The MuJoCo reference, body/inertial, body/geom and compiler.

    Raises:
        RobotError: if the inertia is not physical, or the mass depends on a mesh.
    """
    inertia = pin.Inertia.Zero()
    if rules.source == "true" or (rules.source == "auto" and inertial is None):
        for frame, geom in geoms:
            inertia += frame.act(_geom_inertia(geom, rules, angles))
    if inertial is not None and inertia.mass == 0:
        frame, element = inertial
        inertia = frame.act(_given_inertia(element, angles))
    return _bounded(body, inertia, rules)


def _given_inertia(element: Attributes, angles: Angles) -> pin.Inertia:
    """The inertia of an <inertial> element, in the frame around it."""
    element.text("pos")
    mass = element.number("mass")
    if mass < 0:
        raise element.error(f"has mass {mass:g} kg, expected >= 0")
    placement = pose(element, angles)
    if ("diaginertia" in element.values) == ("fullinertia" in element.values):
        raise element.error("has no inertia, expected diaginertia or fullinertia")
    if "fullinertia" in element.values and any(name in element.values for name in ORIENTATIONS):
        raise element.error("has both fullinertia and an orientation, expected one of them")
    if "diaginertia" in element.values:
        matrix = np.diag(element.numbers("diaginertia", 3))
    else:
        xx, yy, zz, xy, xz, yz = element.numbers("fullinertia", 6)
        matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    moments = np.asarray(np.linalg.eigvalsh(matrix), dtype=np.float64)
    if moments[0] < -_ROUNDING * moments[2]:
        raise element.error(f"has principal moments of inertia {_listed(moments)}, expected numbers >= 0")
    return placement.act(pin.Inertia(mass, np.zeros(3), matrix))


def _geom_inertia(geom: Attributes, rules: MassRules, angles: Angles) -> pin.Inertia:
    """The inertia of a solid of uniform density, in the frame around it. Zero for a geom without mass."""
    kind = geom.keyword("type", (*_SIZES, *_MASSLESS, *_FROM_FILE), "sphere")
    mass, density = geom.number("mass", -1), geom.number("density", _DENSITY)
    given = "mass" in geom.values
    if (mass if given else density) < 0:
        raise geom.error("has a negative mass or density")
    if not rules.groups[0] <= geom.number("group", 0) <= rules.groups[1] or kind in _MASSLESS:
        return pin.Inertia.Zero()
    if (mass if given else density) == 0:
        return pin.Inertia.Zero()
    if kind in _FROM_FILE or "mesh" in geom.values:
        raise geom.error("takes its inertia from a mesh, which orthocas does not support: give the body an <inertial>")
    if geom.flag("shellinertia"):
        raise geom.error("has shellinertia, which orthocas does not support: give the body an <inertial>")
    placement, half_length = shape_pose(geom, angles)
    sizes = _sizes(geom, kind, half_length)
    return placement.act(_solid(kind, sizes, mass if given else density * _volume(kind, sizes)))


def _sizes(geom: Attributes, kind: str, half_length: float | None) -> Array:
    """Radii and half lengths of the shape [m]."""
    words = geom.text("size", "").split()
    wanted = _SIZES[kind] if half_length is None else 1
    if not wanted <= len(words) <= 3:
        raise geom.error(f"has size '{' '.join(words)[:80]}', expected {wanted} numbers for a {kind}")
    sizes = geom.numbers("size", len(words))[:wanted]
    if half_length is not None:  # equal radii; the length is the distance of the two points
        sizes = np.append(np.repeat(sizes, _SIZES[kind] - 1), half_length)
    if sizes.min() <= 0:
        raise geom.error(f"has size '{' '.join(words)[:80]}', expected numbers > 0")
    return sizes


def _volume(kind: str, sizes: Array) -> float:
    """Volume [m^3]."""
    r, half = sizes[0], sizes[-1]
    if kind == "capsule":
        return float(2 * np.pi * r**2 * half + 4 / 3 * np.pi * r**3)
    if kind == "cylinder":
        return float(2 * np.pi * r**2 * half)
    if kind == "box":
        return float(8 * sizes.prod())
    return float(4 / 3 * np.pi * (r**3 if kind == "sphere" else sizes.prod()))


def _solid(kind: str, sizes: Array, mass: float) -> pin.Inertia:
    """The inertia of a uniform solid, in its own frame."""
    if kind == "sphere":
        return pin.Inertia.FromSphere(mass, sizes[0])
    if kind == "ellipsoid":
        return pin.Inertia.FromEllipsoid(mass, *sizes)
    if kind == "box":
        return pin.Inertia.FromBox(mass, *(2 * sizes))
    make = pin.Inertia.FromCapsule if kind == "capsule" else pin.Inertia.FromCylinder
    return make(mass, sizes[0], 2 * sizes[1])


def _bounded(body: Attributes, inertia: pin.Inertia, rules: MassRules) -> pin.Inertia:
    """The inertia after the compiler's bounds, checked to be physical."""
    moments, axes = np.linalg.eigh(inertia.inertia)
    bounded = np.maximum(moments, rules.least_inertia)
    if bounded[0] + bounded[1] < (1 - _ROUNDING) * bounded[2]:
        if not rules.balance:
            raise body.error(
                f"has principal moments of inertia {_listed(bounded)}, expected none above the sum of the others"
            )
        bounded = np.full(3, bounded.mean())
    if (bounded != moments).any():
        inertia = pin.Inertia(inertia.mass, inertia.lever, axes @ np.diag(bounded) @ axes.T)
    return pin.Inertia(max(inertia.mass, rules.least_mass), inertia.lever, inertia.inertia)


def _listed(moments: Array) -> str:
    return ", ".join(f"{moment:.4g}" for moment in moments)
