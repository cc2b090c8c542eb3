"""Planning in xi beside planners of others; what is not installed here is skipped."""

import pytest


@pytest.mark.slow
def test_plans_in_xi_keep_the_tool_in_place() -> None:
    pytest.importorskip("ompl")
    import planning

    rows = planning.main(quick=True)
    assert [row.split("|")[1].strip() for row in rows] == list(planning.SPACES)
    assert float(rows[0].split("|")[6]) < 1e-9


@pytest.mark.slow
def test_regions_of_xi_are_free() -> None:
    pytest.importorskip("pydrake")
    import convex_regions

    (row,) = convex_regions.main(quick=True)
    assert float(row.split("|")[4].split()[0]) > 98
