"""The limits of the campaign of faults: each kind of misbehaviour is a finding, and the next mutants are judged."""

import re
import signal
import sys
import time

import numpy as np
import pytest

if sys.platform != "linux":
    pytest.skip("reads /proc", allow_module_level=True)

from fuzz.child import run, verdict

from orthocas.errors import OrthocasError


def _hide_a_failed_allocation() -> None:
    try:
        np.ones(2**29)
    except MemoryError:
        raise OrthocasError("damaged") from None


def _waste_memory(seed: int) -> str | None:
    if seed == 1:
        return verdict(_hide_a_failed_allocation)
    np.ones((2**27 + 2**24, 1, 2**26)[seed])  # 1.1 and 0.5 GiB, returned at once
    return None


def _waste_time(seed: int) -> str | None:
    if seed == 0:
        while True:
            pass
    elif seed == 1:
        signal.setitimer(signal.ITIMER_PROF, 0)  # as if the exception got lost
        end = time.process_time() + 0.5
        while time.process_time() < end:
            pass
    elif seed == 2:
        sum(range(10**13))  # compiled code that looks at no signals
    else:
        time.sleep(1)  # waiting costs nothing
    return None


@pytest.mark.slow
def test_too_much_memory_is_a_finding_though_it_is_returned_or_refused() -> None:
    found = {finding.seed: finding.what for finding in run("limits", _waste_memory, range(3))}
    assert found == {0: "takes 1.1 GiB", 1: "takes more than 2 GiB: damaged"}


@pytest.mark.slow
def test_too_much_time_is_a_finding() -> None:
    """Of a loop in Python, and of a function that returns late; compiled code takes whole seconds (nightly)."""
    found = {finding.seed: finding.what for finding in run("limits", _waste_time, range(2), seconds=0.2)}
    assert set(found) == {0, 1}
    assert re.fullmatch(r"takes more than 0.2 s|takes \d\.\d s", found[0])
    assert re.fullmatch(r"takes \d\.\d s", found[1])


@pytest.mark.nightly
def test_too_much_time_is_a_finding_and_compiled_code_ends_too() -> None:
    found = {finding.seed: finding.what for finding in run("limits", _waste_time, range(4), seconds=0.3)}
    assert set(found) == {0, 1, 2}
    assert re.fullmatch(r"takes more than 0.3 s|takes \d\.\d s", found[0])
    assert re.fullmatch(r"takes \d\.\d s", found[1])
    by_the_kernel = f"its process died with exit code {-signal.SIGXCPU}"
    assert found[2] in (
        by_the_kernel,
        "hangs where Python cannot interrupt it",
    )  # a busy machine counts whole seconds late
