"""Writes ExpectedAppearancesLib/files.cmake: the files of the library that the Slicer package contains.

Run it after adding, renaming or removing a file: python Testing/package_files.py
"""

from __future__ import annotations

import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIST = ROOT / "ExpectedAppearancesLib" / "files.cmake"
HEADER = "# What the Slicer package contains of the library. Written by Testing/package_files.py.\n"


def library_files(*options: str) -> list[str]:
    """Files of the library, relative to the repository; options go to git ls-files. Without git, those on disk."""
    command = ["git", "ls-files", "-z", *options, "--", LIST.parent.name]
    try:
        # Not core.quotePath's escapes but the names themselves: -z.
        output = subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout.decode()
        names = output.rstrip("\0").split("\0")
    except (OSError, subprocess.CalledProcessError):
        paths = (path for path in LIST.parent.rglob("*") if path.is_file() and path.suffix != ".pyc")
        names = [path.relative_to(ROOT).as_posix() for path in paths]
    return sorted({name for name in names if (ROOT / name).is_file() and name != LIST.relative_to(ROOT).as_posix()})


def main() -> None:
    names = library_files("--cached", "--others", "--exclude-standard")
    scripts = [name for name in names if name.endswith(".py")]
    resources = [name for name in names if not name.endswith(".py")]
    text = HEADER
    for variable, entries in (("SCRIPTS", scripts), ("RESOURCES", resources)):
        text += f"set(EXPECTEDAPPEARANCESLIB_{variable}\n" + "".join(f"  {name}\n" for name in entries) + "  )\n"
    LIST.write_text(text, encoding="utf-8", newline="\n")
    print(f"{LIST}: {len(scripts)} scripts, {len(resources)} resources")


if __name__ == "__main__":
    main()
