"""A quick part of the campaign of calls; `make fuzz` runs the rest."""

import pytest
from fuzz.calls import calls


@pytest.mark.slow
def test_calls_give_results_or_one_error() -> None:
    assert calls(150) == []
