"""A quick part of the campaigns of calls and ticks; `make fuzz` runs the rest."""

import pytest
from fuzz.calls import calls
from fuzz.ticks import ticks
from programs import needs_c


@pytest.mark.slow
def test_calls_give_results_or_one_error() -> None:
    assert calls(150) == []


@needs_c
@pytest.mark.slow
def test_hostile_ticks_in_c_are_no_findings() -> None:
    assert ticks(4000) == []
