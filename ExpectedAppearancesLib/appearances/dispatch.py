"""Who makes the shards: this process, or the workers of a dask.distributed cluster."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

from ..errors import ExpectedAppearancesError
from ..executor import LOCAL, NO_WORKER, check_executor, connect
from .claims import ClaimLost
from .shards import Recipe, Shard, work_on

POLL_S = 1.0

OnProgress = Callable[[float, str], None]  # images done (with fractions), what is made


def run_shards(shards: list[Shard], recipe: Recipe, executor: str, on_progress: OnProgress) -> None:
    """Make every shard, whoever else may be at it. What on_progress raises ends the run; what is finished is kept."""
    check_executor(executor)
    if executor == LOCAL:
        _run_here(shards, recipe, on_progress)
    else:
        _run_on_dask(shards, recipe, executor, on_progress)


def _run_here(shards: list[Shard], recipe: Recipe, on_progress: OnProgress) -> None:
    waiting, done = list(shards), 0
    while waiting:
        held = []
        for shard in waiting:
            missing = len(shard.items) - len(shard.finished())
            before = done + len(shard.items) - missing
            name = f"texture {shard.texture.name}"
            on_progress(before, name)
            try:
                made = work_on(shard, recipe, lambda n, name=name, before=before: on_progress(before + n, name))
            except ClaimLost:
                made = None
            if made is None:
                held.append(shard)
            else:
                done += len(shard.items)
        if held:
            on_progress(done, f"texture {held[0].texture.name}")
            time.sleep(POLL_S)
        waiting = held


def _run_on_dask(shards: list[Shard], recipe: Recipe, executor: str, on_progress: OnProgress) -> None:
    from distributed import TimeoutError, wait

    client = connect(executor)
    waiting, running, done = list(shards), {}, 0
    try:
        while waiting or running:
            # No more than the workers can take soon: a shard carries its texture.
            room = max(0, 2 * max(1, len(client.nthreads())) - len(running))
            for shard in waiting[:room]:
                running[client.submit(work_on, shard, recipe, pure=False, retries=0)] = shard
            del waiting[:room]
            with client.as_current(), contextlib.suppress(TimeoutError):
                wait(list(running), timeout=POLL_S, return_when="FIRST_COMPLETED")
            held = []
            for future in [future for future in running if future.done()]:
                shard = running.pop(future)
                if _outcome(future, shard) is None:
                    held.append(shard)  # by another process, or lost to one
                else:
                    done += len(shard.items)
            at_work = f"{len(running)} shards on the cluster"
            on_progress(done, at_work if client.nthreads() else NO_WORKER)
            if held and not running:
                time.sleep(POLL_S)
            waiting += held
    except BaseException:
        for shard in running.values():
            shard.claims().withdraw(shard.name)
        client.cancel(list(running))
        raise
    finally:
        client.close()


def _outcome(future, shard: Shard) -> int | None:
    from distributed import CancelledError, KilledWorker

    try:
        return future.result()
    except (ClaimLost, CancelledError):
        return None
    except KilledWorker as error:
        raise ExpectedAppearancesError(
            f"{shard.name}: every worker that took it was killed, for want of memory as a rule; "
            "start workers with more memory, or give a smaller --batch."
        ) from error
