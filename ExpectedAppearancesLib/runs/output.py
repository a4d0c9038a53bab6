"""What a run has printed so far, read from its file piece by piece: 3D Slicer's progress tags, figures, last words."""

from __future__ import annotations

import json
import re
from collections import deque
from pathlib import Path
from xml.sax.saxutils import unescape

FIGURES_PREFIX = "figures "
EXIT_PREFIX = "exit code "
READ_AT_ONCE = 1 << 16
KEPT_LINES = 40
_PROGRESS = re.compile(r"<filter-progress>\s*([^<]*?)\s*</filter-progress>")
_COMMENT = re.compile(r"<filter-comment>(.*?)</filter-comment>")
_TAG = re.compile(r"</?filter-[a-z-]+>")


class OutputReader:
    """`read()` takes in what is new since the last time, a bounded piece of it, without waiting."""

    def __init__(self, path: Path, from_the_end: bool = False):
        self.path = Path(path)
        self.begun = False  # it has said how far it is
        self.fraction = 0.0
        self.message = ""
        self.figures: dict = {}
        self.exit_code: int | None = None
        self.problems: list[str] = []
        self.last_lines: deque[str] = deque(maxlen=KEPT_LINES)
        self._rest = b""
        self._position = 0
        if from_the_end and self.path.is_file():
            # Hours of progress lie before; only the newest counts.
            self._position = max(0, self.path.stat().st_size - READ_AT_ONCE)

    def read(self, all_of_it: bool = False) -> None:
        while True:
            try:
                with open(self.path, "rb") as stream:
                    stream.seek(self._position)
                    piece = stream.read(READ_AT_ONCE)
            except OSError:
                return
            self._position += len(piece)
            lines = (self._rest + piece).replace(b"\r\n", b"\n").split(b"\n")
            # A line without its end may still be being written.
            self._rest = lines.pop()
            for line in lines:
                self._take(line.decode("utf-8", errors="replace"))
            if not all_of_it or len(piece) < READ_AT_ONCE:
                break
        if all_of_it and self._rest:
            self._take(self._rest.decode("utf-8", errors="replace"))
            self._rest = b""

    def _take(self, line: str) -> None:
        progress = _PROGRESS.findall(line)
        if progress:
            try:
                self.fraction = min(max(float(progress[-1]), 0.0), 1.0)
                self.begun = True
            except ValueError:
                pass
        comments = _COMMENT.findall(line)
        if comments:
            self.message = unescape(comments[-1]).strip()
        if line.startswith(FIGURES_PREFIX):
            try:
                self.figures.update(json.loads(line[len(FIGURES_PREFIX) :]))
            except (ValueError, TypeError):
                self.last_lines.append(line)
        elif line.startswith(EXIT_PREFIX) and line[len(EXIT_PREFIX) :].strip().lstrip("-").isdigit():
            self.exit_code = int(line[len(EXIT_PREFIX) :])
        elif not _TAG.search(line) and line.strip():
            self.last_lines.append(line.rstrip())
            if line.startswith("  - "):
                self.problems.append(line[4:].strip())

    def failure(self) -> str:
        """What the run itself says went wrong; '' where it says nothing."""
        for i, line in enumerate(self.last_lines):
            if line.startswith("Failed: "):
                words = [line[len("Failed: ") :]]
                for more in list(self.last_lines)[i + 1 :]:
                    if more.startswith("Details are in the log"):
                        break
                    words.append(more)
                return "\n".join(words)
        return ""
