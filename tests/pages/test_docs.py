"""Every block of the README runs, as written."""

import re
import shlex
import shutil
from pathlib import Path

import pytest
from pages import README, ROOT, blocks
from programs import Run, needs_c, needs_cmake, output_of, printed_here, python


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A folder with the files the README names."""
    for folder in ("problems", "examples"):
        shutil.copytree(ROOT / folder, tmp_path / folder)
    return tmp_path


@pytest.mark.slow
def test_python_quickstart_runs(tmp_path: Path) -> None:
    """In an empty folder."""
    printed = python(blocks("python")[0], tmp_path)
    assert printed.startswith("XiRange: of xi1, xi2, xi3, xi4")
    assert float(re.findall(r"\]\]? (\S+)$", printed, re.MULTILINE)[0]) < 1e-9  # the hand stays
    assert "Report: n = 7 joints, m = 3 task, r = 4 extra" in printed
    assert (tmp_path / "arm.orthocas").exists()
    assert (tmp_path / "arm.png").exists()


@pytest.mark.nightly
def test_newcomers_path_from_a_urdf_to_c_runs(run: Run) -> None:
    """Every command of the README after the one that installs, in an empty folder; ten are enough."""
    install, commands, _ = (block.splitlines() for block in blocks("sh"))
    assert install[0].startswith("pip install 'orthocas[")
    assert len(commands) <= 8
    for line in commands:
        program, *words = shlex.split(line)
        if program == "echo":
            output_of("bash", "-c", line)
            continue
        assert program == "orthocas"
        code, _, err = run(*words)
        assert (code, err) == (0, ""), line
    assert Path("c/arm.c").exists()


@pytest.mark.slow
def test_python_block_of_the_page_on_control_runs(tmp_path: Path) -> None:
    code, _ = blocks("python", "how-to/simulate.md")
    first, coupling = printed_here(code, tmp_path).splitlines()
    assert first.endswith("] 0")  # no status but OK
    assert float(coupling) < 0.005
    assert (tmp_path / "run.npz").exists()


@pytest.mark.slow
def test_python_blocks_of_the_page_on_domains_run(tmp_path: Path) -> None:
    parts = blocks("python", "how-to/domains.md")
    printed = printed_here("\n".join(parts), tmp_path).splitlines()
    assert printed[0].startswith("DomainSuggestion: half-width 3.142")
    assert printed[-3] == "('q1',) True"
    assert 0.81 < float(printed[-2]) < 0.84  # the share of the box that is clear
    assert printed[-1] == "True True"  # along a path


@pytest.mark.slow
def test_python_blocks_of_the_page_on_batches_run(run: Run, tmp_path: Path) -> None:
    code = "\n".join(blocks("python", "how-to/export.md"))
    printed = python(code, tmp_path).splitlines()
    assert printed == ["(100000, 3) (100000, 3, 3)", "True ('x', 'y', 'xi1')", "True", "True True", "True True"]
    (line,) = blocks("sh", "how-to/export.md")
    assert run(*shlex.split(line)[1:])[0] == 0
    assert "import torch" in (tmp_path / "arm_torch.py").read_text()


@pytest.mark.slow
def test_python_blocks_of_the_page_on_the_inverse_run(tmp_path: Path) -> None:
    parts = blocks("python", "how-to/inverse.md")
    printed = printed_here("\n".join(parts), tmp_path).splitlines()
    assert printed[0].startswith("Solutions: ")
    assert printed[0].endswith(" OUT_OF_REACH")
    assert printed[3:7] == ["True", "True True", "True", "LOST True"]
    over_xi, over_q = printed[7].split()
    assert over_xi == over_q


@pytest.mark.slow
def test_python_blocks_of_the_page_on_arms_run(tmp_path: Path) -> None:
    printed = printed_here("\n".join(blocks("python", "how-to/arm.md")), tmp_path)
    assert "arcs of length" in printed
    assert "100 FOUND" in printed
    assert "its limit" in printed


@pytest.mark.slow
def test_python_block_of_the_page_on_circles_runs(tmp_path: Path) -> None:
    (code,) = blocks("python", "explanation/circle.md")
    assert printed_here(code, tmp_path).splitlines() == ["[6.28] True", "True"]


@pytest.mark.slow
def test_python_blocks_of_the_page_on_paths_run(tmp_path: Path) -> None:
    parts = blocks("python", "how-to/paths.md")
    printed = printed_here("\n".join(parts), tmp_path)
    assert printed.startswith("Interval: xi1 in [")
    assert "SelfMotionCurve: curve of length" in printed
    assert "'link of q3' and 'post'" in printed
    assert "closed path" in printed
    assert (tmp_path / "q.csv").read_text().startswith("time_s,q1,q2,q3,d_q1")


@pytest.mark.slow
@needs_c
@needs_cmake
@pytest.mark.usefixtures("checkout", "unoptimised", "blank_pictures")
def test_ten_minutes_to_a_controller_in_c_run(run: Run) -> None:
    """Every command of docs/how-to/c_code.md, in order."""
    lines = [line for block in blocks("sh", "how-to/c_code.md") for line in block.splitlines()]
    assert len(lines) == 7
    for line in lines:
        program, *words = shlex.split(line)
        if program == "orthocas":
            code, printed, err = run(*words)
            assert code == 0, f"{line}: {err}"
        else:
            printed = output_of(program, *words)
    assert "statuses: 2000 ok, 0 saturated, 0 near the boundary, 0 others" in printed
    assert float(printed.split()[-1]) < 1e-4  # the task stays while the arm moves


def test_make_targets_of_the_readme_exist() -> None:
    makefile = (ROOT / "Makefile").read_text()
    for line in blocks("sh")[2].splitlines():
        assert re.search(rf"^{line.split()[1]}:", makefile, flags=re.MULTILINE)


def test_links_point_to_files() -> None:
    links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", README)
    assert links
    for link in links:
        assert link.startswith("http") or (ROOT / link).exists(), link
