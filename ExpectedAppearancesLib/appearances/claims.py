"""Who works on what, said by files, so that any machine that shares the folder can take what nobody works on."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import time
from pathlib import Path

import psutil

from ..errors import ExpectedAppearancesError
from ..files import writing

STALE_S = 120.0  # a holder that has not been heard of for so long is taken for dead
HEARTBEAT_S = 5.0


class ClaimLost(ExpectedAppearancesError):
    """Another process has taken the work over, or the run was cancelled: what is being made is not to be kept."""


class Claim:
    """The right to work on one thing: FOLDER/NAME.GENERATION.json, made with O_EXCL.

    What a dead holder left is taken over by making the next generation, which also only one process can; nothing is
    ever moved or overwritten, so two can never hold the same.
    """

    def __init__(self, path: Path, generation: int):
        self._stem = path
        self._generation = generation
        self._beaten_s = time.monotonic()

    def keep(self) -> None:
        """Say that the holder lives; to be called often. Raises ClaimLost."""
        if _file(self._stem, self._generation + 1).exists():
            raise ClaimLost(f"{self._stem.name}: taken over by another process")
        if time.monotonic() - self._beaten_s > HEARTBEAT_S:
            self.check()
            self._beaten_s = time.monotonic()

    def check(self) -> None:
        """`keep`, at once."""
        try:
            os.utime(_file(self._stem, self._generation))
        except FileNotFoundError:
            raise ClaimLost(f"{self._stem.name}: the run was cancelled") from None
        if _file(self._stem, self._generation + 1).exists():
            raise ClaimLost(f"{self._stem.name}: taken over by another process")

    def release(self) -> None:
        """Oldest first: while one generation is left, the next to come is not a first one."""
        for generation in range(self._generation + 1):
            with contextlib.suppress(OSError):
                _file(self._stem, generation).unlink()


class Claims:
    """Takes claims in `folder`, remembering how long the others' have been silent (clocks of machines differ)."""

    def __init__(self, folder: Path):
        self.folder = Path(folder)
        self._seen: dict[Path, tuple[int, float]] = {}

    def take(self, name: str) -> Claim | None:
        """The claim on `name`, or None while a living process holds it."""
        stem = self.folder / name
        newest = _newest(stem)
        if newest is not None and not self._is_dead(_file(stem, newest)):
            return None
        generation = 0 if newest is None else newest + 1
        path = _file(stem, generation)
        with writing(path):
            self.folder.mkdir(parents=True, exist_ok=True)
            try:
                descriptor = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY)
            except FileExistsError:
                return None
            with os.fdopen(descriptor, "w", encoding="utf-8") as stream:
                json.dump(_own_identity() | {"folder": str(self.folder.absolute())}, stream)
        return Claim(stem, generation)

    def withdraw(self, name: str) -> None:
        """Take the claim away from whoever holds it: its holder stops at its next `keep`."""
        for path in self.folder.glob(f"{_escaped(name)}.*.json"):
            with contextlib.suppress(OSError):
                path.unlink()

    def _is_dead(self, path: Path) -> bool:
        try:
            holder, beaten = json.loads(path.read_text(encoding="utf-8") or "{}"), path.stat().st_mtime_ns
        except FileNotFoundError:
            return False  # released this moment; the next try will see
        except ValueError:
            holder, beaten = {}, path.stat().st_mtime_ns
        own = _own_identity()
        if holder.get("machine") == own["machine"]:
            return not _runs(holder) or self._is_of_the_original(holder)
        seen, since_s = self._seen.get(path, (None, 0.0))
        if seen != beaten:
            self._seen[path] = beaten, time.monotonic()
            return False
        return time.monotonic() - since_s > STALE_S

    def _is_of_the_original(self, holder: dict) -> bool:
        """Whether this folder is a copy of the one that the holder works in, made meanwhile; not where that was moved
        to here."""
        try:
            return not os.path.samefile(holder.get("folder", self.folder), self.folder)
        except OSError:
            return False


def _file(stem: Path, generation: int) -> Path:
    return stem.with_name(f"{stem.name}.{generation}.json")


def _newest(stem: Path) -> int | None:
    found = [int(p.name.split(".")[-2]) for p in stem.parent.glob(f"{_escaped(stem.name)}.*.json")]
    return max(found, default=None)


def _escaped(name: str) -> str:
    return "".join(f"[{c}]" if c in "[*?" else c for c in name)


def _own_identity() -> dict:
    process = psutil.Process()
    machine = f"{platform.node()} {int(psutil.boot_time())}"
    return {"machine": machine, "pid": process.pid, "started": process.create_time()}


def _runs(holder: dict) -> bool:
    """A process number may have been given to another process meanwhile; its start then differs."""
    try:
        process = psutil.Process(holder["pid"])
        return abs(process.create_time() - holder["started"]) < 1 and process.status() != psutil.STATUS_ZOMBIE
    except (psutil.Error, KeyError):
        return False
