"""Kills and Ctrl-C of the command line at random times: a part of the campaign `make fuzz CAMPAIGN=signals`."""

import pytest

pytest.importorskip("resource")

from fuzz import signals


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fit", "compare"])
def test_stopped_commands_leave_nothing_broken(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals, "KILLS", 3)
    what = signals.judge(list(signals.COMMANDS).index(name))
    assert what is None, what
