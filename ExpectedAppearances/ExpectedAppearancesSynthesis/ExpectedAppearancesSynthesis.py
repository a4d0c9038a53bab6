#!/usr/bin/env python-real
"""The command `synthesize` as a command-line module of 3D Slicer, and for a shell."""

import sys
from pathlib import Path

# The library is in the qt-scripted-modules folder beside cli-modules, or at the root of a source tree; Slicer does not
# put either on the path of its command-line modules in every case.
for _folder in Path(__file__).resolve().parents[:3]:
    for _candidate in (_folder / "qt-scripted-modules", _folder):
        if (_candidate / "ExpectedAppearancesLib" / "__init__.py").is_file() and str(_candidate) not in sys.path:
            sys.path.insert(1, str(_candidate))

# Guarded: the process that renders training views imports this file again.
if __name__ == "__main__":
    from ExpectedAppearancesLib.cli.command_line_module import main

    sys.exit(main("synthesize"))
