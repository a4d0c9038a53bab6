"""The Slicer extension: what is packaged, how it is described, and what its panels need of each other's files."""

from __future__ import annotations

import ast
import json
import re
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest
from package_files import HEADER, LIST, library_files
from panels import in_the_panel

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "ExpectedAppearances"
MODULE = FOLDER / "ExpectedAppearances.py"
MODULES = sorted(FOLDER.glob("*.py"))
WIDGETS = ROOT / "ExpectedAppearancesLib" / "widgets"
# The parts of each panel: which files of the library's widgets it is made of.
PARTS = {"ExpectedAppearances": "planning_*.py", "ExpectedAppearancesLive": "live_*.py"}
CLI_FOLDERS = sorted(path.parent for path in MODULE.parent.glob("*/CMakeLists.txt"))
SHARED_ENTRIES = ("homepage", "contributors", "description", "category", "iconurl", "screenshoturls", "depends")
ALLOWED_IMPORTS = {"slicer", "vtk", "numpy", "qt", "ctk"} | set(sys.stdlib_module_names)


def cmake_list(path: Path, name: str) -> list[str]:
    found = re.search(rf"set\({name}\s+(.*?)\)", path.read_text(encoding="utf-8"), re.DOTALL)
    assert found, f"{path} has no list {name}"
    return found[1].split()


def cmake_entries() -> dict:
    text = (ROOT / "CMakeLists.txt").read_text(encoding="utf-8")
    return {name.lower(): value for name, value in re.findall(r'^set\(EXTENSION_(\w+) "([^"\n]*)"\)$', text, re.M)}


def s4ext_entries() -> dict:
    lines = (ROOT / "ExpectedAppearances.s4ext").read_text(encoding="utf-8").splitlines()
    return dict(line.split(" ", 1) for line in lines if line and not line.startswith("#"))


def listed_files(lists: Path) -> list[str]:
    """Scripts and resources of every module that a CMakeLists.txt builds, ${MODULE_NAME} filled in."""
    found, name = [], ""
    for variable, value in re.findall(r"set\((\w+)\s+(.*?)\)", lists.read_text(encoding="utf-8"), re.DOTALL):
        if variable == "MODULE_NAME":
            name = value.strip()
        else:
            found += value.replace("${MODULE_NAME}", name).split()
    return found


def ui_root(module: Path) -> ElementTree.Element:
    return ElementTree.parse(FOLDER / "Resources" / "UI" / f"{module.stem}.ui").getroot()


def panel_source(module: Path) -> str:
    files = [module, *sorted(WIDGETS.glob(PARTS[module.stem]))]
    return "\n".join(path.read_text(encoding="utf-8") for path in files)


def every_module(test):
    return pytest.mark.parametrize("module", MODULES, ids=lambda path: path.stem)(test)


def test_every_file_of_the_library_is_packaged():
    scripts = cmake_list(LIST, "EXPECTEDAPPEARANCESLIB_SCRIPTS")
    resources = cmake_list(LIST, "EXPECTEDAPPEARANCESLIB_RESOURCES")
    forgotten = set(library_files()) - set(scripts) - set(resources)
    assert not forgotten, f"{LIST.name} lacks them; run python Testing/package_files.py"
    gone = [name for name in scripts + resources if not (ROOT / name).is_file()]
    assert not gone, f"{LIST.name} lists files that do not exist; run python Testing/package_files.py"
    assert all(name.endswith(".py") for name in scripts)
    assert not any(name.endswith(".py") for name in resources)
    assert len(set(scripts + resources)) == len(scripts + resources)
    assert LIST.read_text(encoding="utf-8").startswith(HEADER)


def test_every_file_of_the_modules_is_packaged_once():
    listed = listed_files(FOLDER / "CMakeLists.txt")
    paths = [path for path in FOLDER.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    # A command-line module in a folder of its own has a list of its own.
    paths = [path for path in paths if path.parent not in CLI_FOLDERS]
    assert sorted(listed) == sorted({path.relative_to(FOLDER).as_posix() for path in paths} - {"CMakeLists.txt"})


def test_every_command_line_module_is_built():
    lists = (MODULE.parent / "CMakeLists.txt").read_text(encoding="utf-8")
    assert CLI_FOLDERS and re.findall(r"add_subdirectory\((\w+)\)", lists) == [f.name for f in CLI_FOLDERS]
    for folder in CLI_FOLDERS:
        own = (folder / "CMakeLists.txt").read_text(encoding="utf-8")
        assert f"set(MODULE_NAME {folder.name})" in own and "SlicerMacroBuildScriptedCLI(" in own
        files = {path.name for path in folder.iterdir() if path.is_file()}
        assert files == {"CMakeLists.txt", f"{folder.name}.py", f"{folder.name}.xml"}


def test_descriptions_agree():
    cmake, s4ext = cmake_entries(), s4ext_entries()
    index = json.loads((ROOT / "ExpectedAppearances.json").read_text(encoding="utf-8"))
    for name in SHARED_ENTRIES:
        assert cmake[name] and cmake[name] == s4ext[name], name
    assert index["category"] == cmake["category"]
    assert index["scm_url"] == s4ext["scmurl"] == cmake["homepage"] + ".git"
    assert index["scm_revision"] == s4ext["scmrevision"]
    assert index["build_subdirectory"] == s4ext["build_subdirectory"]
    assert index["build_dependencies"] == [name for name in cmake["depends"].split() if name != "NA"]
    # The catalogue's schema allows nothing else.
    assert set(index) <= {
        *("$schema", "build_dependencies", "build_subdirectory", "category", "enabled"),
        *("scm_revision", "scm_type", "scm_url", "tier"),
    }
    assert index["$schema"].endswith("schema-v1.0.1.json#")


@every_module
def test_descriptions_agree_with_the_modules(module):
    source = module.read_text(encoding="utf-8")
    cmake = cmake_entries()
    assert f'parent.contributors = ["{cmake["contributors"]}"]' in source
    assert f'translate("qSlicerAbstractCoreModule", "{cmake["category"]}")' in source
    assert cmake["homepage"] in source
    assert "MICCAI 2023" in source
    assert "Not for clinical use" in source or "not for clinical use" in source.lower()


@pytest.mark.parametrize(("entry", "begins"), [("iconurl", b"\x89PNG"), ("screenshoturls", b"\xff\xd8")])
def test_picture_urls_name_files_of_the_repository(entry, begins):
    for url in cmake_entries()[entry].split():
        assert (ROOT / url.split("/main/")[1]).read_bytes().startswith(begins)


@every_module
def test_every_module_has_its_icon(module):
    assert (FOLDER / "Resources" / "Icons" / f"{module.stem}.png").read_bytes().startswith(b"\x89PNG")


@every_module
def test_module_imports_only_what_slicer_has(module):
    imported = set()
    for node in ast.parse(module.read_text(encoding="utf-8")).body:
        for inner in ast.walk(node) if isinstance(node, (ast.If, ast.Try, ast.With)) else [node]:
            if isinstance(inner, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in inner.names}
            elif isinstance(inner, ast.ImportFrom):
                imported.add((inner.module or "").split(".")[0])
    assert imported <= ALLOWED_IMPORTS
    assert "slicer" in imported


@every_module
def test_logic_knows_no_qt(module):
    tree = ast.parse(module.read_text(encoding="utf-8"))
    logic = next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name.endswith("Logic"))
    names = {node.id for node in ast.walk(logic) if isinstance(node, ast.Name)}
    attributes = {node.attr for node in ast.walk(logic) if isinstance(node, ast.Attribute)}
    assert not {"qt", "ctk"} & names
    assert not {"app", "ui"} & attributes


@every_module
def test_panel_has_every_widget_that_the_code_uses(module):
    named = {widget.get("name") for widget in ui_root(module).iter("widget")}
    used = set(re.findall(r"\bui\.(\w+)", panel_source(module)))
    assert len(used) >= 5
    assert used <= named, used - named
    assert ui_root(module).find("widget").get("class") == "qMRMLWidget"


@every_module
def test_every_widget_has_a_name_of_its_own(module):
    """The code finds a widget by its name: of two, one is shown and the other one is written to."""
    names = [widget.get("name") for widget in ui_root(module).iter("widget")]
    assert sorted(set(names)) == sorted(names)


def test_no_menu_of_slicer_is_named_as_a_module():
    """Slicer leaves a module out of its menus when a submenu has the title of another module."""
    titles = {re.search(r'parent.title = _\("(.+)"\)', path.read_text(encoding="utf-8"))[1] for path in MODULES}
    assert len(titles) == len(MODULES)
    for path in FOLDER.glob("*/*.xml"):
        assert not titles & set(ElementTree.parse(path).findtext("category").split("."))


def test_sample_is_registered_as_slicer_asks():
    """Slicer 5.8 takes the length of `uris` also where nothing is downloaded."""
    calls = [
        {keyword.arg: keyword.value for keyword in node.keywords}
        for node in ast.walk(ast.parse((FOLDER / "ExpectedAppearancesLive.py").read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "registerCustomSampleDataSource"
    ]
    assert len(calls) == 1
    assert isinstance(calls[0]["uris"].value, str)


def test_every_planning_step_has_its_section():
    from ExpectedAppearancesLib.planning.steps import STEPS

    named = {widget.get("name") for widget in ui_root(MODULE).iter("widget")}
    assert {f"{step}{part}" for step in STEPS for part in ("Section", "Status")} <= named


@every_module
def test_panel_names_parameters_that_exist(module):
    bound = [p.findtext("string") for p in ui_root(module).iter("property") if p.get("name") == "SlicerParameterName"]
    tree = ast.parse(module.read_text(encoding="utf-8"))
    node = next(n for n in tree.body if isinstance(n, ast.ClassDef) and n.name.endswith("ParameterNode"))
    parameters = {n.target.id for n in node.body if isinstance(n, ast.AnnAssign)}
    assert len(set(bound)) == len(bound)
    assert set(bound) <= parameters, set(bound) - parameters


def test_the_planning_panel_begins_with_what_the_commands_do_by_themselves():
    from ExpectedAppearancesLib.appearances.workload import DEFAULT_ITERATIONS
    from ExpectedAppearancesLib.cli import _build_parser
    from ExpectedAppearancesLib.model.presets import PRESETS

    tree = ast.parse(MODULE.read_text(encoding="utf-8"))
    node = next(n for n in tree.body if isinstance(n, ast.ClassDef) and n.name.endswith("ParameterNode"))
    constants = (n for n in node.body if isinstance(n, ast.AnnAssign) and isinstance(n.value, ast.Constant))
    panel = {n.target.id: n.value.value for n in constants}
    words = ["synthesize", "CASE"]
    assert panel["iterations"] == DEFAULT_ITERATIONS == _build_parser(words).parse_args(words).iterations
    assert panel["minutes"] == PRESETS["quick"].minutes
    words = ["render", "CASE"]
    rendered = _build_parser(words).parse_args(words)
    assert (panel["poseCount"], panel["seed"]) == (rendered.poses, rendered.seed)
    ranges = (panel["tiltMaxDeg"], panel["rollMaxDeg"], panel["inViewPercent"] / 100)
    assert ranges == (rendered.tilt_deg, rendered.roll_deg, rendered.in_view)


@every_module
def test_panel_is_as_wide_whatever_is_unfolded(module):
    """Slicer gives a panel the width that its content needs: without a common minimum the views jump."""
    root = ui_root(module).find("widget")
    assert int(root.findtext("property[@name='minimumSize']/size/width")) >= 400
    long_texts = {"deviceCombo", "closingCombo"}  # names of graphics cards, whole sentences
    for combo in (w for w in root.iter("widget") if w.get("name") in long_texts):
        assert combo.findtext("property[@name='sizeAdjustPolicy']/enum").endswith("WithIcon")


def test_every_number_of_the_planning_panel_has_its_unit():
    for widget in ui_root(MODULE).iter("widget"):
        if widget.get("class") in ("QSpinBox", "QDoubleSpinBox", "ctkSliderWidget"):
            assert widget.findtext("property[@name='suffix']/string"), widget.get("name")


def test_the_planning_panel_has_no_text_field_and_explains_what_is_chosen():
    for widget in ui_root(MODULE).iter("widget"):
        assert widget.get("class") not in ("QLineEdit", "QTextEdit", "QPlainTextEdit"), widget.get("name")
        if widget.get("class") in ("QComboBox", "QSpinBox", "QDoubleSpinBox", "ctkSliderWidget", "qMRMLNodeComboBox"):
            assert widget.findtext("property[@name='toolTip']/string"), widget.get("name")


def test_buttons_start_disabled_where_something_must_be_chosen_first():
    enabled = {w.get("name"): w.findtext("property[@name='enabled']/bool") for w in ui_root(MODULE).iter("widget")}
    for name in (
        "saveCaseButton",
        "renderButton",
        "appearancesStart",
        "trainingStart",
        "studyStart",
        "showFiguresButton",
    ):
        assert enabled[name] == "false", name


def test_opening_the_planning_panel_loads_nothing_heavy():
    """In a fresh interpreter with stand-ins for Qt and Slicer: a fresh Slicer has none of these packages."""
    told = in_the_panel(
        """
assert all(panel.steps[name].text for name in panel.sections), panel.steps
heavy = ("torch", "cv2", "onnxruntime", "skimage", "scipy", "matplotlib")
print([name for name in heavy if name in sys.modules], len(panel.sections))
"""
    )
    assert told.strip() == "[] 7"
