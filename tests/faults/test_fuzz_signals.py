"""Kills and Ctrl-C of the command line at random times: a part of the campaign `make fuzz CAMPAIGN=signals`."""

import pytest

pytest.importorskip("resource")

from fuzz import signals


@pytest.mark.slow
def test_a_stopped_command_leaves_nothing_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "KILLS", 1)
    what = signals.judge(list(signals.COMMANDS).index("fit"))
    assert what is None, what
