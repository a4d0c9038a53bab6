"""A process with all that it starts: begun apart from this one, recognised again, and ended as a whole."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from pathlib import Path

MARK_VARIABLE = "EXPECTED_APPEARANCES_RUN"
SAME_TIME_S = 2.0  # a clock that was set right meanwhile shifts the time at which a process seems to have begun

# Children of this process by their mark, so that whoever looks for one gets its real exit code and none stays a zombie.
_children: dict[str, subprocess.Popen] = {}


def start(command: list[str], environment: dict[str, str], output: Path) -> ProcessTree:
    """Start `command` in a session of its own; what it prints goes to the file `output`. Raises OSError."""
    import psutil

    if os.name == "nt":
        apart = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW}
    else:
        apart = {"start_new_session": True}
    with open(output, "ab") as stream:
        child = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=stream, stderr=subprocess.STDOUT, env=environment, **apart
        )
    mark = environment[MARK_VARIABLE]
    _children[mark] = child
    try:
        created_s = psutil.Process(child.pid).create_time()
    except psutil.Error:  # ended already
        created_s = 0.0
    return ProcessTree(child.pid, created_s, mark)


class ProcessTree:
    """A process and its descendants. All of them carry `mark` in their environment, orphans too."""

    def __init__(self, pid: int, created_s: float, mark: str):
        self.pid, self.created_s, self.mark = pid, created_s, mark

    def running(self) -> bool:
        """Whether the first process is still there."""
        import psutil

        child = _children.get(self.mark)
        if child is not None:
            return child.poll() is None
        try:
            process = psutil.Process(self.pid)
            return process.status() != psutil.STATUS_ZOMBIE and self._is_first(process)
        except psutil.Error:
            return False

    def exit_code(self) -> int | None:
        """Of the first process, where it was started by this one and has ended."""
        child = _children.get(self.mark)
        return None if child is None else child.poll()

    def members(self) -> list:
        """All processes of the tree that are still there. Looks at every process of the computer: some 10 ms."""
        import psutil

        found = {}
        for process in psutil.process_iter():
            # Those of other users cannot be read, and are not ours.
            with contextlib.suppress(psutil.Error, OSError):
                if process.create_time() < self.created_s - SAME_TIME_S or process.pid == os.getpid():
                    continue
                if process.status() != psutil.STATUS_ZOMBIE and process.environ().get(MARK_VARIABLE) == self.mark:
                    found[process.pid] = process
        with contextlib.suppress(psutil.Error):
            first = psutil.Process(self.pid)
            if self.running():
                found |= {process.pid: process for process in [first, *first.children(recursive=True)]}
        return list(found.values())

    def ask_to_end(self) -> None:
        """SIGTERM to the first process, which ends the others itself. Windows knows no such request: there the run
        reads in its own record that it is cancelled."""
        if not self.running():
            self.kill()
        elif os.name != "nt":
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGTERM)

    def kill(self) -> None:
        import psutil

        for process in self.members():
            with contextlib.suppress(psutil.Error):
                process.kill()

    def _is_first(self, process) -> bool:
        import psutil

        try:
            return process.environ().get(MARK_VARIABLE) == self.mark
        except psutil.NoSuchProcess:
            return False
        except (psutil.Error, OSError):  # a hardened process hides its environment
            return abs(process.create_time() - self.created_s) < SAME_TIME_S
