"""A process that answers questions one after another, so that who asks, a panel, never waits for the answer.

`python -m ExpectedAppearancesLib.runs.worker TASK`: each line that comes in is a question, a JSON object, each line
that goes out its answer: {"answer": ...} or {"problem": text in the user's words}. It ends when its input ends.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import logging
import os
import queue
import subprocess
import sys
import threading

from ..errors import InputError
from .environment import environment_of, python_for_runs

# Module and function whose result answers the questions of a task, a function of one dict; loaded in the process alone.
TASKS = {
    "label maps": ("ExpectedAppearancesLib.masks.asked", "answering"),
    "surfaces": ("ExpectedAppearancesLib.mrml.segment_surface", "answering"),
}
_ENDED = object()


class Worker:
    """Works on one question at a time; a newer one replaces one that has not been begun. No call waits for an answer.

    urgent: a newer question also ends the work on an older one.
    """

    def __init__(self, task: str, urgent: bool = False):
        self._task, self._urgent = task, urgent
        self._process: subprocess.Popen | None = None
        self._lines: queue.SimpleQueue = queue.SimpleQueue()
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
        try:
            line = self._lines.get_nowait()
        except queue.Empty:
            return None
        question, self._begun = self._begun, None
        if line is _ENDED:
            self._process = None
            answer = {"failed": f"The process for {self._task} has ended."}
        else:
            answer = json.loads(line)
        self._send()
        return None if question is None else (question, answer)

    def forget(self) -> None:
        """No answer is wanted any more. The process stays for the next question, unless it is at work."""
        self._next = None
        if self._begun is not None:
            self.stop()

    def stop(self) -> None:
        """End the process; the next question starts another."""
        self._begun = self._next = None
        self._lines = queue.SimpleQueue()  # what the reader of the old process still has to say is not heard
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            with contextlib.suppress(OSError):
                process.stdin.close()
            process.wait()

    def _send(self) -> None:
        if self._begun is not None or self._next is None:
            return
        self._begun, self._next = self._next, None
        if self._process is None or self._process.poll() is not None:
            self._start()
        try:
            self._process.stdin.write((json.dumps(self._begun) + "\n").encode("utf-8"))
            self._process.stdin.flush()
        except OSError:
            logging.warning("Expected Appearances: the process for %s takes no questions", self._task)  # it has ended

    def _start(self) -> None:
        quiet = {"creationflags": subprocess.CREATE_NO_WINDOW} if os.name == "nt" else {}
        self._lines = queue.SimpleQueue()
        self._process = subprocess.Popen(
            [python_for_runs(), "-m", __name__, self._task],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=environment_of("helper"),
            **quiet,
        )
        threading.Thread(target=_read, args=(self._process.stdout, self._lines), daemon=True).start()


def _read(stream, lines: queue.SimpleQueue) -> None:
    with stream:
        for line in stream:
            lines.put(line)
    lines.put(_ENDED)


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
