"""The campaigns by name, and what they cover."""

import inspect
from collections.abc import Callable

from fuzz import signals
from fuzz.arms import arms
from fuzz.calls import calls
from fuzz.certificates import certificates
from fuzz.charts import charts
from fuzz.child import Finding
from fuzz.commands import commands
from fuzz.libraries import libraries
from fuzz.lists import lists
from fuzz.messages import messages
from fuzz.motions import motions
from fuzz.paths import logs, paths, postures
from fuzz.robots import robots
from fuzz.runs import runs
from fuzz.steps import steps
from fuzz.threads import threads
from fuzz.ticks import ticks
from fuzz.views import views

CAMPAIGNS: dict[str, Callable[[int], list[Finding]]] = {
    "arms": arms,
    "calls": calls,
    "certificates": certificates,
    "charts": charts,
    "commands": commands,
    "libraries": libraries,
    "lists": lists,
    "logs": logs,
    "messages": messages,
    "motions": motions,
    "paths": paths,
    "postures": postures,
    "robots": robots,
    "runs": runs,
    "signals": signals.campaign,
    "steps": steps,
    "threads": threads,
    "ticks": ticks,
    "views": views,
}

READERS = {  #: functions that read files, by module and name, with the campaign that gives them mutants
    "charts.chart.load_file": "charts",
    "arms.arm.load": "arms",
    "arms.arm_file.read_charts": "arms",
    "charts.chart_file.read_chart": "charts",
    "charts.ready.load": "charts",
    "native.libraries.load_library": "libraries",
    "paths.joint_motion.read_joints": "motions",
    "paths.tool_path.read_path": "paths",
    "tasks.corridor.read_postures": "postures",
    "robots.urdf.read_srdf_postures": "robots",
    "robots.collision_files.read_disabled_pairs": "robots",
    "robots.collision_files.load_mesh": "robots",
    "robots.shapes.read_mesh": "robots",
    "robots.robot.from_file": "robots",
    "robots.robot.from_mjcf": "robots",
    "robots.robot.from_urdf": "robots",
    "robots.urdf.read_urdf": "robots",
    "robots.urdf.read_urdf_xml": "robots",
    "robots.urdf.read_xml": "robots",
    "simulation.disturbances.read_steps": "steps",
    "simulation.trajectory.load": "runs",
    "simulation.trajectory.read_run_file": "runs",
    "tools.archive.read_archive": "charts",
    "tools.files.read_table": "paths",
    "tools.files.read_list": "lists",
    "viewer.looks.read_urdf_look": "robots",
    "viewer.motion.read_joint_motion": "motions",
    "viewer.motion.read_run": "runs",
}
RESULTS = {  #: public classes whose objects only the library makes, with the campaign that makes and reads them
    **dict.fromkeys(("Branch", "Branches", "Comparison", "Fit", "WideFit", "Involutivity", "Report"), "calls"),
    **dict.fromkeys(
        ("Solutions", "Tracker", "ReachingTracker", "InverseStatus", "TrackerStatus", "MeaningError"), "calls"
    ),
    **dict.fromkeys(("Breakdown", "Coupling", "DampingCheck", "JointMotion", "Margins", "Modes", "Setting"), "calls"),
    **dict.fromkeys(("Contact", "FittedCapsules", "LeastDistance", "NearPairs"), "calls"),
    **dict.fromkeys(("Card", "Model", "Trajectory", "View"), "calls"),
    **dict.fromkeys(("Arc", "ArmTracker", "Gap", "Merge", "Place", "Postures", "SelfMotions"), "calls"),
    "Certificate": "certificates",
    "Domain": "calls",
}


def meaning(name: str) -> str:
    """What a campaign covers, in one line."""
    return (inspect.getmodule(CAMPAIGNS[name]).__doc__ or "").splitlines()[0]
