"""What a support request needs to know about this machine."""

from __future__ import annotations

import importlib.util
import json
import os
import platform
import shutil
import subprocess
from importlib import metadata
from pathlib import Path

from .. import __version__
from ..interpreter import python_for_runs
from .dependencies import ONNXRUNTIME, OPENCV

# Distribution names (any one will do) and what cannot work without; "" where nothing stops.
PACKAGES = (
    (("numpy",), "every command"),
    (("vtk", "slicer-core"), "every command"),
    (OPENCV.distributions, "every command"),
    (ONNXRUNTIME.distributions, "register"),
    (("torch",), "synthesize and train"),
    (("safetensors",), "synthesize and train"),
    (("onnx",), "train"),
    (("scipy",), "train, demo and tracking"),
    (("psutil",), "runs started from 3D Slicer"),
    (("filelock",), "runs started from 3D Slicer"),
    (("matplotlib",), "evaluate"),
    (("jinja2",), "evaluate and demo"),
    (("slicer-core",), ""),
)
BUILT_IN = ("vtk",)  # 3D Slicer's own build is no distribution that pip knows
CPU_FEATURES = ("avx2", "avx512f", "avx512_bf16", "avx512_vnni", "amx_tile", "amx_bf16", "amx_int8")
WEIGHTS_FOLDER = Path(__file__).parents[1] / "appearances" / "weights"
RENDERING_PACKAGES = "libegl1 libgl1-mesa-dri libosmesa6"
RENDERING_TIMEOUT_S = 60

RENDER_SPHERE = """
import vtk
window = vtk.vtkRenderWindow()
window.SetOffScreenRendering(1)
window.SetSize(32, 32)
renderer, source, mapper, actor = vtk.vtkRenderer(), vtk.vtkSphereSource(), vtk.vtkPolyDataMapper(), vtk.vtkActor()
mapper.SetInputConnection(source.GetOutputPort())
actor.SetMapper(mapper)
renderer.AddActor(actor)
window.AddRenderer(renderer)
window.Render()
image = vtk.vtkWindowToImageFilter()
image.SetInput(window)
image.ReadFrontBufferOff()
image.Update()
print("window", window.GetClassName(), "drawn", int(image.GetOutput().GetScalarRange()[1] > 0))
"""
DESCRIBE_DEVICES = """
import json, torch
devices = [torch.cuda.get_device_properties(i) for i in range(torch.cuda.device_count())]
print(json.dumps([{"name": d.name, "memory_gb": round(d.total_memory / 2**30, 1)} for d in devices]))
"""


def make_report() -> dict:
    """All findings; report["problems"] lists what keeps commands from working, each with the way out."""
    packages, problems = _packages()
    rendering = _rendering()
    if not rendering["works"]:
        problems.append(
            f"VTK cannot render with no display ({rendering['error']}); on Debian or Ubuntu: "
            f"sudo apt-get install {RENDERING_PACKAGES}"
        )
    weights = {
        path.name: round(path.stat().st_size / 2**20, 1) for path in sorted(WEIGHTS_FOLDER.glob("*.safetensors"))
    }
    if not weights:
        problems.append(f"{WEIGHTS_FOLDER}: holds no network weights (*.safetensors); install the package again.")
    return {
        "expected_appearances": __version__,
        "python": platform.python_version(),
        "executable": python_for_runs(),
        "system": platform.platform(),
        "packages": packages,
        "cpu": _cpu(),
        "devices": _devices() if packages.get("torch") else [],
        "memory_gb": _memory_gb(),
        "disk_free_gb": round(shutil.disk_usage(Path.cwd()).free / 2**30, 1),
        "rendering": rendering,
        "weights_mb": weights,
        "problems": problems,
    }


def _packages() -> tuple[dict[str, str | None], list[str]]:
    versions, problems = {}, []
    for names, needed_by in PACKAGES:
        found = {}
        for name in names:
            try:
                found[name] = metadata.version(name)
            except metadata.PackageNotFoundError:
                continue
        if not found and names[0] in BUILT_IN and importlib.util.find_spec(names[0]):
            found = {names[0]: "built into this program"}
        versions.update(found or {names[0]: None})
        if needed_by and not found:
            problems.append(f"{names[0]} is not installed, {needed_by} cannot work; run: pip install {names[0]}")
    return versions, problems


def _rendering() -> dict:
    """Draw a sphere in a process of its own: a broken graphics driver ends the process that asks it."""
    code, out, err = _run_python(RENDER_SPHERE)
    words = out.split()
    if code == 0 and words[:1] == ["window"]:
        error = "" if words[3] == "1" else "the image stays empty"
        return {"works": not error, "window": words[1], "error": error}
    reason = (err.strip().splitlines() or [f"the process ended with code {code}"])[-1]
    return {"works": False, "window": None, "error": reason}


def _devices() -> list[dict]:
    code, out, _ = _run_python(DESCRIBE_DEVICES)
    return json.loads(out) if code == 0 else []


def _run_python(source: str) -> tuple[int, str, str]:
    try:
        done = subprocess.run(
            [python_for_runs(), "-c", source],
            capture_output=True,
            text=True,
            errors="replace",
            timeout=RENDERING_TIMEOUT_S,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return -1, "", str(error)
    return done.returncode, done.stdout, done.stderr


def _cpu() -> dict:
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    cpu = {"name": platform.processor() or platform.machine(), "cores": usable, "features": None}
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return cpu
    fields = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in reversed(lines))}
    flags = (fields.get("flags") or fields.get("Features") or "").split()
    cpu["name"] = fields.get("model name", cpu["name"])
    cpu["features"] = [feature for feature in CPU_FEATURES if feature in flags]
    return cpu


def _memory_gb() -> float | None:
    """Memory of the machine; None where the system does not tell."""
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        return round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30, 1)
    if os.name == "nt":
        import ctypes

        kilobytes = ctypes.c_ulonglong()
        if ctypes.windll.kernel32.GetPhysicallyInstalledSystemMemory(ctypes.byref(kilobytes)):
            return round(kilobytes.value / 2**20, 1)
    return None


def report_lines(report: dict) -> list[str]:
    cpu, rendering = report["cpu"], report["rendering"]
    features = "unknown" if cpu["features"] is None else " ".join(cpu["features"]) or "none of note"
    lines = [
        f"ExpectedAppearances {report['expected_appearances']}, Python {report['python']} ({report['executable']})",
        f"System: {report['system']}",
        f"CPU: {cpu['name']}, {cpu['cores']} cores; features: {features}",
        f"Memory: {report['memory_gb'] or '?'} GB; free on this disk: {report['disk_free_gb']} GB",
    ]
    lines += [f"GPU: {device['name']}, {device['memory_gb']} GB" for device in report["devices"]]
    lines += [] if report["devices"] else ["GPU: none that torch can use; the CPU is used"]
    lines += [f"Package {name}: {version or 'not installed'}" for name, version in report["packages"].items()]
    lines.append(
        f"Rendering: {'works, ' + rendering['window'] if rendering['works'] else 'fails, ' + rendering['error']}"
    )
    lines += [f"Weights: {name}, {size_mb} MB" for name, size_mb in report["weights_mb"].items()]
    lines += [f"PROBLEM: {problem}" for problem in report["problems"]] or ["Everything needed is there."]
    return lines
