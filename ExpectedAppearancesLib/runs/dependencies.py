"""Python packages that 3D Slicer does not bring: which are missing, and installing them after asking.

Nothing here imports a package to see whether it is there, and Slicer's own functions are looked up only to install.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from ..errors import ExpectedAppearancesError, InputError
from ..interpreter import python_for_runs
from .pip_words import explanation

REQUESTER = "Expected Appearances"
# Slicer's own builds of these must stay: another numpy breaks what was compiled against this one.
KEPT_AS_THEY_ARE = ("numpy", "vtk", "SimpleITK", "scipy", "packaging", "setuptools", "pip")


@dataclass(frozen=True)
class Package:
    """specifier: pip's requirement. module: what is imported. others: distributions that serve as well."""

    specifier: str
    module: str
    others: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        return self.specifier.partition(">=")[0]

    @property
    def distributions(self) -> tuple[str, ...]:
        """Any one of them will do."""
        return (self.name, *self.others)


_NUMPY = Package("numpy>=1.26", "numpy")
OPENCV = Package(
    "opencv-python-headless>=4.8",
    "cv2",
    ("opencv-python", "opencv-contrib-python-headless", "opencv-contrib-python"),
)
ONNXRUNTIME = Package("onnxruntime>=1.17", "onnxruntime", ("onnxruntime-gpu", "onnxruntime-directml"))
_SCIPY = Package("scipy>=1.11", "scipy")
_PSUTIL = Package("psutil>=5.9", "psutil")
_FILELOCK = Package("filelock>=3.12", "filelock")
_TORCH = Package("torch>=2.4", "torch")

# By purpose. Registration, in the operating room, needs neither torch nor what trains.
REQUIREMENTS: dict[str, tuple[Package, ...]] = {
    "registration": (_NUMPY, OPENCV, ONNXRUNTIME),
    "planning": (_NUMPY, OPENCV, Package("scikit-image>=0.22", "skimage"), _PSUTIL, _FILELOCK),
    "training": (
        _NUMPY,
        OPENCV,
        ONNXRUNTIME,
        _TORCH,
        Package("safetensors>=0.4", "safetensors"),
        Package("onnx>=1.15", "onnx"),
        _SCIPY,
        Package("matplotlib>=3.7", "matplotlib"),
        Package("jinja2>=3.0", "jinja2"),
        _PSUTIL,
        _FILELOCK,
    ),
}


class InstallError(ExpectedAppearancesError):
    """pip could not install; the text names the cause and the way out. `log` is what pip printed."""

    def __init__(self, text: str, log: str = ""):
        super().__init__(text)
        self.log = log


_installing = False


def is_installing() -> bool:
    """Whether a block of `installing` goes on, whoever began it."""
    return _installing


@contextlib.contextmanager
def installing() -> Iterator[None]:
    """Around asking and installing: Slicer answers to clicks while pip is at work, and must not start it once more."""
    global _installing
    _installing = True
    try:
        yield
    finally:
        _installing = False


def missing(kind: str) -> list[str]:
    """pip's requirements for "registration", "planning" or "training" that are not met here. Imports none of them."""
    importlib.invalidate_caches()
    return [package.specifier for package in REQUIREMENTS[kind] if not _is_met(package)]


def install(
    kind: str,
    wheels_folder: Path | None,
    confirm: Callable[[list[str]], bool],
    say: Callable[[str], None] = print,
) -> bool:
    """Install what is missing for `kind`; True when all of it is there afterwards, False when the user declined.

    wheels_folder: install from this folder and not from the network. confirm: called with the requirements before
    anything is changed. say: takes lines of text for the user while it goes on. Raises InputError for a folder that
    holds no wheels, InstallError when pip fails.
    """
    wanted = missing(kind)
    if not wanted:
        return True
    if wheels_folder is not None and not any(Path(wheels_folder).glob("*.whl")):
        raise InputError(f"{wheels_folder}: holds no wheels (*.whl); choose the folder they were downloaded to.")
    if not confirm(wanted):
        return False
    torch = [name for name in wanted if name.startswith("torch")]
    rest = [name for name in wanted if name not in torch]
    with tempfile.TemporaryDirectory() as folder:
        constraints = Path(folder) / "constraints.txt"
        constraints.write_text("\n".join(_pins(wanted)) + "\n", encoding="utf-8")
        if torch and (wheels_folder is not None or not _install_torch_through_slicer(torch[0], say)):
            rest += torch
        if rest:
            say(f"Installing {', '.join(rest)} ...")
            _pip_install(rest, constraints, wheels_folder)
    left = missing(kind)
    if left:
        raise InstallError(f"{', '.join(left)}: still not found after the installation; restart the program.")
    return True


def slicer_packaging():
    """The module slicer.packaging (Slicer 5.11 and later) inside 3D Slicer's application, else None."""
    if "slicer" not in sys.modules or not hasattr(sys.modules["slicer"], "app"):
        return None
    try:
        packaging = importlib.import_module("slicer.packaging")
    except ModuleNotFoundError:
        return None
    return packaging if hasattr(packaging, "pip_ensure") else None


def _is_met(package: Package) -> bool:
    try:
        if importlib.util.find_spec(package.module) is None:
            return False
    except (ImportError, ValueError):
        return False
    for name in package.distributions:
        try:
            return _is_new_enough(package.specifier, metadata.version(name))
        except metadata.PackageNotFoundError:
            continue
    return True  # importable, but not by pip: Slicer's own build


def _is_new_enough(specifier: str, version: str | None) -> bool:
    from packaging.requirements import Requirement

    return version is not None and Requirement(specifier).specifier.contains(version, prereleases=True)


def _pins(wanted: Iterable[str]) -> list[str]:
    """Constraints that keep what is there as it is, except what is asked for."""
    names = {specifier.partition(">=")[0].lower() for specifier in wanted}
    pins = []
    for name in KEPT_AS_THEY_ARE:
        if name.lower() not in names:
            try:
                pins.append(f"{name}=={metadata.version(name)}")
            except metadata.PackageNotFoundError:
                continue
    return pins


def _install_torch_through_slicer(specifier: str, say: Callable[[str], None]) -> bool:
    """Let the PyTorch extension choose the build for this computer's graphics card; False where it is not there."""
    if importlib.util.find_spec("PyTorchUtils") is None or not hasattr(sys.modules.get("slicer"), "app"):
        return False
    say("Installing PyTorch through the PyTorch extension ...")
    logic = importlib.import_module("PyTorchUtils").PyTorchUtilsLogic()
    try:
        installed = logic.installTorch(askConfirmation=False, torchVersionRequirement=specifier[len("torch") :])
    except Exception as error:  # it passes on whatever went wrong below it
        raise InstallError(
            f"torch: the PyTorch extension could not install it ({error}); see its module 'PyTorch', or give a folder "
            "of wheels."
        ) from error
    return installed is not None


def _pip_install(requirements: list[str], constraints: Path, wheels_folder: Path | None) -> None:
    """Slicer's own functions where there are some: their dialogs show the progress. Asked for it was already."""
    arguments = [*requirements, "--constraint", str(constraints)]
    if wheels_folder is not None:
        arguments += ["--no-index", "--find-links", str(wheels_folder)]
    packaging = slicer_packaging()
    slicer = sys.modules.get("slicer")
    with _pip_log(constraints.parent) as log:
        try:
            if packaging is not None and wheels_folder is None:
                packaging.pip_ensure(
                    requirements,
                    constraints=constraints,
                    prompt_install=False,
                    requester=REQUESTER,
                    skip_in_testing=False,
                )
            elif hasattr(slicer, "app"):
                slicer.util.pip_install(arguments)
            else:
                command = [python_for_runs(), "-m", "pip", "install", *arguments]
                subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        except (subprocess.CalledProcessError, RuntimeError, OSError) as error:
            text = log.read_text(encoding="utf-8", errors="replace") if log.is_file() else str(error)
            raise InstallError(explanation(text, requirements, wheels_folder), text) from error


@contextlib.contextmanager
def _pip_log(folder: Path) -> Iterator[Path]:
    """A file that pip writes its words to, whoever starts it; Slicer passes none of them on."""
    path = folder / "pip.log"
    usual = os.environ.get("PIP_LOG")
    os.environ["PIP_LOG"] = str(path)
    try:
        yield path
    finally:
        if usual is None:
            del os.environ["PIP_LOG"]
        else:
            os.environ["PIP_LOG"] = usual
