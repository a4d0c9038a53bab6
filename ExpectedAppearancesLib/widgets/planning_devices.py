"""Asks the driver which graphics cards there are, without waiting for the answer."""

from __future__ import annotations

import shutil
from collections.abc import Callable

from ..gpus import PROGRAM, QUERY, Gpu, parse_gpus
from .planning_qt import Child


def find_gpus(on_found: Callable[[list[Gpu]], None]) -> Child | None:
    """`on_found` is called once, from the event loop. None, and no call, where there is no driver."""
    program = shutil.which(PROGRAM)
    if program is None:
        return None
    return Child([program, *QUERY], lambda code, output: on_found(parse_gpus(output) if code == 0 else []))
