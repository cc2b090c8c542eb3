"""Work on many machines: the executor of a Dask scheduler (optional extra)."""

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from importlib import import_module

from orthocas.errors import SchedulerError


@contextmanager
def scheduler_executor(address: str) -> Iterator[Executor]:
    """An executor that runs on the workers of a Dask scheduler.

    Raises:
        SchedulerError: if Dask is not installed, or the scheduler does not answer.
    """
    try:
        distributed = import_module("distributed")
    except ImportError:
        raise SchedulerError("a scheduler needs Dask, expected the extra: pip install 'orthocas[dask]'") from None
    try:
        client = distributed.Client(address, timeout="10s")
    except (OSError, ValueError, TimeoutError) as error:
        raise SchedulerError(f"the scheduler {address} does not answer: {error}") from None
    with client:
        executor: Executor = client.get_executor()
        yield executor
