"""Figures of the paper: their numbers, the files, the scene they are drawn in, and the command."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import test_reproduce_control
import test_reproduce_motion
import test_reproduce_plane
import test_reproduce_sketches
import test_reproduce_space
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from paper import FIGURES, Drawing, Recipe, Scene, registry, reproduce, save, solids
from paper.fig06 import embedded, torus_faces
from paper.fig08 import encircles, postures
from paper.leaves import glued, leaf, wall
from paper.painting import Isolines, paint
from paper.registry import chosen
from paper.self_motion import pieces_in_cube, trace, wrapped
from paper.style import add_3d, joint_cube, new_figure, pi_text
from programs import Run

from orthocas import problems
from orthocas.errors import InvalidValueError, SolveError, UnknownNameError
from orthocas.tools.files import LIST
from orthocas.tools.progress import Progress

Numbers = dict[str, float]


def fig06(n: Numbers) -> None:
    """Sec. 2.2: nine singular configurations in the plane, four on the torus; the label -1.789 of Fig. 6a."""
    assert n["singular_points_in_plane"] == 9
    assert n["singular_points_on_torus"] == 4
    assert n["sum_of_indices_on_torus"] == 0  # Euler characteristic of the torus, by Morse theory
    assert n["distance_from_multiples_of_pi"] < 1e-12
    assert n["gradient_at_singular_points"] < 1e-12
    assert round(n["second_level"], 3) == -1.789
    assert n["line_error"] < 2e-3  # chords of 80 cells; 320 cells give 1e-4


def fig07(n: Numbers) -> None:
    """Leaves of |x| < 1 have genus 3 in the torus, the others are spheres; the model can be printed."""
    assert n["task_error_at_vertices"] < 1e-12
    assert n["components_in_torus"] == n["closed_in_torus"] == 1
    assert n["euler_characteristic_in_torus"] == -4
    assert n["genus_in_torus"] == 3
    for value, chi in ((-2.5, 2), (-1.7, 2), (-0.6, -4), (0.6, -4), (1.7, 2), (2.5, 2)):
        assert n[f"euler_characteristic_at_{value:g}"] == chi
    assert n["model_watertight"] == n["model_pieces"] == 1
    assert n["model_euler_characteristic"] == 2 * n["euler_characteristic_in_cube"]  # two sides, glued along circles
    assert n["model_mean_wall_mm"] == pytest.approx(3.0, rel=0.03)
    assert n["model_edge_mm"] == pytest.approx(100.0)


def fig08(n: Numbers) -> None:
    """Sec. 2.2: curves around the line q2 = q3 = 0, here of tips beyond 1 m, and others."""
    assert n["curves"] == 24
    assert n["around_the_line"] == 4 * 3
    assert n["not_around_the_line"] == 2 * 2 * 3
    assert n["nearest_tip_of_those_around"] > 1 > n["farthest_tip_of_the_others"]
    assert (n["turns_of_q1_of_those_around"], n["turns_of_q1_of_the_others"]) == (0, 1)
    assert max(n["task_error"], n["closure_error"]) < 1e-11


def fig11(n: Numbers) -> None:
    """Sec. 3.3: four rows, one plane, at right angles to the curve."""
    assert n["rank_of_all_four_rows"] == 2
    assert n["third_singular_value"] < 1e-14
    assert n["distance_of_polar_rows_from_plane"] < 1e-14
    assert n["sine_of_angle_between_curve_and_normal"] < 1e-3  # of a chord of 0.1 rad


CHECKS: dict[str, Callable[[Numbers], None]] = {"fig06": fig06, "fig07": fig07, "fig08": fig08, "fig11": fig11}


def test_every_figure_has_a_check() -> None:
    elsewhere = (
        *(test_reproduce_control, test_reproduce_motion, test_reproduce_plane),
        *(test_reproduce_sketches, test_reproduce_space),
    )
    assert {*CHECKS, *(name for module in elsewhere for name in module.NAMES)} == set(FIGURES)


@pytest.mark.slow
@pytest.mark.parametrize("name", CHECKS)
def test_numbers_of_figure(name: str) -> None:
    drawing = FIGURES[name].draw(True)
    CHECKS[name](dict(drawing.numbers))
    assert drawing.figures
    assert all(figure.axes for figure in drawing.figures.values())


@pytest.fixture
def two_figures() -> Iterator[list[tuple[str, bool]]]:
    """Two recipes in place of all; which ones were drawn, and whether quickly."""
    drawn: list[tuple[str, bool]] = []

    def recipe(name: str) -> Recipe:
        def draw(quick: bool) -> Drawing:
            drawn.append((name, quick))
            return Drawing({"": Figure(figsize=(0.2, 0.2))}, {"name": float(name[3:])})

        return Recipe(f"title of {name}", draw)

    recipes = {name: recipe(name) for name in ("fig06", "fig11")}
    with patch.dict(registry.FIGURES, recipes, clear=True):  # unlike monkeypatch, it restores the order too
        yield drawn


def test_save_writes_pictures_meshes_and_numbers(tmp_path: Path) -> None:
    figures = {suffix: Figure(figsize=(0.2, 0.1)) for suffix in ("", "b")}
    figures["b"].add_subplot(projection="3d")
    files = save(Drawing(figures, {"one": 1.0}, {"leaf": trimesh.creation.box()}), "fig07", tmp_path)
    pictures = ["fig07.png", "fig07.pdf", "fig07b.png", "fig07b.pdf"]
    assert [file.name for file in files] == [*pictures, "fig07_leaf.stl", "fig07.json"]
    assert {path.name for path in tmp_path.iterdir()} == {LIST, *(file.name for file in files)}
    assert json.loads((tmp_path / "fig07.json").read_text()) == {"one": 1.0}
    assert trimesh.load_mesh(tmp_path / "fig07_leaf.stl").is_watertight


def test_saving_twice_writes_the_same_bytes(tmp_path: Path) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        save(Drawing({"": Figure(figsize=(0.2, 0.1))}, {}), "fig07", tmp_path / folder)
    for file in ("fig07.png", "fig07.pdf"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()
    assert (tmp_path / "one" / "fig07.pdf").read_bytes().startswith(b"%PDF")


def test_what_cannot_be_saved_leaves_what_was_there(tmp_path: Path) -> None:
    old = tmp_path / "fig07.png"
    old.write_text("old")
    with pytest.raises(ValueError, match="not JSON compliant"):
        save(Drawing({"": Figure()}, {"one": float("nan")}), "fig07", tmp_path)

    class Broken(Figure):
        def savefig(self, fname: Path, **options: object) -> None:
            Path(fname).write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        save(Drawing({"": Broken()}, {}), "fig07", tmp_path)
    assert old.read_text() == "old"
    assert list(tmp_path.iterdir()) == [old]


def test_all_is_every_recipe_in_order(two_figures: list[tuple[str, bool]], tmp_path: Path) -> None:
    seen: list[Progress] = []
    numbers = reproduce("all", tmp_path / "new" / "folder", True, seen.append)
    assert two_figures == [("fig06", True), ("fig11", True)]
    assert numbers == {"fig06": {"name": 6.0}, "fig11": {"name": 11.0}}
    assert {path.stem for path in (tmp_path / "new" / "folder").glob("fig*")} == {"fig06", "fig11"}
    assert [progress.fraction for progress in seen] == [0.0, 0.5, 1.0]
    assert "title of fig11" in seen[1].detail


def test_ctrl_c_leaves_finished_figures(two_figures: list[tuple[str, bool]], tmp_path: Path) -> None:
    def stop(progress: Progress) -> None:
        if progress.fraction > 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reproduce("all", tmp_path, True, stop)
    assert {path.name for path in tmp_path.glob("*.*")} == {LIST, "fig06.png", "fig06.pdf", "fig06.json"}


@pytest.mark.parametrize("word", ["fig7", "7", "07", "fig07"])
def test_figures_have_short_names(word: str) -> None:
    assert chosen(word) == ["fig07"]


@pytest.mark.parametrize("word", ["fig99", "figure7", "", "-7", "7b", "99999"])
def test_unknown_figures_are_listed(word: str) -> None:
    with pytest.raises(UnknownNameError, match=r"known: .*fig01 to fig30"):
        chosen(word)


def test_a_fit_is_chosen_for_figures_of_a_fit_only(run_paper: Run, tmp_path: Path) -> None:
    code, out, err = run_paper("fig05", "--param", "mlp:4x4", "--out", "new")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "fit is chosen for fig05, expected a figure of a fit: fig10, fig17" in err
    code, _, err = run_paper("fig20", "--log", "joints.csv", "--out", "new")
    assert (code, "--log is given for fig20, expected fig28" in err) == (2, True)
    assert not list(tmp_path.iterdir())


def test_unwritable_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InvalidValueError, match="a folder that can be written"):
        reproduce("fig06", tmp_path / "file", True)


def test_command_prints_rows_or_json(run_paper: Run, two_figures: list[tuple[str, bool]], tmp_path: Path) -> None:
    code, out, err = run_paper("all", "--out", "new")
    assert (code, err) == (0, "")
    assert out.splitlines() == [
        "fig06: title of fig06",
        "  name  6",
        "fig11: title of fig11",
        "  name  11",
        "files  new",
    ]
    code, out, err = run_paper("6", "--out", "new", "--quick", "--json")
    assert (code, json.loads(out), err) == (0, {"fig06": {"name": 6.0}}, "")
    assert two_figures == [("fig06", False), ("fig11", False), ("fig06", True)]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("fig99", "--out", "new"), "unknown figure 'fig99', known: fig06 to fig11, all"),
        (("fig06", "--out", "file"), "--out is file, expected a folder that can be written"),
        (("fig06", "--out", "file/deeper"), "--out is file/deeper, expected a folder"),
        (("fig06",), "Missing option '--out'"),
    ],
)
def test_command_refuses_before_any_work(
    run_paper: Run, two_figures: list[tuple[str, bool]], tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    (tmp_path / "file").write_text("in the way")
    code, out, err = run_paper(*words)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert message in err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert two_figures == []


def test_tube_is_closed_and_has_its_radius() -> None:
    angle = np.linspace(0, 3, 60)
    path = np.stack([np.cos(angle), np.sin(angle), 0.3 * angle], axis=1)
    mesh = trimesh.Trimesh(*solids.tube(path, 0.1, 40), process=False)
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert mesh.is_volume
    assert mesh.volume == pytest.approx(np.pi * 0.1**2 * length, rel=0.01)
    around = np.asarray(mesh.vertices)[:-2].reshape(60, 40, 3) - path[:, None]
    assert np.linalg.norm(around, axis=2) == pytest.approx(0.1, abs=1e-12)


def test_arrow_reaches_from_start_to_end() -> None:
    vertices, faces = solids.arrow((1, 0, 0), (0, 0, 2), 0.05)
    assert (vertices[:, 2].min(), vertices[:, 2].max()) == pytest.approx((0, 2))
    assert np.hypot(vertices[:, 0] - 1, vertices[:, 1]).max() == pytest.approx(2.7 * 0.05)
    assert trimesh.Trimesh(vertices, faces, process=False).volume > 0


@pytest.mark.parametrize("order", [1, -1])
def test_scene_sorts_everything_by_depth(order: int) -> None:
    """A ball behind a wall is hidden, one before it is seen, in whatever order they are added."""
    wall_ = [[0.0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]], [[0, 1, 2], [0, 2, 3]], "#00ff00"
    behind, before = (*solids.ball((-0.5, 0, 0), 0.3), "#ff0000"), (*solids.ball((0.5, 0, 0), 0.1), "#0000ff")
    scene = Scene()
    for thing in (wall_, behind, before)[::order]:
        scene.add_surface(*thing)
    red, green, blue = (_seen(scene)[..., k] for k in range(3))
    assert (blue > red).any()
    assert (green > red).any()
    assert not ((red > green) & (red > blue)).any()


def test_shading_darkens_faces_that_turn_away() -> None:
    scene = Scene()
    scene.add_ball((0, 0, 0), 1.0, "#808080")
    middle = _seen(scene)[20:40, 20:40, 0]
    assert middle.max() == pytest.approx(128, abs=3)  # where it faces the light
    assert middle.min() < 105


def _seen(scene: Scene) -> np.ndarray:
    """Pixels of a scene looked at along -x, RGB."""
    figure = Figure(figsize=(1, 1), dpi=60)
    axes = figure.add_axes((0, 0, 1, 1), projection="3d")
    scene.draw(axes, (0, 0), -1, 1)
    axes.set_axis_off()
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].astype(int)


def test_joint_cube_keeps_equal_scales_and_marks_multiples_of_pi() -> None:
    axes = add_3d(new_figure(2.0, layout=None), 0, 0, 1, 1)
    joint_cube(axes, 0.0, 2 * np.pi)
    scene = Scene()
    scene.add_cube(0.0, 2 * np.pi, 0.02, "#123456")
    scene.draw(axes, (20, 30), 0.0, 2 * np.pi)
    assert [label.get_text() for label in axes.get_zticklabels()] == ["$0$", r"$\pi$", r"$2\pi$"]
    assert axes.get_xlim() == axes.get_ylim() == axes.get_zlim() == pytest.approx((0, 2 * np.pi))
    assert scene.corners.min() == pytest.approx(-0.02, abs=1e-9)
    assert pi_text(-np.pi / 2) == r"$-\pi/2$"
    assert pi_text(3 * np.pi / 4) == r"$3\pi/4$"


def test_painted_line_has_its_width_and_cuts_keep_the_area() -> None:
    """The line z = 0.25 of width 0.2 on a tilted unit square is a strip of area 0.2."""
    corners = np.array([[[0.0, 0, 0], [0.6, 0, 0.8], [0, 1, 0]], [[0.6, 0, 0.8], [0.6, 1, 0.8], [0, 1, 0]]])
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    lines = Isolines(np.array([0.0, 0.8, 0.0, 0.8]), np.array([0.4]), np.array([[1.0, 0, 0, 1]]), 0.2)
    pieces, colours, source = paint(corners, faces, lines, np.ones((2, 4)))
    areas = np.linalg.norm(np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]), axis=1) / 2
    assert areas.sum() == pytest.approx(1.0)
    assert areas[colours[:, 1] == 0].sum() == pytest.approx(0.2)
    assert set(source) == {0, 1}


def test_surface_takes_a_colour_per_face() -> None:
    scene = Scene()
    colours = np.array([to_rgb("#ff0000"), to_rgb("#0000ff")])
    scene.add_surface([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2], [1, 3, 2]], colours, alpha=0.5)
    assert scene.corners.shape == (2, 3, 3)
    assert scene.colours.tolist() == [[1, 0, 0, 0.5], [0, 0, 1, 0.5]]


def test_torus_is_closed() -> None:
    angle = np.stack(np.meshgrid(*2 * [np.arange(12) * np.pi / 6], indexing="ij"), axis=-1).reshape(-1, 2)
    mesh = trimesh.Trimesh(embedded(angle), torus_faces(12, 12), process=False)
    assert mesh.is_watertight
    assert mesh.euler_number == 0


@pytest.mark.parametrize("radius", [0.5, 2.0])
def test_self_motion_curves_agree_with_the_closed_form(radius: float) -> None:
    """|tip|^2 = 3 + 2 cos q2 + 2 cos q3 + 2 cos(q2 + q3), whatever q1; beyond 1 m around q2 = q3 = 0."""
    task = problems.get("planar_3r_xy").task
    starts = postures(radius, 0.3)
    assert len(starts) == (2 if radius < 1 else 1)
    want = radius * np.array([np.cos(0.3), np.sin(0.3)])
    assert task.batched(starts)[0] == pytest.approx(np.tile(want, (len(starts), 1)))
    for curve in trace(task, starts, 0.1):
        q2, q3 = curve[:, 1], curve[:, 2]
        squared = 3 + 2 * np.cos(q2) + 2 * np.cos(q3) + 2 * np.cos(q2 + q3)
        assert squared == pytest.approx(radius**2, abs=1e-12)
        assert wrapped(curve[-1] - curve[0]) == pytest.approx(np.zeros(3), abs=1e-12)
        assert encircles(curve) is (radius > 1)
        steps = np.linalg.norm(np.diff(curve, axis=0), axis=1)
        assert steps[:-1] == pytest.approx(0.1, rel=0.01)
        assert steps[-1] <= 0.1 * 1.01


def test_curve_that_does_not_close_is_an_error() -> None:
    with pytest.raises(SolveError, match="do not close in 5 steps"):
        trace(problems.get("planar_3r_xy").task, postures(2.0, 0.0), most=5)


@pytest.mark.parametrize(
    ("end", "count"),
    [
        ((7.0, 3.5, -3.4), 4),  # through three faces
        ((7.0, 3.5, -3.5), 3),  # through an edge and a face: the second and third angle cross at once
        ((np.pi, 3.0, -3.0), 1),  # to a face and no farther
    ],
)
def test_pieces_stay_in_the_cube_and_keep_the_length(end: tuple[float, ...], count: int) -> None:
    curve = np.linspace((0.0, 3.0, -3.0), end, 40)
    pieces = pieces_in_cube(curve)
    assert len(pieces) == count
    assert max(np.abs(piece).max() for piece in pieces) <= np.pi + 1e-12
    steps = [np.linalg.norm(np.diff(piece, axis=0), axis=1) for piece in pieces]
    assert min(step.min() for step in steps) > 0
    assert sum(step.sum() for step in steps) == pytest.approx(np.linalg.norm(curve[-1] - curve[0]))


def test_leaf_is_closed_in_the_torus_only() -> None:
    task = problems.get("planar_3r_x").task
    mesh = leaf(task, 2.0, 23)
    assert not mesh.is_watertight
    closed = glued(mesh)
    assert closed.is_watertight
    assert (closed.euler_number, closed.body_count) == (2, 1)


def test_wall_is_a_solid_of_its_thickness() -> None:
    task = problems.get("planar_3r_x").task
    solid = wall(task, 2.0, 31, 50.0, 4.0)
    assert solid.is_volume
    area = leaf(task, 2.0, 31).area * (50 / (2 * np.pi)) ** 2
    assert solid.volume == pytest.approx(4.0 * area, rel=0.1)
    assert solid.bounds == pytest.approx(np.array([[0.0] * 3, [50.0] * 3]), abs=1e-9)
