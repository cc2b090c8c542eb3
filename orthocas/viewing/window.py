"""The server that a browser looks at: viser, bound to one address, quiet, and without a way out to other machines."""

import contextlib
import errno
import io
import socket
from types import ModuleType
from typing import Any

import numpy as np

from orthocas.checks import Array, of_extra, require_count
from orthocas.errors import InvalidValueError, ViewError
from orthocas.robots import Robot
from orthocas.viewing.guard import guarded
from orthocas.viewing.stick_arm import chain_length

LOCAL = "127.0.0.1"
BRAND = (31, 95, 168)
_VIEW_ANGLE = 0.7  # [rad] of the camera
_ROOM = 1.1  # around the arms in the picture
_FLAT = 1e-9


def viser() -> ModuleType:
    """The package `viser`, which only views need.

    Raises:
        MissingExtraError: if it is not installed.
    """
    return of_extra("viser", "a view in the browser", "view")


def open_window(host: str, port: int, title: str) -> tuple[Any, str]:
    """A `viser.ViserServer`, and its address for a browser; port 0 takes any free port.

    Raises:
        MissingExtraError: if viser is not installed.
        ViewError: if the port is taken, the host is no address of this machine, or viser cannot be guarded.
    """
    package = viser()
    require_free(host, port)
    with guarded(host) as guard, contextlib.redirect_stdout(io.StringIO()):  # it announces itself
        server = package.ViserServer(host=host, port=port, label=title, verbose=False)
    if not guard.seen:
        close_window(server)
        raise ViewError("this version of viser starts its server in another way, expected one that can be guarded")
    if port not in (0, server.get_port()):  # somebody else was faster
        close_window(server)
        raise _taken(host, port)
    server.request_share_url = _not_shared
    server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=BRAND)
    server.scene.configure_environment_map(None)
    server.scene.configure_default_lights(False)  # `place_lights` has lights without shadows
    return server, f"{url_of(host, server.get_port())}/{guard.token}"


def close_window(server: Any) -> None:
    """Stop a server; pages that are open in browsers say that they lost it."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def require_free(host: str, port: int) -> None:
    """Check that a server can listen there: viser itself would wait forever, or take another port.

    Raises:
        InvalidValueError: if the port is no number from 0 to 65535.
        ViewError: if the port is taken, or the host is no address of this machine.
    """
    require_count("port", port, least=0, most=65535)
    if not isinstance(host, str) or not host:
        raise InvalidValueError("host", repr(host)[:80], "an address of this machine, such as 127.0.0.1")
    try:
        numeric = 0 if host == "localhost" else socket.AI_NUMERICHOST  # no questions to other machines
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=numeric)[0]
    except (OSError, UnicodeError):
        raise ViewError(f"host is {host[:80]!r}, expected an address of this machine, such as {LOCAL}") from None
    with socket.socket(family, kind, protocol) as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind(address)
        except OSError as error:
            raise _refused(host, port, error) from None


def url_of(host: str, port: int) -> str:
    """The address for a browser, without its token."""
    shown = LOCAL if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    return f"http://{shown}:{port}"


def place_camera(server: Any, robot: Robot, q: Array, shift: Array | None = None) -> None:
    """Look at an arm from the front and slightly above, or at a planar arm from the side where its plane is seen.

    Args:
        server: the window.
        robot: the arm.
        q: joint positions (N, n) that should be in the picture.
        shift: places of further arms, (k, 3) [m].
    """
    points = robot.joint_points(q).reshape(-1, 3)
    points = np.concatenate([points, *(points + other for other in ([] if shift is None else shift))])
    low, high = points.min(axis=0), points.max(axis=0)
    middle, radius = (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 0.4 * chain_length(robot.tree))
    up = up_of(robot)
    server.scene.set_up_direction(tuple(up))
    camera = server.initial_camera
    camera.fov = _VIEW_ANGLE
    camera.position = tuple(middle + _ROOM * radius / np.sin(_VIEW_ANGLE / 2) * direction_of_camera(robot))
    camera.look_at = tuple(middle)


def place_floor(server: Any, robot: Robot) -> None:
    """A grid under the arm, or behind a planar one."""
    size = chain_length(robot.tree)
    up = np.abs(up_of(robot))
    plane = "xy" if is_planar(robot) else ("yz", "xz", "xy")[int(np.argmax(up))]
    position = (0.0, 0.0, -0.15 * size) if is_planar(robot) else (0.0, 0.0, 0.0)
    cell = 10.0 ** np.round(np.log10(size / 8))
    server.scene.add_grid(
        "/floor", plane=plane, infinite_grid=True, position=position, cell_size=cell, section_size=5 * cell,
        cell_color=(228, 231, 235), section_color=(205, 210, 217), fade_distance=12 * size, shadow_opacity=0.0,
    )  # fmt: skip


def place_lights(server: Any, robot: Robot) -> None:
    """Light from the sky, from the left of the camera, and weaker from its right.

    There are no shadows and no environment map: without a graphics card, they take most of the time of a picture.
    """
    scene, up, ahead = server.scene, up_of(robot), direction_of_camera(robot)
    left = np.cross(ahead, up)
    scene.add_light_hemisphere(
        "/lights/sky", sky_color=(255, 255, 255), ground_color=(150, 156, 166), intensity=2.1, position=tuple(up)
    )
    for name, intensity, place in (("key", 1.8, left + 1.5 * up + ahead), ("fill", 0.5, ahead - left)):
        scene.add_light_directional(f"/lights/{name}", intensity=intensity, position=tuple(map(float, place)))


def is_planar(robot: Robot) -> bool:
    """Whether an arm moves in the x-y plane."""
    tree = robot.tree
    return bool(
        np.abs(tree.rotations[:, 2] - [0, 0, 1]).max() < _FLAT and np.abs(tree.translations[:, 2]).max() < _FLAT
    )


def direction_of_camera(robot: Robot) -> Array:
    """Unit vector to the camera: from the front, the side and above, or from where a plane is seen."""
    if is_planar(robot):
        return np.array([0.0, 0.0, 1.0])
    up = up_of(robot)
    ahead = np.eye(3)[int(np.argmin(np.abs(up)))]
    ahead = ahead - (ahead @ up) * up
    direction = ahead / np.linalg.norm(ahead) - 1.25 * np.cross(up, ahead) + 0.55 * up
    return np.asarray(direction / np.linalg.norm(direction))


def up_of(robot: Robot) -> Array:
    """Against gravity; z without gravity."""
    gravity = robot.tree.gravity
    strength = float(np.linalg.norm(gravity))
    return np.array([0.0, 0.0, 1.0]) if strength < _FLAT else -gravity / strength


def _not_shared(verbose: bool = True) -> None:
    """In place of viser's tunnel to a server of others, which any page in the browser could ask for."""


def _refused(host: str, port: int, error: OSError) -> ViewError:
    if error.errno == errno.EADDRINUSE:
        return _taken(host, port)
    if error.errno == errno.EACCES:
        return ViewError(f"port is {port}, which this user may not open; expected one from 1024 on")
    return ViewError(f"host is {host[:80]!r}, expected an address of this machine, such as {LOCAL}")


def _taken(host: str, port: int) -> ViewError:
    return ViewError(f"port {port} of {host} is taken, expected a free one; 0 finds one")
