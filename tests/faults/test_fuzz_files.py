"""A quick part of the campaigns of files: dozens of mutants a kind. `make fuzz` runs as many as you like."""

import pytest
from fuzz.certificates import certificates
from fuzz.charts import charts
from fuzz.libraries import libraries
from fuzz.motions import motions
from fuzz.paths import logs, paths, postures
from fuzz.runs import runs
from fuzz.steps import steps
from programs import needs_c


@pytest.mark.slow
def test_no_number_of_a_certified_chart_can_be_changed() -> None:
    assert certificates(50) == []


@pytest.mark.slow
def test_mutated_charts_are_usable_or_refused_in_one_line() -> None:
    assert charts(40) == []


@needs_c
@pytest.mark.slow
def test_mutated_libraries_are_not_loaded() -> None:
    assert libraries(100) == []


@pytest.mark.slow
def test_mutated_motions_are_usable_or_refused_in_one_line() -> None:
    assert motions(50) == []


@pytest.mark.slow
def test_mutated_paths_are_usable_or_refused_in_one_line() -> None:
    assert paths(40) == []


@pytest.mark.slow
def test_mutated_postures_are_usable_or_refused_in_one_line() -> None:
    assert postures(50) == []


@pytest.mark.slow
def test_mutated_joint_logs_are_usable_or_refused_in_one_line() -> None:
    assert logs(50) == []


@pytest.mark.slow
def test_mutated_runs_are_usable_or_refused_in_one_line() -> None:
    assert runs(50) == []


@pytest.mark.slow
def test_mutated_steps_files_are_references_or_refused_in_one_line() -> None:
    assert steps(50) == []
