"""What notebooks show: pictures inline, and progress that draws below the cell."""

import io
import sys
from importlib.util import find_spec
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from public_objects import comparison, fitted, joint_motion, trajectory

import orthocas as oc
from orthocas.tools.progress import NotebookBars, Progress, TerminalBars, as_bars, in_notebook, silent

EVIL = "<img src=x>"


@pytest.mark.slow
@pytest.mark.parametrize(
    "build",
    [lambda: oc.evaluate(fitted().chart, 200), fitted, trajectory, joint_motion, comparison, lambda: fitted().chart],
)
def test_plots_show_themselves_inline(build: Any) -> None:
    figure = build().plot()
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert figure.axes


def test_chart_plots_reach_as_far_as_the_coordinates() -> None:
    chart = fitted().chart
    figure = chart.plot()
    assert len(figure.axes) == chart.r
    for panel, reach in zip(figure.axes, chart.xi_range(chart.problem.domain.centre), strict=True):
        assert f"from {reach.low:.3g} to {reach.high:.3g}" in panel.get_title()
        tips = np.array([line.get_data_3d() for line in panel.lines])[:, 0, -1]
        np.testing.assert_allclose(tips, tips[0], atol=1e-8)  # the task is x of the tip


def test_motion_plots_hold_their_curves() -> None:
    motion = joint_motion()
    positions, tasks, speeds, coordinates = motion.plot().axes
    np.testing.assert_array_equal(np.array([line.get_ydata() for line in positions.lines]).T, motion.q)
    np.testing.assert_array_equal(np.array([line.get_ydata() for line in speeds.lines]).T, motion.dq)
    np.testing.assert_array_equal(tasks.lines[0].get_ydata(), motion.x[:, 0])
    assert [text.get_text() for text in coordinates.get_legend().get_texts()] == ["xi1", "xi2"]


class Shell:
    """A shell named as that of Colab."""


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What a notebook shows in the place of the last display."""
    pages: list[str] = []
    ipython, display = ModuleType("IPython"), ModuleType("IPython.display")
    ipython.get_ipython = Shell  # type: ignore[attr-defined]
    display.HTML = str  # type: ignore[attr-defined]

    def first(page: str, display_id: bool) -> Any:
        assert display_id
        pages.append(page)
        return SimpleNamespace(update=lambda page: pages.__setitem__(-1, page))

    display.display = first  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    return pages


def test_progress_of_a_fit_is_drawn_in_one_place(shown: list[str]) -> None:
    assert in_notebook()
    monitor = oc.progress()
    assert isinstance(monitor, NotebookBars)
    oc.fit(fitted().chart.problem, oc.Polynomial(2), samples=200, monitor=monitor)
    assert len(shown) == 1
    assert "<progress value='1.000'" in shown[0]
    assert "polynomial:2" in shown[0]


def test_bars_escape_names_and_fill_earlier_stages() -> None:
    page = as_bars({EVIL: Progress(EVIL, 0.3, EVIL), "b": Progress("b", 0.25, "x")})
    assert "<img" not in page
    assert page.count("value='1.000'") == 1
    assert "value='0.250'" in page


def test_terminals_get_bars_and_files_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not in_notebook()
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    assert oc.progress() is silent
    stream.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setenv("TERM", "xterm")
    bars = oc.progress()
    assert isinstance(bars, TerminalBars)
    for stage, fraction, detail in (("a", 0.5, "[x]"), ("a", 1.0, "done"), ("b", 0.0, ""), ("c", 0.0, "")):
        bars(Progress(stage, fraction, detail))
    before = stream.getvalue()
    assert before.count("\n") >= 2  # after the end of a, and where c takes over from b
    assert "done" in before
    assert before.endswith("\x1b[?25l") or before.count("\x1b[?25l") == before.count("\x1b[?25h") + 1
    del bars
    after = stream.getvalue()
    assert after.count("\x1b[?25l") == after.count("\x1b[?25h") == 3  # the cursor comes back


@pytest.mark.slow
@pytest.mark.skipif(find_spec("nbclient") is None or find_spec("ipykernel") is None, reason="no nbclient and ipykernel")
def test_a_notebook_runs_and_holds_pictures() -> None:
    import nbclient  # type: ignore[import-not-found]
    import nbformat  # type: ignore[import-not-found]

    cells = [
        "import orthocas as oc\nproblem = oc.problems.get('planar_3r_xy')",
        "fit = oc.fit(problem, oc.Polynomial(2), samples=200, monitor=oc.progress())\nfit.chart",
        "fit.chart.plot()",
    ]
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in cells])
    nbclient.NotebookClient(book, timeout=120, kernel_name="python3").execute()
    drawn, described = book.cells[1].outputs
    assert "<progress" in drawn.data["text/html"]
    assert "polynomial:2" in described.data["text/html"]
    assert "image/png" in book.cells[2].outputs[0].data
