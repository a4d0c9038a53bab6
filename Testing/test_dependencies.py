"""Python packages inside 3D Slicer: found without importing them, installed after asking, failures explained."""

from __future__ import annotations

import importlib.machinery
import subprocess
import sys
import time
import types
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.runs import dependencies, system_findings
from ExpectedAppearancesLib.runs.dependencies import InstallError, Package
from ExpectedAppearancesLib.runs.pip_words import explanation
from ExpectedAppearancesLib.runs.system_report import SystemCheck, system_report

ROOT = Path(__file__).resolve().parents[1]
NAME = "expected-appearances-test-package"
MODULE = NAME.replace("-", "_")


@pytest.fixture
def wanted(monkeypatch) -> Package:
    """A purpose "test" that needs a package nobody has."""
    package = Package(f"{NAME}>=2.0", MODULE)
    monkeypatch.setitem(dependencies.REQUIREMENTS, "test", (package,))
    return package


def write_wheel(folder: Path, version: str = "2.1", tag: str = "py3-none-any", needs: str = "") -> None:
    folder.mkdir(exist_ok=True)
    info = f"{MODULE}-{version}.dist-info"
    with zipfile.ZipFile(folder / f"{MODULE}-{version}-{tag}.whl", "w") as wheel:
        wheel.writestr(f"{MODULE}.py", "raise SystemExit('imported')\n")
        wheel.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {NAME}\nVersion: {version}\n{needs}")
        wheel.writestr(f"{info}/WHEEL", f"Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: {tag}\n")
        wheel.writestr(f"{info}/RECORD", "")


def test_requirements_file_names_what_the_purposes_need():
    text = (ROOT / "ExpectedAppearances" / "Resources" / "requirements.txt").read_text(encoding="utf-8")
    listed = [line for line in text.splitlines() if line and not line.startswith("#")]
    assert len(set(listed)) == len(listed)
    assert set(listed) == {p.specifier for packages in dependencies.REQUIREMENTS.values() for p in packages}
    for line in listed:
        Requirement(line)


def test_registration_needs_no_torch():
    registration = {p.name for p in dependencies.REQUIREMENTS["registration"]}
    assert "torch" not in registration and registration < {p.name for p in dependencies.REQUIREMENTS["training"]}


def test_missing_packages_are_found_without_importing_any():
    source = (
        "import sys; from ExpectedAppearancesLib.runs import dependencies as d;"
        "[d.missing(kind) for kind in d.REQUIREMENTS];"
        "print([m for m in ('torch', 'cv2', 'onnxruntime', 'skimage', 'onnx', 'scipy', 'slicer') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.strip() == "[]", done.stderr


def test_what_is_too_old_or_absent_is_missing_and_what_serves_as_well_is_not(wanted, monkeypatch):
    assert dependencies.missing("test") == [f"{NAME}>=2.0"]
    spec = importlib.machinery.ModuleSpec(MODULE, None)
    usual = dependencies.importlib.util.find_spec
    monkeypatch.setattr(dependencies.importlib.util, "find_spec", lambda name: spec if name == MODULE else usual(name))
    versions = {}

    def version(name):
        if name not in versions:
            raise metadata.PackageNotFoundError(name)
        return versions[name]

    monkeypatch.setattr(dependencies.metadata, "version", version)
    assert dependencies.missing("test") == []  # a build of Slicer's own, unknown to pip
    versions[NAME] = "1.9.9"
    assert dependencies.missing("test") == [f"{NAME}>=2.0"]
    versions[NAME] = "2.10.0"
    assert dependencies.missing("test") == []
    other = Package(f"{NAME}>=2.0", MODULE, ("another-build",))
    monkeypatch.setitem(dependencies.REQUIREMENTS, "test", (other,))
    versions.clear()
    versions["another-build"] = "2.0"
    assert dependencies.missing("test") == []
    versions["another-build"] = "1.0"
    assert dependencies.missing("test") == [f"{NAME}>=2.0"]


# --- installing ------------------------------------------------------------------------------------------------------


@pytest.fixture
def pip_into(tmp_path, monkeypatch):
    """pip installs into a folder of the test, from which is imported, too; nothing reaches the network."""
    target = tmp_path / "site ü"
    target.mkdir()
    monkeypatch.setenv("PIP_TARGET", str(target))
    monkeypatch.setenv("PIP_DISABLE_PIP_VERSION_CHECK", "1")
    monkeypatch.syspath_prepend(str(target))
    return target


def test_installs_from_a_folder_of_wheels_after_asking(wanted, tmp_path, pip_into):
    wheels = tmp_path / "Räder 1"
    write_wheel(wheels)
    asked, told = [], []
    assert not dependencies.install("test", wheels, lambda names: asked.append(names), told.append)
    assert asked == [[f"{NAME}>=2.0"]] and not any(pip_into.iterdir())
    assert dependencies.install("test", wheels, lambda _names: True, told.append)
    assert dependencies.missing("test") == [] and NAME in "".join(told)
    assert MODULE not in sys.modules
    assert dependencies.install("test", None, lambda _names: pytest.fail("asked for nothing"))


@pytest.mark.parametrize(
    ("version", "tag", "words"),
    [("1.0", "py3-none-any", f"only as 1.0, which is not {NAME}>=2.0"), ("2.1", "cp27-cp27m-win32", "lacks a wheel")],
)
def test_a_folder_without_the_right_wheel_is_named_with_what_it_lacks(wanted, tmp_path, pip_into, version, tag, words):
    write_wheel(tmp_path / "wheels", version, tag)
    with pytest.raises(InstallError) as raised:
        dependencies.install("test", tmp_path / "wheels", lambda _names: True, lambda _text: None)
    assert words in str(raised.value) and NAME in str(raised.value) and str(tmp_path / "wheels") in str(raised.value)
    assert "No matching distribution" in raised.value.log


def test_wheels_for_another_numpy_are_told_with_the_one_to_download_them_for(wanted, tmp_path, pip_into):
    """The newest OpenCV wants a newer numpy than Slicer's: whoever downloaded what is listed had no way to go on."""
    write_wheel(tmp_path / "wheels", needs="Requires-Dist: numpy>=99\n")
    with pytest.raises(InstallError) as raised:
        dependencies.install("test", tmp_path / "wheels", lambda _names: True, lambda _text: None)
    assert f"pip download numpy=={metadata.version('numpy')} " in str(raised.value)
    assert str(tmp_path / "wheels") in str(raised.value)


def test_a_folder_without_wheels_is_refused_before_asking(wanted, tmp_path):
    with pytest.raises(InputError, match=r"holds no wheels"):
        dependencies.install("test", tmp_path, lambda _names: pytest.fail("asked"))


def test_no_network_is_explained(wanted, pip_into, monkeypatch):
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/simple")
    monkeypatch.setenv("PIP_EXTRA_INDEX_URL", "")
    monkeypatch.setenv("PIP_RETRIES", "0")
    monkeypatch.setenv("PIP_NO_CACHE_DIR", "1")
    monkeypatch.delenv("PIP_FIND_LINKS", raising=False)
    with pytest.raises(InstallError, match=r"no connection to the package index.*folder of wheels"):
        dependencies.install("test", None, lambda _names: True, lambda _text: None)


@pytest.mark.parametrize(
    ("log", "words"),
    [
        (
            "WARNING: ... ProxyError('Cannot connect to proxy.'\nERROR: No matching distribution found for x>=1",
            "HTTPS_PROXY",
        ),
        ("SSLError(SSLCertVerificationError(1, 'CERTIFICATE_VERIFY_FAILED'))", "PIP_CERT"),
        ("NewConnectionError: getaddrinfo failed\nERROR: No matching distribution found for x>=1", "no connection"),
        ("ERROR: No matching distribution found for x>=1", "x>=1: the package index has none"),
        ("ERROR: Could not install packages due to an OSError: [Errno 28] No space left on device", "disk is full"),
        ("ERROR: Could not install: [Errno 13] Permission denied: '/opt'", "cannot be written"),
        ("ERROR: ResolutionImpossible: for help visit", "must stay as it is"),
        ("ERROR: something new\n", "something new"),
        ("", "pip said nothing"),
    ],
)
def test_pips_words_are_explained(log, words):
    text = explanation(log, ["x>=1"], None)
    assert words in text and "x>=1" in text


# --- inside Slicer ---------------------------------------------------------------------------------------------------


@pytest.fixture
def slicer(monkeypatch):
    """A stand-in for Slicer's application: what its functions are called with, and a pip that may fail."""
    calls = []
    module = types.ModuleType("slicer")
    module.app = types.SimpleNamespace(applicationVersion="5.8.1", repositoryRevision="33241", platform="linux-amd64")
    module.util = types.SimpleNamespace(pip_install=lambda arguments: calls.append(("pip_install", arguments)))
    monkeypatch.setitem(sys.modules, "slicer", module)
    monkeypatch.delitem(sys.modules, "slicer.packaging", raising=False)
    return types.SimpleNamespace(module=module, calls=calls, monkeypatch=monkeypatch)


def found_after(monkeypatch, calls):
    """Everything is missing until something was installed."""
    monkeypatch.setattr(dependencies, "missing", lambda _kind: [] if calls else ["torch>=2.4", f"{NAME}>=2.0"])


def test_in_slicer_58_pip_keeps_slicers_numpy(slicer, monkeypatch):
    found_after(monkeypatch, slicer.calls)
    pins = []
    slicer.module.util.pip_install = lambda arguments: (
        slicer.calls.append(arguments),
        pins.append(Path(arguments[arguments.index("--constraint") + 1]).read_text(encoding="utf-8")),
    )
    assert dependencies.install("test", None, lambda _names: True, lambda _text: None)
    assert slicer.calls[0][:2] == [f"{NAME}>=2.0", "torch>=2.4"]
    assert f"numpy=={metadata.version('numpy')}\n" in pins[0]


def test_where_pip_ensure_exists_it_is_used_and_asks_no_second_time(slicer, monkeypatch):
    found_after(monkeypatch, slicer.calls)
    packaging = types.ModuleType("slicer.packaging")
    packaging.__spec__ = importlib.machinery.ModuleSpec("slicer.packaging", None)
    packaging.pip_ensure = lambda names, **options: slicer.calls.append((names, options))
    monkeypatch.setitem(sys.modules, "slicer.packaging", packaging)
    slicer.module.__path__ = []
    assert dependencies.install("test", None, lambda _names: True, lambda _text: None)
    (names, options), *others = slicer.calls
    assert names == [f"{NAME}>=2.0", "torch>=2.4"] and not others
    assert options["prompt_install"] is False and options["requester"]


def test_torch_comes_through_its_extension_except_from_a_folder(slicer, monkeypatch, tmp_path):
    found_after(monkeypatch, slicer.calls)

    class Logic:
        def installTorch(self, askConfirmation, torchVersionRequirement):
            slicer.calls.append(("extension", torchVersionRequirement))
            return object()

    module = types.ModuleType("PyTorchUtils")
    module.__spec__ = importlib.machinery.ModuleSpec("PyTorchUtils", None)
    module.PyTorchUtilsLogic = Logic
    monkeypatch.setitem(sys.modules, "PyTorchUtils", module)
    assert dependencies.install("test", None, lambda _names: True, lambda _text: None)
    assert slicer.calls[0] == ("extension", ">=2.4") and slicer.calls[1][1][0] == f"{NAME}>=2.0"
    assert "torch>=2.4" not in slicer.calls[1][1]

    slicer.calls.clear()
    write_wheel(tmp_path / "wheels")
    assert dependencies.install("test", tmp_path / "wheels", lambda _names: True, lambda _text: None)
    ((_, arguments),) = slicer.calls
    assert "torch>=2.4" in arguments and arguments[-3:] == ["--no-index", "--find-links", str(tmp_path / "wheels")]

    slicer.calls.clear()
    Logic.installTorch = lambda *_args, **_options: 1 / 0
    with pytest.raises(InstallError, match=r"torch: the PyTorch extension could not install it"):
        dependencies.install("test", None, lambda _names: True, lambda _text: None)


def test_check_knows_every_package_that_serves_as_well():
    """It told to install a second OpenCV beside the one that other extensions bring, which spoils both."""
    known = {name for names, _needed_by in system_findings.PACKAGES for name in names}
    for package in dependencies.REQUIREMENTS["registration"]:
        assert {package.name, *package.others} <= known, package


def test_report_for_a_mail_holds_what_check_says_and_slicers_version(slicer, monkeypatch):
    monkeypatch.setattr(system_findings, "_run_python", lambda _source: (0, "[]", ""))
    report = system_report(system_findings.make_report())
    monkeypatch.undo()
    assert report.startswith("3D Slicer 5.8.1 (revision 33241, linux-amd64)")
    assert f"Package numpy: {metadata.version('numpy')}" in report
    for purpose in ("registering frames", "planning", "synthesis and training"):
        assert f"For {purpose}: " in report


def test_the_computer_is_checked_without_waiting():
    begin = time.thread_time()
    query = SystemCheck()
    assert query.poll() is None and time.thread_time() - begin < 0.1
    deadline = time.monotonic() + 120
    while query.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    report = query.poll()
    assert report["packages"]["numpy"] == metadata.version("numpy") and isinstance(report["devices"], list)
    assert query.poll() is report
