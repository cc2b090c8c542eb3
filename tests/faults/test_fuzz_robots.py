"""A quick part of the campaign of robot files; `make fuzz` runs the rest."""

import pytest
from fuzz.robots import robots


@pytest.mark.slow
def test_robot_files_give_robots_or_one_error() -> None:
    assert robots(60) == []
