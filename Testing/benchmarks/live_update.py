"""From a new 1920 x 1080 frame to its overlay on the screen, beside a loop that loads and makes everything anew.

The frames are a phantom's, whose poses are known; its model costs what the quick preset's does, since it is that
network, untrained, with the phantom's few operations added to it. Both are checked to give the right pose.

Times by the clock hold on a quiet machine only; processor time of the thread that registers and of the GUI's thread,
which work one after the other, is given beside them.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

TESTING = Path(__file__).resolve().parents[1]
FRAME = (1920, 1080)
VIEW = (640, 480)
FRAMES = 20
ROUNDS = 2
REFERENCE_FRAMES = 4
ADD_LIMIT_MM = 1.0


@dataclass
class Measured:
    """ms, one number for each frame but the first two of a session; gui_calls_ms and gui_calls_cpu_ms: one for each
    call on the GUI's thread that a frame makes, those of the first frames too: taking it in, and drawing.
    start_...: from Start until the session runs, and each call on the GUI's thread that it takes."""

    update_ms: list = field(default_factory=list)
    worker_cpu_ms: list = field(default_factory=list)
    gui_cpu_ms: list = field(default_factory=list)
    gui_calls_ms: list = field(default_factory=list)
    gui_calls_cpu_ms: list = field(default_factory=list)
    start_ms: list = field(default_factory=list)
    start_calls_ms: list = field(default_factory=list)
    start_calls_cpu_ms: list = field(default_factory=list)


def measure(inputs_folder: Path | None = None) -> dict:
    """live_update: {median_ms, ratio, ...}, see Measured. inputs_folder: of vessels.vtp, cortex.vtp; else generated."""
    sys.path.insert(0, str(TESTING))
    from mrml_views import SliceView, new_application

    from ExpectedAppearancesLib.demo.phantom import PhantomPainter
    from ExpectedAppearancesLib.mrml.live_controller import LiveController
    from ExpectedAppearancesLib.mrml.live_views import LiveViews

    with tempfile.TemporaryDirectory() as folder:
        phantom = phantom_case(Path(folder), inputs_folder)
        poses = [phantom.pose(i / FRAMES) for i in range(FRAMES)]
        with PhantomPainter(phantom) as painter:
            frames = [painter.paint(pose) for pose in poses]
        scene, application = new_application()
        view = SliceView(scene, application, "Microscope", VIEW)
        controller = LiveController(scene, LiveViews(view.logic, lambda: None))
        measured, plain_ms = Measured(), []
        _run_live(controller, view, phantom, poses, frames, Measured())
        for _ in range(ROUNDS):
            _run_live(controller, view, phantom, poses, frames, measured)
            _run_plain(scene, view, phantom, poses[:REFERENCE_FRAMES], frames, plain_ms)
        controller.close()
    result = {
        "median_ms": _ms(np.median(measured.update_ms)),
        "p95_ms": _ms(np.percentile(measured.update_ms, 95)),
        "worker_cpu_median_ms": _ms(np.median(measured.worker_cpu_ms)),
        "gui_cpu_median_ms": _ms(np.median(measured.gui_cpu_ms)),
        "gui_call_median_ms": _ms(np.median(measured.gui_calls_ms)),
        "gui_call_longest_ms": _ms(np.max(measured.gui_calls_ms)),
        "gui_call_cpu_longest_ms": _ms(np.max(measured.gui_calls_cpu_ms)),
        "start_ms": _ms(np.median(measured.start_ms)),
        "start_call_longest_ms": _ms(np.max(measured.start_calls_ms)),
        "start_call_cpu_longest_ms": _ms(np.max(measured.start_calls_cpu_ms)),
        "reference_median_ms": _ms(np.median(plain_ms)),
        "ratio": round(float(np.median(plain_ms) / np.median(measured.update_ms)), 2),
        "frame_px": list(FRAME),
        "view_px": list(VIEW),
    }
    return {"live_update": result}


def _ms(value) -> float:
    return round(float(value), 1)


def phantom_case(folder: Path, inputs_folder: Path | None, size_px: int = 128):
    """The phantom of a case whose frames are FRAME, with a network of that input size at the quick preset's cost."""
    from ExpectedAppearancesLib.case.case import Case
    from ExpectedAppearancesLib.case.meshes import write_vtp
    from ExpectedAppearancesLib.demo.phantom import as_phantom
    from ExpectedAppearancesLib.demo.vessel_tree import generate_case_meshes
    from ExpectedAppearancesLib.geometry.camera import Camera

    if inputs_folder is None:
        inputs_folder = folder
        for name, mesh in zip(("vessels", "cortex"), generate_case_meshes(0)):
            write_vtp(folder / f"{name}.vtp", mesh)
    camera = Camera(*FRAME, 4300.0, 4300.0, 975.0, 520.0)
    paths = [Path(inputs_folder) / f"{name}.vtp" for name in ("vessels", "cortex")]
    case = Case.create(folder / "case", *paths, camera)
    phantom = as_phantom(case)
    # In a process of its own: VTK and torch's exporter do not go together.
    command = [sys.executable, __file__, "--write-network", str(case.model_folder), "--size", str(size_px)]
    subprocess.run(command, check=True)
    return phantom


def write_network(folder: Path, size_px: int) -> None:
    """The quick preset's network, untrained, plus the phantom's operations: the phantom's output at the real cost.

    It replaces the phantom's in `folder`, a case's model folder.
    """
    import torch

    from ExpectedAppearancesLib import files
    from ExpectedAppearancesLib.demo.phantom import GAIN, MIDDLE
    from ExpectedAppearancesLib.model.export import META_NAME, export_model
    from ExpectedAppearancesLib.model.networks import DenseSurfaceNet
    from ExpectedAppearancesLib.model.presets import PRESETS

    class Both(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.network = DenseSurfaceNet(PRESETS["quick"].width)

        def forward(self, image):
            coordinates = (torch.nn.functional.avg_pool2d(image, 2) - MIDDLE) / GAIN
            darkest = torch.nn.functional.max_pool2d(-image, 6, 2, 2).amax(dim=1, keepdim=True)
            surface = -100 * (darkest + 0.08)
            sigma = torch.zeros_like(surface) + float(np.log(0.01))
            read = torch.cat([coordinates, sigma, surface, torch.zeros_like(surface) - 1], dim=1)
            return read + 1e-12 * self.network(image)[:, :6]

    meta = files.read_json(folder / META_NAME, "model") | {"size_px": size_px}
    del meta["format_version"], meta["model_sha256"]
    export_model(Both(), replace(PRESETS["quick"], size_px=size_px), meta, folder)


def _run_live(controller, view, phantom, poses, frames, measured: Measured) -> None:
    from ExpectedAppearancesLib.live.choice import Choice, SourceKind
    from ExpectedAppearancesLib.live.frames import LiveFrame

    scene = controller._scene
    source = scene.AddNewNodeByClass("vtkMRMLVectorVolumeNode", "Stream")
    choice = Choice(str(phantom.case.folder), SourceKind.NODE, node_name=source.GetID(), stale_s=10)
    begin = time.perf_counter()
    _measure_call(measured, lambda: controller.start(choice))
    while controller.loading:
        time.sleep(0.01)  # the panel's ticks wait for the thread for a while
        _measure_call(measured, controller.tick)
    measured.start_ms.append((time.perf_counter() - begin) * 1000)
    worker_ms = _thread_clock("ExpectedAppearances registration")
    for i, (pose, frame) in enumerate(zip(poses, frames)):
        begin, worker_before, gui_before = time.perf_counter(), worker_ms(), time.thread_time()
        controller._session.push(LiveFrame(frame, time.monotonic(), i))
        status = controller.tick(0.5)  # an idle GUI thread: woken by the result
        while not status.new:
            status = controller.tick(0.5)
        if i == 0:
            view.draw_layers()
        drawn, drawn_cpu = time.perf_counter(), time.thread_time()
        view.window.Render()
        end, end_cpu = time.perf_counter(), time.thread_time()
        _check(phantom, pose, status.result.prediction.camera_from_world)
        measured.gui_calls_ms += [controller.shown_in_ms, (end - drawn) * 1000]
        measured.gui_calls_cpu_ms += [(drawn_cpu - gui_before) * 1000, (end_cpu - drawn_cpu) * 1000]
        if i > 1:
            measured.update_ms.append((end - begin) * 1000)
            measured.worker_cpu_ms.append(worker_ms() - worker_before)
            measured.gui_cpu_ms.append((end_cpu - gui_before) * 1000)
    controller.stop()
    scene.RemoveNode(source)


def _measure_call(measured: Measured, call) -> None:
    begin, begin_cpu = time.perf_counter(), time.thread_time()
    call()
    measured.start_calls_ms.append((time.perf_counter() - begin) * 1000)
    measured.start_calls_cpu_ms.append((time.thread_time() - begin_cpu) * 1000)


def _thread_clock(name: str):
    """Callable that gives the processor time, ms, of the running thread of that name; 0 where no such clock exists."""
    (ident,) = (thread.ident for thread in threading.enumerate() if thread.name == name)
    if not hasattr(time, "pthread_getcpuclockid"):
        return lambda: 0.0
    clock = time.pthread_getcpuclockid(ident)
    return lambda: time.clock_gettime(clock) * 1000


def _run_plain(scene, view, phantom, poses, frames, update_ms: list) -> None:
    """What one writes first: for each frame the model is loaded, and the nodes are made."""
    from ExpectedAppearancesLib.case.case import Case
    from ExpectedAppearancesLib.geometry.pose import camera_to_ras
    from ExpectedAppearancesLib.geometry.silhouette import Silhouette
    from ExpectedAppearancesLib.mrml import live_views
    from ExpectedAppearancesLib.mrml import scene as scenes
    from ExpectedAppearancesLib.registration.predictor import Predictor

    for pose, frame in zip(poses, frames):
        begin = time.perf_counter()
        case = Case.open(phantom.case.folder)
        prediction = Predictor(case.model_folder).predict(frame)
        predicted = prediction.camera_from_world
        before = set(_nodes(scene))
        plane_mm = scenes.plane_depth_mm(case.vessels, predicted)
        to_ras = camera_to_ras(predicted, case.space)
        transform = scenes.add_camera_transform(scene, to_ras)
        volume = scenes.add_frame(scene, frame, case.camera, plane_mm, transform)
        silhouette = Silhouette(case.vessels.vertices_mm, case.vessels.triangles)
        scenes.add_outline(scene, silhouette, predicted, plane_mm, transform)
        live_views.align_slice(view.node, case.camera, to_ras, plane_mm)
        live_views.fit_slice(view.node, case.camera, plane_mm)
        live_views.show_layers(view.composite, volume, None, 0)
        view.window.Render()
        update_ms.append((time.perf_counter() - begin) * 1000)
        _check(phantom, pose, predicted)
        for node in _nodes(scene):
            if node not in before and scene.IsNodePresent(node):
                scene.RemoveNode(node)


def _nodes(scene) -> list:
    return [scene.GetNthNode(i) for i in range(scene.GetNumberOfNodes())]


def _check(phantom, true: np.ndarray, predicted: np.ndarray | None) -> None:
    from ExpectedAppearancesLib.geometry.displacement import add_mm

    if predicted is None or add_mm(phantom.case.vessels.vertices_mm, true[None], predicted[None])[0] > ADD_LIMIT_MM:
        raise RuntimeError("the phantom's pose is wrong; what is measured is not a registration")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=Path, metavar="DIR", help="vessels.vtp and cortex.vtp; else generated")
    parser.add_argument("--write-network", type=Path, metavar="DIR", help=argparse.SUPPRESS)
    parser.add_argument("--size", type=int, default=128, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.write_network:
        write_network(args.write_network, args.size)
        return
    print(json.dumps(measure(args.inputs), indent=1))


if __name__ == "__main__":
    main()
