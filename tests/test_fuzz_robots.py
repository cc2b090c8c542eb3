"""A quick part of the campaign of robot files; `make fuzz` runs the rest."""

from fuzz.robots import robots


def test_robot_files_give_robots_or_one_error() -> None:
    assert robots(120) == []
