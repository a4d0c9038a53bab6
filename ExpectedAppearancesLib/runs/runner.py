"""Hours of work in a process of its own: started, watched without waiting, cancelled as a whole, found again."""

from __future__ import annotations

import datetime
import importlib.util
import platform
import sys
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

from .. import files
from ..errors import EXIT_BAD_INPUT, EXIT_CANCELLED, EXIT_DONE, InputError
from ..interpreter import python_for_runs
from . import processes
from .environment import command_of, environment_of
from .output import OutputReader
from .record import RunRecord, by_the_clock, exclusive, read_record, update_record, write_record
from .results import remove_partial_files, result_problem
from .state import RunState, RunStatus

# After which the processes are no longer asked to end. A training ends its step, or validation, and saves.
CANCEL_DEADLINE_S = 30.0
SWEEP_DEADLINE_S = 5.0
START_LOCK_S = 1.0
TAIL_LINES = 8
NEEDED_PACKAGES = ("psutil", "filelock")
KEPT = "What was finished is kept; the next start goes on from there."


class Run:
    """One run of a command on a case. Not for threads: all calls come from the one that polls."""

    def __init__(self, case_folder: Path, record: RunRecord, from_the_end: bool = False):
        self.case_folder = Path(case_folder)
        self.kind = record.kind
        self._record = record
        self._tree = processes.ProcessTree(record.pid, record.created_s, record.mark)
        self._output = OutputReader(self.case_folder / record.log, from_the_end)
        # One that an earlier program began to cancel, and did not live to see the end of, is ended here.
        self._cancel_deadline = time.monotonic() + CANCEL_DEADLINE_S if record.cancelled else None
        self._sweep_deadline: float | None = None
        self._final: RunStatus | None = None

    @staticmethod
    def start(
        kind: str,
        case_folder: Path,
        arguments: list[str],
        python: str | None = None,
        environment: dict[str, str] | None = None,
    ) -> Run:
        """Start `kind` ("synthesize", "train", or another command) on the case with the command's own options.

        environment: variables to set beside this process's own, such as CUDA_VISIBLE_DEVICES to choose a GPU.
        Raises InputError: no case, a run of this kind is going on in it, or it cannot be started.
        """
        missing = [name for name in NEEDED_PACKAGES if importlib.util.find_spec(name) is None]
        if missing:
            raise InputError(f"{' and '.join(missing)}: not installed; install the Python packages for training first.")
        folder = Path(case_folder).absolute()
        if not (folder / "case.json").is_file():
            raise InputError(f"{folder}: not a case folder (no case.json in it); make one with `new`.")
        python = python or python_for_runs()
        with exclusive(folder, f"{kind}.start", START_LOCK_S):
            previous = read_record(folder, kind)
            if previous is not None:
                if _tree_of(previous).running():
                    raise InputError(
                        f"{folder}: a run of '{kind}' is going on in this case (process {previous.pid}, since "
                        f"{by_the_clock(previous.started)}); wait until it has ended, or cancel it."
                    )
                if not previous.outcome:
                    _tree_of(previous).kill()  # orphans of a crash that nobody has seen
                remove_partial_files(folder, [previous.pid])
            log = _new_log(folder, kind)
            mark = uuid.uuid4().hex
            command = command_of(kind, folder, [str(argument) for argument in arguments], python)
            try:
                tree = processes.start(command, environment_of(mark) | (environment or {}), folder / log)
            except OSError as error:
                raise InputError(
                    f"{python}: cannot be started ({error.strerror or error}); repair this Python."
                ) from error
            started = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
            record = RunRecord(
                kind, tree.pid, tree.created_s, mark, platform.node(), started, command, python, log.as_posix()
            )
            try:
                write_record(folder, record)
            except InputError:
                tree.kill()  # nobody would find it again
                raise
        return Run(folder, record)

    @staticmethod
    def find(case_folder: Path, kind: str) -> Run | None:
        """A run started earlier, maybe by a program that has been closed since: still going on, or ended without
        anybody having seen how. None when there is none."""
        record = read_record(Path(case_folder).absolute(), kind)
        if record is None or record.outcome or importlib.util.find_spec("psutil") is None:
            return None
        return Run(Path(case_folder).absolute(), record, from_the_end=True)

    @property
    def started(self) -> str:
        """ISO 8601, UTC."""
        return self._record.started

    @property
    def log_path(self) -> Path:
        return self.case_folder / self._record.log

    def poll(self) -> RunStatus:
        """What the run is doing; never waits. Call it until the state is no longer active."""
        if self._final is not None:
            return self._final
        if self._tree.running():
            self._output.read()
            # After its last words an interpreter may still tidy up for seconds.
            said_all = self._output.exit_code is not None
            if self._cancel_deadline is not None and (said_all or time.monotonic() > self._cancel_deadline):
                self._tree.kill()
            return self._status(self._active_state())
        if self._sweep_deadline is None:
            self._sweep_deadline = time.monotonic() + SWEEP_DEADLINE_S
            self._output.read(all_of_it=True)
        # A crash, or the kill, may have left some of what it had started.
        left = self._tree.members()
        if left:
            self._tree.kill()
            if time.monotonic() < self._sweep_deadline:
                return self._status(self._active_state())
        told = self._output.figures.get("pid")  # another one where a launcher stands between
        pids = {self._record.pid} | ({told} if isinstance(told, int) else set())
        remove_partial_files(self.case_folder, pids)
        self._final = self._judged()
        self._record = update_record(self.case_folder, self._record, outcome=self._final.state.value)
        return self._final

    def cancel(self) -> None:
        """Ask the run to end and return at once; `poll` sees to it that all its processes are gone by a deadline."""
        if self._final is not None or self._cancel_deadline is not None:
            return
        self._cancel_deadline = time.monotonic() + CANCEL_DEADLINE_S
        self._record = update_record(self.case_folder, self._record, cancelled=True)
        self._tree.ask_to_end()

    def detach(self) -> None:
        """Let the run go on when this program ends; `find` finds it again.

        Nothing holds it back: its session and its output are its own. What must not happen is a cancel under way.
        """
        if self._cancel_deadline is not None and self._final is None:
            raise InputError(f"{self.case_folder}: the run is being cancelled and cannot go on.")

    def wait(self, timeout_s: float) -> RunStatus:
        """Poll until the run has ended or the time is over. For tests and for closing, not for a GUI thread."""
        deadline = time.monotonic() + timeout_s
        while True:
            status = self.poll()
            if not status.state.active or time.monotonic() > deadline:
                return status
            time.sleep(0.05)

    def _active_state(self) -> RunState:
        if self._record.cancelled:
            return RunState.CANCELLING
        return RunState.RUNNING if self._output.begun else RunState.PREPARING

    def _status(self, state: RunState, exit_code: int | None = None, problem: str = "", message: str = "") -> RunStatus:
        output = self._output
        values = {key: value for key, value in output.figures.items() if key not in ("pid", "seconds_left")}
        return RunStatus(
            state,
            1.0 if state is RunState.DONE else output.fraction,
            message or output.message,
            output.figures.get("seconds_left") if state is RunState.RUNNING else None,
            exit_code,
            problem,
            self.log_path,
            values,
        )

    def _judged(self) -> RunStatus:
        code = self._tree.exit_code()
        if code is None or (self._record.cancelled and self._output.exit_code is not None):
            code = self._output.exit_code
        unfinished = result_problem(self.kind, self.case_folder) if code == EXIT_DONE else ""
        if code == EXIT_DONE and not unfinished:
            return self._status(RunState.DONE, code)
        if self._record.cancelled or code == EXIT_CANCELLED:
            return self._status(RunState.CANCELLED, code, message=f"Cancelled. {KEPT}")
        return self._status(RunState.FAILED, code, self._problem(code, unfinished))

    def _problem(self, code: int | None, unfinished: str) -> str:
        output = self._output
        if unfinished:
            return f"The run ended without an error, but its result is not whole: {unfinished}\nLog: {self.log_path}"
        if code == EXIT_BAD_INPUT and output.problems:
            return "\n".join(output.problems)
        said = output.failure()
        if said:
            return f"{said}\nLog: {self.log_path}"
        if code is None:
            how = "ended without a word: it was killed, or the computer was switched off"
        elif code < 0:
            how = f"was ended by signal {-code}"
            how += "; systems do this when the memory runs out" if code == -9 else ""
        else:
            how = f"ended with exit code {code}"
        tail = "".join(f"\n    {line}" for line in list(output.last_lines)[-TAIL_LINES:])
        return f"The run {how}. {KEPT}\nLog: {self.log_path}{tail}"


def loaded_for_runs() -> Iterator[None]:
    """Load what a start needs, a piece at each step, so that the first start takes no longer than the others."""
    for name in NEEDED_PACKAGES:
        if name not in sys.modules and importlib.util.find_spec(name) is not None:
            importlib.import_module(name)
            yield


def _tree_of(record: RunRecord) -> processes.ProcessTree:
    return processes.ProcessTree(record.pid, record.created_s, record.mark)


def _new_log(folder: Path, kind: str) -> Path:
    """A new empty file for the run's output, relative to the case."""
    stem = f"{datetime.datetime.now(datetime.timezone.utc):%Y%m%dT%H%M%SZ}"
    for attempt in range(1, 100):
        log = Path("logs") / f"{stem}{'' if attempt == 1 else f'.{attempt}'}-{kind}.output.log"
        with files.writing(folder / log):
            (folder / log).parent.mkdir(parents=True, exist_ok=True)
            try:
                (folder / log).touch(exist_ok=False)
                return log
            except FileExistsError:
                continue  # another run began in the same second
    raise InputError(f"{folder / 'logs'}: holds too many logs of this second; start again.")
