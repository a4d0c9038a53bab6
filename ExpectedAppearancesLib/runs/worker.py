"""A process that answers questions one after another, so that who asks, a panel, never waits for the answer.

`python -m ExpectedAppearancesLib.runs.worker TASK`: each line that comes in is a question, a JSON object, each line
that goes out its answer: {"answer": ...} or {"problem": text in the user's words}. It ends when its input ends.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import BinaryIO

from ..errors import InputError
from ..interpreter import python_for_runs
from .environment import WITHOUT_WINDOW, environment_of

# Module and function whose result answers the questions of a task, a function of one dict; loaded in the process alone.
TASKS = {
    "label maps": ("ExpectedAppearancesLib.masks.asked", "answering"),
    "surfaces": ("ExpectedAppearancesLib.mrml.segment_surface", "answering"),
}


class Worker:
    """Works on one question at a time; a newer one replaces one that has not been begun. No call waits for an answer.

    urgent: a newer question also ends the work on an older one.
    """

    def __init__(self, task: str, urgent: bool = False):
        self._task, self._urgent = task, urgent
        self._process: subprocess.Popen | None = None
        self._folder: tempfile.TemporaryDirectory | None = None
        # The process writes into a file: a thread that reads a pipe would stand still in 3D Slicer, whose main thread
        # keeps Python's lock while it waits for events.
        self._answers: BinaryIO | None = None
        self._line = b""
        self._begun: dict | None = None
        self._next: dict | None = None

    @property
    def waiting(self) -> bool:
        """Whether an answer is still to come."""
        return self._begun is not None or self._next is not None

    def ask(self, question: dict) -> None:
        if self._urgent and self._begun is not None:
            self.stop()
        self._next = question
        self._send()

    def poll(self) -> tuple[dict, dict] | None:
        """(question, its answer) where one has come in: {"answer"}, {"problem"}, or {"failed"}: the process ended."""
        if self._begun is None:
            return None
        ended = self._process is None or self._process.poll() is not None  # asked before the last line is read
        self._line += self._answers.readline() if self._process else b""
        if self._line.endswith(b"\n"):
            answer, self._line = json.loads(self._line), b""
        elif ended:
            kept = self._begun, self._next
            self.stop()
            self._begun, self._next = kept
            answer = {"failed": f"The process for {self._task} has ended."}
        else:
            return None
        question, self._begun = self._begun, None
        self._send()
        return question, answer

    def forget(self) -> None:
        """No answer is wanted any more. The process stays for the next question, unless it is at work."""
        self._next = None
        if self._begun is not None:
            self.stop()

    def stop(self) -> None:
        """End the process; the next question starts another."""
        self._begun = self._next = None
        process, self._process = self._process, None
        if process is None:
            return
        process.kill()
        with contextlib.suppress(OSError):
            process.stdin.close()
        process.wait()
        self._answers.close()
        self._line = b""
        self._folder.cleanup()

    def _send(self) -> None:
        if self._begun is not None or self._next is None:
            return
        question = self._next
        if self._process is not None and self._process.poll() is not None:
            self.stop()
        self._begun, self._next = question, None
        with contextlib.suppress(OSError):  # it could not be started or has ended: `poll` tells
            if self._process is None:
                self._start()
            self._process.stdin.write((json.dumps(question) + "\n").encode("utf-8"))
            self._process.stdin.flush()

    def _start(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="expected-appearances-")
        path = Path(self._folder.name) / "answers.txt"
        with open(path, "wb") as stream:
            self._process = subprocess.Popen(
                [python_for_runs(), "-m", __name__, self._task],
                stdin=subprocess.PIPE,
                stdout=stream,
                stderr=subprocess.DEVNULL,
                env=environment_of("helper"),
                **WITHOUT_WINDOW,
            )
        self._answers = open(path, "rb")  # noqa: SIM115 (closed in stop)


def main(argv: list[str]) -> int:
    # What libraries print must not be taken for answers.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    module, function = TASKS[argv[0]]
    answer = getattr(importlib.import_module(module), function)()
    for line in sys.stdin:
        try:
            reply = {"answer": answer(json.loads(line))}
        except (InputError, OSError) as error:
            reply = {"problem": str(error)}
        answers.write(json.dumps(reply) + "\n")
        answers.flush()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
