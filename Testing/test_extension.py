"""The Slicer extension: what is packaged, how it is described, and its module on a real MRML scene."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import json
import re
import sys
import types
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pytest
from package_files import HEADER, LIST, library_files

ROOT = Path(__file__).resolve().parents[1]
MODULE = ROOT / "ExpectedAppearances" / "ExpectedAppearances.py"
UI = ROOT / "ExpectedAppearances" / "Resources" / "UI" / "ExpectedAppearances.ui"
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


def ui_root() -> ElementTree.Element:
    return ElementTree.parse(UI).getroot()


def ui_names() -> set[str]:
    return {widget.get("name") for widget in ui_root().iter("widget")}


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


def test_every_file_of_the_module_is_packaged():
    folder = MODULE.parent
    lists = folder / "CMakeLists.txt"
    listed = cmake_list(lists, "MODULE_PYTHON_SCRIPTS") + cmake_list(lists, "MODULE_PYTHON_RESOURCES")
    listed = {name.replace("${MODULE_NAME}", folder.name) for name in listed}
    paths = [path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    # A command-line module in a folder of its own has a list of its own.
    paths = [path for path in paths if path.parent not in CLI_FOLDERS]
    assert listed == {path.relative_to(folder).as_posix() for path in paths} - {"CMakeLists.txt"}


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


def test_descriptions_agree_with_the_module():
    source = MODULE.read_text(encoding="utf-8")
    cmake = cmake_entries()
    assert f'parent.contributors = ["{cmake["contributors"]}"]' in source
    assert f'translate("qSlicerAbstractCoreModule", "{cmake["category"]}")' in source
    assert f'"{cmake["homepage"]}"' in source


def test_icon_url_names_a_file_of_the_repository():
    path = cmake_entries()["iconurl"].split("/main/")[1]
    assert (ROOT / path).read_bytes().startswith(b"\x89PNG")


def test_module_imports_only_what_slicer_has():
    imported = set()
    for node in ast.parse(MODULE.read_text(encoding="utf-8")).body:
        for inner in ast.walk(node) if isinstance(node, (ast.If, ast.Try, ast.With)) else [node]:
            if isinstance(inner, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in inner.names}
            elif isinstance(inner, ast.ImportFrom):
                imported.add((inner.module or "").split(".")[0])
    assert imported <= ALLOWED_IMPORTS
    assert "slicer" in imported


def test_logic_knows_no_qt():
    tree = ast.parse(MODULE.read_text(encoding="utf-8"))
    logic = next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name.endswith("Logic"))
    names = {node.id for node in ast.walk(logic) if isinstance(node, ast.Name)}
    attributes = {node.attr for node in ast.walk(logic) if isinstance(node, ast.Attribute)}
    assert not {"qt", "ctk"} & names
    assert not {"app", "ui"} & attributes


def test_panel_has_every_widget_that_the_code_uses():
    used = set(re.findall(r"\bui\.(\w+)", MODULE.read_text(encoding="utf-8")))
    assert len(used) >= 5
    assert used <= ui_names()
    assert ui_root().find("widget").get("class") == "qMRMLWidget"


def test_panel_starts_disabled_and_names_parameters_that_exist():
    enabled = {w.get("name"): w.findtext("property[@name='enabled']/bool") for w in ui_root().iter("widget")}
    assert enabled["showButton"] == "false"
    bound = [p.findtext("string") for p in ui_root().iter("property") if p.get("name") == "SlicerParameterName"]
    tree = ast.parse(MODULE.read_text(encoding="utf-8"))
    node = next(n for n in tree.body if isinstance(n, ast.ClassDef) and n.name.endswith("ParameterNode"))
    parameters = {n.target.id for n in node.body if isinstance(n, ast.AnnAssign)}
    assert bound and set(bound) <= parameters


@pytest.fixture
def module(monkeypatch):
    """The module on slicer-core's MRML, with stand-ins for the parts of Slicer that need Qt."""
    slicer = pytest.importorskip("slicer")

    class Base:
        def __init__(self, parent=None):
            pass

    names = ["", "Logic", "Widget", "Test"]
    stand_ins = {
        "i18n": {"tr": lambda text: text, "translate": lambda _context, text: text},
        "parameterNodeWrapper": {"parameterNodeWrapper": lambda cls: cls},
        "ScriptedLoadableModule": {f"ScriptedLoadableModule{name}": type(name, (Base,), {}) for name in names},
    }
    for name, values in stand_ins.items():
        stand_in = types.ModuleType(f"slicer.{name}")
        vars(stand_in).update(values)
        monkeypatch.setitem(sys.modules, stand_in.__name__, stand_in)
    importlib.import_module("slicer.util")
    monkeypatch.setattr(slicer.util, "VTKObservationMixin", type("Mixin", (), {}), raising=False)
    monkeypatch.setattr(slicer, "mrmlScene", slicer.vtkMRMLScene(), raising=False)
    spec = importlib.util.spec_from_file_location("ExpectedAppearancesModule", MODULE)
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


def marked(module) -> list:
    return list(module.ExpectedAppearancesLogic()._shown())


def count(class_name: str) -> int:
    import slicer

    return slicer.mrmlScene.GetNumberOfNodesByClass(class_name)


def test_says_what_is_missing_before_a_frame_can_be_shown(module, tmp_path):
    logic = module.ExpectedAppearancesLogic()
    case, poses = module._writeTinyCase(tmp_path)
    assert "Choose a case" in logic.problem("", "")
    assert "case.json" in logic.problem(str(tmp_path), poses)
    assert "Choose the poses.json" in logic.problem(case, "")
    assert "absent.json" in logic.problem(case, str(tmp_path / "absent.json"))
    assert logic.problem(case, poses) == ""
    Path(poses).write_text("{", encoding="utf-8")  # read again, since it changed
    assert "poses.json" in logic.problem(case, poses)


def test_shows_the_frame_in_the_place_of_the_last(module, tmp_path):
    logic = module.ExpectedAppearancesLogic()
    case, poses = module._writeTinyCase(tmp_path)
    assert logic.show(case, poses, 0), logic.message
    nodes = len(marked(module))
    assert count("vtkMRMLVectorVolumeNode") == count("vtkMRMLLinearTransformNode") == 1
    assert count("vtkMRMLModelNode") == 3  # vessels, frustum, outline
    assert logic.show(case, poses, 0)
    assert len(marked(module)) == nodes


def test_hiding_all_leaves_only_the_users_own_nodes(module, tmp_path):
    import slicer

    own = slicer.mrmlScene.AddNewNodeByClass("vtkMRMLModelNode", "Vessels")
    nodes = slicer.mrmlScene.GetNumberOfNodes()
    logic = module.ExpectedAppearancesLogic()
    assert logic.show(*module._writeTinyCase(tmp_path), 0), logic.message
    logic.hideAll()
    assert slicer.mrmlScene.GetNumberOfNodes() == nodes
    assert slicer.mrmlScene.IsNodePresent(own)
    assert logic.message == ""


@pytest.mark.parametrize("index", [1, 7])
def test_nothing_old_stays_when_a_frame_is_refused(module, tmp_path, index):
    logic = module.ExpectedAppearancesLogic()
    case, poses = module._writeTinyCase(tmp_path)
    assert logic.show(case, poses, 0), logic.message
    assert not logic.show(case, poses, index)
    assert str(index) in logic.message
    assert count("vtkMRMLVectorVolumeNode") == count("vtkMRMLLinearTransformNode") == 0
    assert count("vtkMRMLModelNode") == 1  # the vessels


def test_a_frame_that_fails_leaves_no_half_of_it(module, tmp_path):
    logic = module.ExpectedAppearancesLogic()
    case, poses = module._writeTinyCase(tmp_path)
    (tmp_path / "accepted.png").write_bytes(b"not a picture")
    assert not logic.show(case, poses, 0)
    assert "accepted.png" in logic.message
    assert count("vtkMRMLLinearTransformNode") == 0


def test_red_slice_lies_on_the_frame_upright(module, tmp_path):
    import slicer

    red = slicer.vtkMRMLSliceNode()
    red.SetLayoutName("Red")
    red.SetSingletonTag("Red")
    red.SetDimensions(640, 480, 1)
    composite = slicer.vtkMRMLSliceCompositeNode()
    composite.SetSingletonTag("Red")
    for node in (red, composite):
        slicer.mrmlScene.AddNode(node)
    logic = module.ExpectedAppearancesLogic()
    assert logic.show(*module._writeTinyCase(tmp_path), 0), logic.message

    slice_to_ras = np.array([[red.GetSliceToRAS().GetElement(i, j) for j in range(4)] for i in range(4)])
    # The camera looks down world -z with world y up; LPS -> RAS turns x and y.
    np.testing.assert_allclose(slice_to_ras[:3, 1], [0, -1, 0], atol=1e-9)
    np.testing.assert_allclose(slice_to_ras[:3, 2], [0, 0, 1], atol=1e-9)
    assert abs(slice_to_ras[2, 3]) < 15.0  # within the sphere around the origin
    assert red.GetSliceVisible()
    width_mm, height_mm, _depth_mm = red.GetFieldOfView()
    assert width_mm / 640 == pytest.approx(height_mm / 480)
    assert width_mm == pytest.approx((300 - slice_to_ras[2, 3]) * 64 / 90, rel=1e-3)
    volume = slicer.mrmlScene.GetFirstNodeByClass("vtkMRMLVectorVolumeNode")
    assert composite.GetBackgroundVolumeID() == volume.GetID()
