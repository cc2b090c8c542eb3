"""Draws a run of the scene with MuJoCo's renderer, without a screen or a graphics card, as an animated picture."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from arm_log import Log
from PIL import Image, ImageDraw, ImageFont

import orthocas as oc
from orthocas.simulation import Outcome, Trajectory
from orthocas.simulation.figure import save_animation

SIZE = (480, 400)  # [pixel]
_COLOURS, _SAMPLED = 64, 4  # of every fourth frame
_ARROW = np.array([0.85, 0.1, 0.1, 1.0], dtype=np.float32)  # colour of pushes
_METRES = 0.004  # length of a push's arrow per newton


def save_film(path: Path, scene: Path, q: np.ndarray, pushes: np.ndarray, captions: list[str], period: float) -> None:
    """Write an animated GIF of N instants.

    Args:
        path: of the film.
        scene: the MJCF file.
        q: joint positions (N, n) [rad].
        pushes: forces on body3, in the world (N, 3) [N].
        captions: a line for each instant.
        period: for which the film shows each instant [s].

    Raises:
        Exception: of various kinds, if MuJoCo cannot draw on this machine.
    """
    font, frames = ImageFont.load_default(17), []
    for picture, caption in zip(_pictures(scene, q, pushes), captions, strict=True):
        frame = Image.fromarray(picture)
        ImageDraw.Draw(frame).text((12, 10), caption, fill=(20, 20, 20), font=font)
        frames.append(frame)
    samples = Image.fromarray(np.vstack([np.asarray(frame) for frame in frames[::_SAMPLED]]))
    palette = samples.quantize(_COLOURS)
    first, *rest = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    first.save(path, save_all=True, append_images=rest, duration=round(1000 * period), loop=0, optimize=True)


def save_drawing(path: Path, log: Log, ticks: np.ndarray, chart: oc.Chart) -> None:
    """Write a film of lines instead: the arm and its coordinates at the given ticks."""
    phi, unknown = log.phi[ticks], np.full(len(ticks), np.nan)
    run = Trajectory(
        controller="supervised PD+ in C",
        kind="torque",
        outcome=Outcome.COMPLETE,
        labels=chart.labels,
        joint_names=chart.problem.robot.joint_names,
        times=log.time[ticks],
        q=log.q[ticks],
        dq=log.dq[ticks],
        command=log.torque[ticks],
        status=log.status[ticks],
        value=phi,
        reference=log.reference[ticks],
        reference_velocity=np.zeros_like(phi),
        reference_acceleration=np.zeros_like(phi),
        storage=unknown,
        dissipated_power=unknown,
        cause=np.zeros_like(log.status[ticks]),
    )
    save_animation(path, run, chart.problem, force=True)


def _pictures(scene: Path, q: np.ndarray, pushes: np.ndarray) -> Iterator[np.ndarray]:
    if "DISPLAY" not in os.environ:
        os.environ.setdefault("MUJOCO_GL", "egl")  # else MuJoCo looks for a screen
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(scene))
    data = mujoco.MjData(model)
    width, height = SIZE
    with mujoco.Renderer(model, height, width) as renderer:
        for positions, push in zip(q, pushes, strict=True):
            data.qpos[:] = positions
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, "side")
            if push.any():
                _add_arrow(mujoco, renderer.scene, data.body("body3").xpos, push)
            yield renderer.render()


def _add_arrow(mujoco: Any, scene: Any, end: np.ndarray, force: np.ndarray) -> None:
    """An arrow that ends at the pushed body."""
    geom, kind = scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_ARROW
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), _ARROW)
    mujoco.mjv_connector(geom, kind, 0.02, end - _METRES * force, end)
    scene.ngeom += 1
