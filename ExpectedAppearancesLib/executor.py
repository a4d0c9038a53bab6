"""Long jobs one after another on this machine, or side by side on machines of a dask.distributed cluster."""

from __future__ import annotations

import contextlib
import time
import uuid
from collections.abc import Callable, Sequence

from .errors import CancelledError, InputError

LOCAL = "local"
SCHEME = "dask://"
CONNECT_S = 15.0
STOP_S = 60.0  # that workers are given to end what they do
ASK_EVERY_S = 2.0  # how often a worker asks whether it should stop

ProgressFunction = Callable[[float, str], None]
# job, progress, stopped -> None; importable by name, since another machine runs it
Work = Callable[[object, ProgressFunction, Callable[[], bool]], None]


def check_executor(executor: str) -> None:
    """Raise InputError unless it is 'local', or 'dask://HOST:PORT' with a scheduler that answers."""
    if executor == LOCAL:
        return
    host, _, port = executor.removeprefix(SCHEME).rpartition(":")
    if not executor.startswith(SCHEME) or not host or not port.isdecimal():
        raise InputError(f"--executor: '{executor}' is not known; give local, or dask://HOST:PORT of a dask scheduler.")
    _connect(executor).close()


def run_jobs(jobs: Sequence, work: Work, executor: str, progress: ProgressFunction) -> None:
    """Do `work` for every job. Workers of a cluster must see the same folders and have this library installed.

    Raises what a job raises; the jobs that are under way are stopped first.
    """
    if executor == LOCAL:
        for i, job in enumerate(jobs):
            work(job, lambda fraction, text, i=i: progress((i + fraction) / len(jobs), text), lambda: False)
            progress((i + 1) / len(jobs), f"{i + 1} of {len(jobs)} done")
        return
    if not jobs:
        return
    from dask.distributed import Event, as_completed, wait

    with _connect(executor) as client:
        stop = f"expected-appearances-{uuid.uuid4()}"
        event = Event(stop, client=client)
        futures = [client.submit(_on_worker, work, job, stop, pure=False, retries=0) for job in jobs]
        try:
            for done, future in enumerate(as_completed(futures), 1):
                future.result()
                progress(done / len(jobs), f"{done} of {len(jobs)} done at {executor}")
        except BaseException:
            event.set()
            with contextlib.suppress(TimeoutError):
                wait(futures, timeout=STOP_S)
            raise


def _on_worker(work: Work, job, stop: str) -> None:
    """Runs on a worker of the cluster."""
    from dask.distributed import Event

    event, asked_s, answer = Event(stop), -ASK_EVERY_S, False

    def stopped() -> bool:
        nonlocal asked_s, answer
        if time.monotonic() - asked_s >= ASK_EVERY_S:
            asked_s, answer = time.monotonic(), event.is_set()
        return answer

    if stopped():
        raise CancelledError("stopped before it began")
    work(job, lambda _fraction, _text: None, stopped)


def _connect(executor: str):
    try:
        from dask.distributed import Client
    except ImportError as error:
        raise InputError(
            "--executor: dask.distributed is not installed; run: pip install 'expected-appearances[cluster]'"
        ) from error
    try:
        return Client(f"tcp://{executor.removeprefix(SCHEME)}", timeout=CONNECT_S)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(
            f"--executor: no dask scheduler answers at {executor}; start one (`dask scheduler`), or give local."
        ) from error
