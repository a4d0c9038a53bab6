"""A command as a command-line module of 3D Slicer: its progress protocol, and the values that Slicer's panel passes.

`python -m ExpectedAppearancesLib.cli.command_line_module COMMAND CASE ...` does the same without Slicer's scripts.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import logging
import os
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.sax.saxutils import escape

from .. import cli
from ..appearances import METHODS
from ..appearances.store import newest_image
from ..errors import EXIT_BAD_INPUT, EXIT_CANCELLED, EXIT_DONE, EXIT_FAILED, CancelledError, InputError
from ..runs.environment import MODULES
from ..runs.output import EXIT_PREFIX, FIGURES_PREFIX
from ..runs.processes import MARK_VARIABLE
from .progress import Progress, duration

# A run of hours reports less and less often, so that its log stays small.
LONGEST_INTERVAL_S = 5.0
_TRAINING = re.compile(
    r"step (?P<step>\d+), loss (?P<loss>-?[\d.]+)(?:, validation ADD (?P<validation_add_mm>[\d.]+))?"
)


def parser_of(command: str) -> argparse.ArgumentParser:
    """The parser of one command, with the options and defaults of `python -m ExpectedAppearancesLib COMMAND`."""
    parser = argparse.ArgumentParser()
    importlib.import_module(cli.COMMANDS[command][0], cli.__name__).add_arguments(parser)
    return parser


def command_arguments(command: str, arguments: Sequence[str]) -> list[str]:
    """The arguments as the command wants them, from those that Slicer's panel passes.

    Slicer passes every number and choice, whether one was given or not: 0, 'auto' and the folder '.' stand for "left
    out" where the command's default is to be left out. A list arrives as one text with commas.
    """
    if command not in MODULES:
        return list(arguments)  # no module of Slicer, so never called by its panel: 0 means 0
    options = {flag: action for action in parser_of(command)._actions for flag in action.option_strings}
    positional, rest = [], []
    i = 0
    while i < len(arguments):
        flag, _, value = arguments[i].partition("=")
        # Names in Slicer's descriptions have no hyphens.
        flag = flag if flag in options or not flag.startswith("--") else "--" + flag[2:].replace("_", "-")
        action = options.get(flag)
        i += 1
        if action is None:
            positional.append(arguments[i - 1])
            continue
        if action.nargs == 0:
            rest.append(flag)
            continue
        values = [value] if "=" in arguments[i - 1] else []
        most = 0 if values else len(arguments) if action.nargs in ("+", "*") else 1
        while i < len(arguments) and len(values) < most and not arguments[i].startswith("--"):
            values.append(arguments[i])
            i += 1
        if action.nargs in ("+", "*"):
            # slicer.cli.run makes "'a', 'b'" of the list ["a", "b"].
            values = [part.strip(" '\"") for text in values for part in text.split(",")]
        values = [value for value in values if not _left_out(action, value)]
        rest += [flag, *values] if values else []
    # First what has no name: a list option before it would swallow it.
    return positional + rest


def _left_out(action: argparse.Action, value: str) -> bool:
    if value == "":
        return True
    if action.default is not None or (action.choices and value in action.choices):
        return False
    if action.type in (int, float):
        with contextlib.suppress(ValueError):
            return float(value) == 0
    return value in (("auto",) if action.choices else (".", "./"))


class SlicerProgress(Progress):
    """Prints Slicer's progress tags, and a line of figures for whoever plots them."""

    def __init__(self, command: str, case_folder: Path | None, stream=None):
        super().__init__(stream or sys.stdout)
        self._command, self._case_folder = command, case_folder
        self._stamps: dict[Path, int] = {}

    def start(self) -> None:
        self._say(
            f"<filter-start><filter-name>{self._command}</filter-name>"
            f"<filter-comment>{escape(str(self._case_folder or ''))}</filter-comment></filter-start>"
        )
        self._say(FIGURES_PREFIX + json.dumps({"pid": os.getpid()}))

    def end(self, code: int) -> None:
        if self._command == "synthesize" and (newest := self._newest_image()):
            self._say(FIGURES_PREFIX + json.dumps(newest))
        self._say(f"<filter-end><filter-name>{self._command}</filter-name></filter-end>")
        self._say(f"{EXIT_PREFIX}{code}")

    def _interval_s(self, elapsed_s: float) -> float:
        return min(max(super()._interval_s(elapsed_s), elapsed_s / 500), LONGEST_INTERVAL_S)

    def _show(self, fraction: float, message: str, seconds_left: float | None) -> None:
        left = "" if seconds_left is None else f" ({duration(seconds_left)} left)"
        self._say(f"<filter-progress>{fraction:.4f}</filter-progress>")
        self._say(f"<filter-comment>{escape(message + left)}</filter-comment>")
        figures = {"seconds_left": None if seconds_left is None else round(seconds_left, 1)} | self._figures(message)
        self._say(FIGURES_PREFIX + json.dumps(figures))

    def _figures(self, message: str) -> dict:
        if self._command == "train":
            found = _TRAINING.search(message)
            values = {key: value for key, value in (found.groupdict() if found else {}).items() if value is not None}
            return {key: int(value) if key == "step" else float(value) for key, value in values.items()}
        return self._newest_image() if self._command == "synthesize" else {}

    def _newest_image(self) -> dict:
        """Path of the newest finished appearance, and how many there are; {} where nothing is new."""
        folders = [self._case_folder / "appearances" / method for method in METHODS] if self._case_folder else []
        stamps = {folder: folder.stat().st_mtime_ns for folder in folders if folder.is_dir()}
        if not stamps or stamps == self._stamps:
            return {}
        self._stamps = stamps
        newest, images = newest_image(max(stamps, key=stamps.get))
        return {"images": images, "image": str(newest)} if newest else {}

    def _say(self, text: str) -> None:
        # Under a Slicer that has been closed nobody reads any more; the run goes on.
        with contextlib.suppress(OSError):
            print(text, file=self._stream, flush=True)


def main(command: str, arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code: 0 done, 2 bad input, 3 cancelled, 1 anything else."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    for stream in (sys.stdout, sys.stderr):
        # Slicer and the runner read UTF-8; a path in another alphabet must not end the run.
        with contextlib.suppress(AttributeError):
            stream.reconfigure(encoding="utf-8", errors="backslashreplace")
    give_way()
    progress = SlicerProgress(command, None)
    code = EXIT_FAILED
    try:
        with cli.termination_cancels(), _tracebacks_shown():
            code = _run(command, command_arguments(command, arguments), progress)
    except CancelledError as error:  # while it was still loading
        print(f"Cancelled. {error}", file=sys.stderr, flush=True)
        code = EXIT_CANCELLED
    progress.end(code)
    return code


def _run(command: str, arguments: list[str], progress: SlicerProgress) -> int:
    from ..runs.record import obey_record
    from ..runs.results import result_problem

    case_folder = Path(arguments[0]).absolute() if arguments and not arguments[0].startswith("-") else None
    if case_folder is None or not (case_folder / "case.json").is_file():
        return cli.main([command, *arguments])  # explains itself, or says what is wrong with the case
    progress._case_folder = case_folder
    progress.start()
    if os.name == "nt" and os.environ.get(MARK_VARIABLE):
        obey_record(case_folder, command, os.environ[MARK_VARIABLE])
    code = cli.main([command, *arguments], progress)
    problem = result_problem(command, case_folder, thorough=True) if code == EXIT_DONE else ""
    if problem:
        print(f"Failed: {problem}", file=sys.stderr, flush=True)
        return EXIT_FAILED
    return code


def give_way() -> None:
    """Below Slicer in priority, whatever it has: its panel must answer while all processors work for the run.

    At equal priority 20 ms of work took another process 50 beside four busy threads, with this 22. On Linux Slicer
    gives itself nice 19, and its children: beneath that there is SCHED_IDLE.
    """
    with contextlib.suppress(OSError, ImportError):
        if os.name == "nt":
            import psutil

            psutil.Process().nice(psutil.BELOW_NORMAL_PRIORITY_CLASS)
        elif (niceness := os.nice(0)) < 10:
            os.nice(10 - niceness)
        elif niceness >= 19 and hasattr(os, "sched_setscheduler"):
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


@contextlib.contextmanager
def _tracebacks_shown() -> Iterator[None]:
    """Unexpected errors are printed with their traceback: Slicer shows it, and the runner's log keeps it."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setLevel(logging.ERROR)
    handler.addFilter(lambda record: bool(record.exc_info) and not isinstance(record.exc_info[1], InputError))
    logging.getLogger().addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger().removeHandler(handler)


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in cli.COMMANDS:
        print(f"COMMAND must be one of {', '.join(cli.COMMANDS)}.", file=sys.stderr)
        sys.exit(EXIT_BAD_INPUT)
    sys.exit(main(sys.argv[1], sys.argv[2:]))
