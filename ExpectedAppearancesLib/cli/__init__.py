"""The headless program: one command per stage, exit codes that scripts and 3D Slicer can rely on."""

from __future__ import annotations

import argparse
import contextlib
import errno
import importlib
import io
import logging
import signal
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from .. import __version__
from ..errors import (
    EXIT_BAD_INPUT,
    EXIT_CANCELLED,
    EXIT_DONE,
    EXIT_FAILED,
    CancelledError,
    ExpectedAppearancesError,
    InputError,
)

if TYPE_CHECKING:
    from .progress import Progress

# name -> (module with add_arguments and run, help). Imported only when the command is chosen: torch and VTK take
# seconds.
COMMANDS = {
    "demo": (".demo", "run the whole pipeline on a small generated case"),
    "new": (".new", "make a case folder from a vessel mesh, a cortex mesh and a camera"),
    "render": (".render", "sample camera poses and render their label maps"),
    "synthesize": (".synthesize", "synthesise expected appearances from label maps and textures"),
    "train": (".train", "train the pose network on the expected appearances"),
    "register": (".register", "find the pose of microscope frames"),
    "evaluate": (".evaluate", "measure predicted poses against known ones"),
    "study": (".study", "leave-one-texture-out, number of textures, rivals and robustness, in one report"),
    "check": (".check", "report versions, devices, memory, rendering and weights, for a support request"),
}
# Errors of the system that mean: choose another folder or make room.
UNWRITABLE = {errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS}


def main(argv: Sequence[str] | None = None, progress: Progress | None = None) -> int:
    """Run one command; returns the exit code: 0 done, 2 bad input, 3 cancelled, 1 anything else.

    progress: how progress is reported; lines on stderr if None.
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    for stream in (sys.stdout, sys.stderr):
        # A terminal that cannot show a character of a path must not end the run.
        with contextlib.suppress(AttributeError):
            stream.reconfigure(errors="backslashreplace")
    try:
        args = _build_parser(argv).parse_args(argv)
    except SystemExit as exit_request:  # argparse has printed its text
        return exit_request.code if isinstance(exit_request.code, int) else EXIT_BAD_INPUT
    except ImportError as error:
        _say(_missing_package(error))
        return EXIT_FAILED

    from .logs import log_file
    from .progress import Progress, tell

    said = io.StringIO()
    progress = progress or Progress()
    # `new` must leave a case that it refuses to replace as it was.
    cases = getattr(args, "cases", None) or [getattr(args, "case", None)]
    case_folder = None if args.command == "new" else cases[0]
    with log_file(args.command, case_folder) as log_path:
        try:
            with termination_cancels(), contextlib.redirect_stdout(said):
                code = args.run(args, progress)
            progress.finish()
            code = EXIT_DONE if code is None else int(code)
        except (CancelledError, KeyboardInterrupt) as error:
            logging.info("cancelled", exc_info=True)
            _say(f"Cancelled. {error}".strip())
            code = EXIT_CANCELLED
        except InputError as error:
            logging.exception("bad input")
            say_problems(args.command, error.problems)
            code = EXIT_BAD_INPUT
        except OSError as error:
            logging.exception("system error")
            code = _report_system_error(args.command, error, log_path)
        except Exception as error:
            logging.exception("failed")
            _report_failure(error, log_path)
            code = getattr(error, "exit_code", EXIT_FAILED)
        logging.info("exit code %d", code)
    tell(said.getvalue(), sys.stdout)
    return code


def _build_parser(argv: list[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="expected-appearances",
        description="Register a surgical microscope view to preoperative MRI by learning expected appearances. "
        "Not a medical device; for research only.",
        epilog="Exit codes: 0 done, 2 bad input (every problem is listed), 3 cancelled, 1 anything else. "
        "`COMMAND --help` explains a command.",
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    chosen = next((word for word in argv if not word.startswith("-")), None)
    for name, (module, text) in COMMANDS.items():
        command = subparsers.add_parser(name, help=text)
        if name == chosen:
            implementation = importlib.import_module(module, __name__)
            implementation.add_arguments(command)
            command.set_defaults(run=implementation.run)
    return parser


def comma_separated(text: str) -> tuple[str, ...]:
    """Type of an option that takes several names."""
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    if not names:
        raise argparse.ArgumentTypeError("names nothing; give names separated by commas")
    return names


@contextlib.contextmanager
def termination_cancels() -> Iterator[None]:
    """Within the block, SIGTERM (and Ctrl+Break on Windows) raises CancelledError."""

    def cancel(_number, _frame):
        raise CancelledError("Stopped by a signal; what was finished is kept.")

    usual = {}
    for name in ("SIGTERM", "SIGBREAK"):
        # ValueError: outside the main thread, where no handler can be set.
        with contextlib.suppress(AttributeError, ValueError):
            usual[name] = signal.signal(getattr(signal, name), cancel)
    try:
        yield
    finally:
        for name, handler in usual.items():
            signal.signal(getattr(signal, name), handler)


def _report_system_error(command: str, error: OSError, log_path) -> int:
    if error.errno not in UNWRITABLE:
        _report_failure(error, log_path)
        return EXIT_FAILED
    name = error.filename or "a file"
    say_problems(command, [f"{name}: {error.strerror}; free some space or choose a folder you may use."])
    return EXIT_BAD_INPUT


def _report_failure(error: Exception, log_path) -> None:
    if isinstance(error, ImportError):
        text = _missing_package(error)
    elif isinstance(error, ExpectedAppearancesError):
        text = str(error)
    else:
        text = f"{type(error).__name__}: {error}"
    _say(f"Failed: {text}\nDetails are in the log: {log_path or '(no log could be written)'}")


def _missing_package(error: ImportError) -> str:
    name = (error.name or "").partition(".")[0]
    if not isinstance(error, ModuleNotFoundError) or name in ("", "ExpectedAppearancesLib"):
        return f"{type(error).__name__}: {error}"
    return f"the Python package '{name}' is not installed; install it with pip (`check` lists what is missing)."


def say_problems(command: str, problems: list[str]) -> None:
    count = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
    _say("\n".join([f"{command}: {count} with the input", *(f"  - {problem}" for problem in problems)]))


def _say(text: str) -> None:
    from .progress import tell

    tell(text + "\n", sys.stderr)
