"""Long jobs one after another on this machine, or side by side on machines of a dask.distributed cluster."""

from __future__ import annotations

import contextlib
import re
import time
import uuid
from collections.abc import Callable, Sequence

from .errors import CancelledError, InputError

LOCAL = "local"
_ADDRESS = re.compile(r"dask://(?P<host>\[[0-9a-fA-F:]+\]|[^/:\s]+):(?P<port>\d{1,5})/?")
CONNECT_S = 15  # that a scheduler is given to answer
STOP_S = 60.0  # that workers are given to end what they do
ASK_EVERY_S = 2.0  # how often a worker asks whether it should stop, and how it goes on is asked
NO_WORKER = "the scheduler has no worker: start `dask worker`"

ProgressFunction = Callable[[float, str], None]
# job, progress, stopped -> None; importable by name, since another machine runs it
Work = Callable[[object, ProgressFunction, Callable[[], bool]], None]


def check_executor(executor: str) -> None:
    """Raise InputError for anything but 'local' and 'dask://HOST:PORT', or where dask is missing."""
    if executor == LOCAL:
        return
    if not _ADDRESS.fullmatch(executor):
        raise InputError(f"--executor: '{executor}' is not known; give local or dask://HOST:PORT of a dask scheduler.")
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise InputError(
            "--executor: dask.distributed is not installed; run: pip install 'expected-appearances[cluster]'"
        ) from None


def connect(executor: str):
    """distributed.Client of 'dask://HOST:PORT'; close it. Raises InputError where no scheduler answers."""
    from distributed import Client, TimeoutError

    address = "tcp://" + executor.removeprefix("dask://").rstrip("/")
    try:
        return Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise InputError(
            f"--executor: no dask scheduler answers at {address} ({error}); start one with `dask scheduler`, "
            "or leave --executor out."
        ) from error


def run_jobs(jobs: Sequence, work: Work, executor: str, progress: ProgressFunction) -> None:
    """Do `work` for every job. Workers of a cluster must see the same folders and have this library installed.

    Raises what a job raises; the jobs that are under way are stopped first.
    """
    if executor == LOCAL:
        for i, job in enumerate(jobs):

            def report(fraction: float, text: str, i: int = i) -> None:
                progress((i + fraction) / len(jobs), f"{i + 1} of {len(jobs)}: {text}")

            work(job, report, lambda: False)
            progress((i + 1) / len(jobs), f"{i + 1} of {len(jobs)} done")
        return
    if not jobs:
        return
    from distributed import Event, TimeoutError, wait

    with connect(executor) as client, client.as_current():
        stop = f"expected-appearances-{uuid.uuid4()}"
        event = Event(stop, client=client)
        futures = [client.submit(_on_worker, work, job, stop, pure=False, retries=0) for job in jobs]
        try:
            waiting, told = list(futures), None
            while waiting:
                with contextlib.suppress(TimeoutError):
                    wait(waiting, timeout=ASK_EVERY_S, return_when="FIRST_COMPLETED")
                ended = next((i for i, future in enumerate(waiting) if future.done()), None)
                if ended is not None:
                    waiting.pop(ended).result()
                done = len(jobs) - len(waiting)
                text = f"{done} of {len(jobs)} done at {executor}"
                text = text if not waiting or client.nthreads() else NO_WORKER
                if text != told:
                    told = text
                    progress(done / len(jobs), text)
        except BaseException:
            event.set()
            with contextlib.suppress(TimeoutError):
                wait(futures, timeout=STOP_S)
            raise


def _on_worker(work: Work, job, stop: str) -> None:
    """Runs on a worker of the cluster."""
    from distributed import Event

    event, asked_s, answer = Event(stop), -ASK_EVERY_S, False

    def stopped() -> bool:
        nonlocal asked_s, answer
        if time.monotonic() - asked_s >= ASK_EVERY_S:
            asked_s, answer = time.monotonic(), event.is_set()
        return answer

    if stopped():
        raise CancelledError("stopped before it began")
    work(job, lambda _fraction, _text: None, stopped)
