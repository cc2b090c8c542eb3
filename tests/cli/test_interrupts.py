"""A real Ctrl-C, at any moment, in any fit: Interrupted with the best point, or KeyboardInterrupt; nothing else."""

import os
import signal
import threading
import time
from contextlib import suppress

import numpy as np
import pytest
from programs import nightly

import orthocas as oc
from orthocas import solvers
from orthocas.errors import Interrupted
from orthocas.solvers.protocol import Status
from orthocas.tools import interrupts
from orthocas.tools.progress import Progress

FITS = {
    "network, lbfgs": (oc.MLP((32, 32)), solvers.LBFGS(max_iterations=100_000, tolerance=0.0), {}),
    "network, adam": (oc.MLP((32, 32)), solvers.Adam(epochs=1000, steps=5), {}),
    "network, ipopt": (oc.MLP((16, 16)), solvers.Ipopt(max_iterations=100_000, tolerance=1e-300), {}),
    "network, flow": (oc.MLP((8, 8)), solvers.GradientFlow(max_iterations=1000, tolerance=0.0), {}),
    "basis, flow": (oc.Polynomial(2), solvers.GradientFlow(max_iterations=1000, tolerance=0.0, accuracy=1e-9), {}),
    "basis, bounded": (oc.Polynomial(2), solvers.Ipopt(tolerance=1e-300), {"max_mutual_deg": 0.5}),
}


def press_after(seconds: float) -> threading.Timer:
    timer = threading.Timer(seconds, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    return timer


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.15, *nightly(0.31, 0.57)])
@pytest.mark.parametrize("name", FITS)
def test_ctrl_c_at_any_moment(planar_x: oc.Problem, name: str, seconds: float) -> None:
    parametrisation, solver, settings = FITS[name]
    timer, found = press_after(seconds), None
    start = time.monotonic()
    try:
        oc.fit(planar_x, parametrisation, solver, **settings)
        done = time.monotonic() - start
        timer.join()
        assert done < seconds
    except Interrupted as stop:
        found = stop.result
    except KeyboardInterrupt:
        pass  # before there was a point, or after the fit
    finally:
        timer.cancel()
    assert time.monotonic() - start < seconds + 10
    if found is not None:
        xi = found.chart.xi(planar_x.domain.centre + 0.1)
        assert np.isfinite(xi).all()
        if found.status is not Status.INTERRUPTED:  # it had ended in that moment
            whole = oc.fit(planar_x, parametrisation, solver, **settings)
            np.testing.assert_array_equal(xi, whole.chart.xi(planar_x.domain.centre + 0.1))


def test_ctrl_c_that_a_library_swallows_ends_a_fit_all_the_same(planar_x: oc.Problem) -> None:
    """CasADi's Python has places with `except: pass`; here the monitor is one."""
    shares = []

    def swallow(progress: Progress) -> None:
        shares.append(progress.fraction)
        if len(shares) == 3:
            with suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)

    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(Interrupted) as stopped:
        oc.fit(planar_x, oc.MLP((8, 8)), solvers.LBFGS(max_iterations=1000, tolerance=0.0), monitor=swallow)
    assert stopped.value.result.status is Status.INTERRUPTED
    assert len(shares) < 10
    assert signal.getsignal(signal.SIGINT) is before


def test_deferred_interrupt_comes_at_the_end_and_the_handler_is_put_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    done = []

    def block() -> None:
        with interrupts.deferred():
            signal.raise_signal(signal.SIGINT)
            done.append("the block goes on")
            with pytest.raises(KeyboardInterrupt):
                interrupts.check()

    with pytest.raises(KeyboardInterrupt):
        block()
    assert done == ["the block goes on"]
    assert signal.getsignal(signal.SIGINT) is before
    interrupts.check()


def test_interrupt_counts_more_than_what_compiled_code_made_of_it() -> None:
    def block() -> None:
        with interrupts.deferred():
            signal.raise_signal(signal.SIGINT)
            raise RuntimeError("KeyboardInterrupt")

    with pytest.raises(KeyboardInterrupt):
        block()


def test_other_threads_are_left_alone() -> None:
    before, seen = signal.getsignal(signal.SIGINT), []

    def work() -> None:
        with interrupts.deferred():
            seen.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [before]
