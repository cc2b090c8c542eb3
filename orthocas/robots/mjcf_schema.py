"""The attributes of the MJCF elements that determine kinematics and mass."""

ORIENTATIONS = ("quat", "axisangle", "xyaxes", "zaxis", "euler")  #: an element has at most one of them

_POSE = {"pos", *ORIENTATIONS}
_SHAPE = {"class", "fromto", "group", "material", "mesh", "name", "rgba", "size", "type", "user", *_POSE}


def _words(text: str) -> set[str]:
    return set(text.split())


#: Elements directly below the root.
SECTIONS = _words(
    """asset compiler contact custom default deformable equality actuator extension keyframe option sensor size
    statistic tendon visual worldbody"""
)

#: Actuators. They share one default per class, whichever of these elements sets it.
ACTUATORS = _words(
    "adhesion cylinder damper dcmotor general intvelocity motor muscle orientation plugin position velocity"
)

#: Elements of a default class.
DEFAULTS = _words(
    """adhesion camera cylinder damper dcmotor default equality general geom intvelocity joint light material mesh motor
    muscle orientation pair pid plugin position site skin tendon texture velocity"""
)

#: Attributes by element: those of MuJoCo 4.0 and a few older ones. Others are refused, so that typos are found.
KNOWN = {
    "compiler": _words(
        """alignfree angle assetdir autolimits balanceinertia boundinertia boundmass conflict convexhull coordinate
        discardvisual eulerseq exactmeshinertia fitaabb fusestatic inertiafromgeom inertiagrouprange meshdir passthrough
        savecanonical savecompiled saveinertial settotalmass strippath texturedir usethread"""
    ),
    "option": _words(
        """actuatorgroupdisable apirate ccd_iterations ccd_tolerance collision cone density gravity impratio integrator
        iterations jacobian ls_iterations ls_tolerance magnetic mpr_iterations mpr_tolerance noslip_iterations
        noslip_tolerance o_friction o_margin o_solimp o_solref sdf_initpoints sdf_iterations sleep_tolerance solver
        timestep tolerance viscosity wind"""
    ),
    "worldbody": set[str](),
    "body": _POSE | _words("childclass fuse gravcomp mocap name simple sleep user"),
    "frame": _POSE | _words("childclass massscale name scale scaling"),
    "inertial": _POSE | _words("diaginertia fullinertia mass"),
    "freejoint": _words("align group name"),
    "joint": _words(
        """actuatorfrclimited actuatorfrcrange actuatorgravcomp armature axis class damping frictionloss group limited
        margin name pos range ref solimpfriction solimplimit solreffriction solreflimit springdamper springref
        springyield stiffness type user"""
    ),
    "geom": _SHAPE
    | _words(
        """adhesion castshadow conaffinity condim contype density fitscale fluidcoef fluidshape friction gap hfield
        margin mass priority shellinertia solimp solmix solref surfacevel"""
    ),
    "site": _SHAPE,
}
