"""The one exception hierarchy of the library, and the exit codes of the command line."""

from __future__ import annotations

from collections.abc import Iterable

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_BAD_INPUT = 2
EXIT_CANCELLED = 3


class ExpectedAppearancesError(Exception):
    """Base of everything the library raises on purpose; its text is meant for the user."""

    exit_code = EXIT_FAILED


class InputError(ExpectedAppearancesError):
    """What the user gave cannot be used. Holds every problem found, each naming the file and the way out."""

    exit_code = EXIT_BAD_INPUT

    def __init__(self, problems: str | Iterable[str]):
        self.problems = [problems] if isinstance(problems, str) else list(problems)
        super().__init__("\n".join(self.problems))


class CancelledError(ExpectedAppearancesError):
    """The user stopped the run; what was finished is kept and the next start goes on from there."""

    exit_code = EXIT_CANCELLED


class Problems:
    """Collects problems so that all are reported at once.

    >>> problems = Problems()
    >>> with problems.collect():
    ...     raise InputError("a.vtp: not found; give the path of the vessel mesh.")
    >>> problems.found
    ['a.vtp: not found; give the path of the vessel mesh.']
    """

    def __init__(self) -> None:
        self.found: list[str] = []

    def add(self, problem: str) -> None:
        self.found.append(problem)

    def collect(self) -> Problems:
        return self

    def __enter__(self) -> Problems:
        return self

    def __exit__(self, _kind, error, _trace) -> bool:
        if isinstance(error, InputError):
            self.found.extend(error.problems)
            return True
        return False

    def raise_if_any(self) -> None:
        if self.found:
            raise InputError(self.found)
