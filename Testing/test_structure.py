"""The library's folders: data flows one way, and only the folders for it know Slicer."""

from __future__ import annotations

import ast
import graphlib
from pathlib import Path

LIBRARY = Path(__file__).resolve().parents[1] / "ExpectedAppearancesLib"


def imports_of(path: Path) -> list[str]:
    """Dotted names, in full, of all that a file of the library imports, wherever in the file."""
    package = [LIBRARY.name, *path.relative_to(LIBRARY).parts[:-1]]
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else []
            names += [".".join([*above, *filter(None, [node.module]), alias.name]) for alias in node.names]
    return names


def folder_imports() -> dict[str, set[str]]:
    """Each folder of the library with those that it imports."""
    folders = {path.name for path in LIBRARY.iterdir() if (path / "__init__.py").is_file()}
    graph = {folder: set() for folder in folders}
    for folder in folders:
        for path in (LIBRARY / folder).rglob("*.py"):
            for name in imports_of(path):
                parts = name.split(".")
                if parts[0] == LIBRARY.name and len(parts) > 1 and parts[1] in folders - {folder}:
                    graph[folder].add(parts[1])
    return graph


def test_no_folder_imports_one_that_imports_it():
    graph = folder_imports()
    assert "geometry" in graph["poses"] and "runs" in graph["cli"]  # relative imports are understood
    list(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError, which names the folders


def test_only_the_adapters_know_slicer():
    knowing = {
        path.relative_to(LIBRARY).parts[0]
        for path in LIBRARY.rglob("*.py")
        for name in imports_of(path)
        if name.split(".")[0] in ("slicer", "qt", "ctk")
    }
    assert knowing <= {"mrml", "widgets"}
