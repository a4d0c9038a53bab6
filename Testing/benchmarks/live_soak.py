"""Stream for a long time: memory stays flat, nodes stay as many, and no frame is shown with another frame's pose.

python Testing/benchmarks/live_soak.py --frames 20000     # or --minutes 30
"""

from __future__ import annotations

import argparse
import gc
import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

TESTING = Path(__file__).resolve().parents[1]
POSES = 24
COVERED_EVERY = 40
WARM_UP = 0.1  # share of the frames before memory is first read


def soak(frames: int, minutes: float | None = None) -> dict:
    """Stream the phantom at small size as fast as it goes; raises RuntimeError for a frame with a wrong pose."""
    sys.path.insert(0, str(TESTING))
    from mrml_views import SliceView, ThreeDView, new_application

    from ExpectedAppearancesLib.demo.phantom import CAMERA, PhantomPainter, covered_frame, make_phantom
    from ExpectedAppearancesLib.live.choice import Choice, SourceKind
    from ExpectedAppearancesLib.live.frames import LiveFrame
    from ExpectedAppearancesLib.mrml.live_controller import LiveController
    from ExpectedAppearancesLib.mrml.live_views import LiveViews

    small = CAMERA.resized(160, 120)
    with tempfile.TemporaryDirectory() as folder:
        phantom = make_phantom(Path(folder) / "case")
        poses = [phantom.pose(i / POSES) for i in range(POSES)]
        with PhantomPainter(phantom, small) as painter:
            images = [painter.paint(pose) for pose in poses]
        covered = covered_frame(0, small)
        scene, application = new_application()
        view = SliceView(scene, application, "Microscope", (160, 120))
        through = ThreeDView(scene, application, "MicroscopeCamera", (80, 60))
        views = LiveViews(view.node, view.composite, lambda: (through.node, through.camera_node, (80, 60)))
        controller = LiveController(scene, views)
        source = scene.AddNewNodeByClass("vtkMRMLVectorVolumeNode", "Stream")
        controller.start(Choice(folder + "/case", SourceKind.NODE, node_name=source.GetID(), stale_s=60))
        memory_mb, nodes, wrong, shown, longest_ms = [], [], 0, 0, 0.0
        begin = time.monotonic()
        number = 0
        while number < frames if minutes is None else time.monotonic() - begin < 60 * minutes:
            is_covered = number % COVERED_EVERY == COVERED_EVERY - 1
            image = covered if is_covered else images[number % POSES]
            controller._session.push(LiveFrame(image, time.monotonic(), number))
            status = controller.tick(5.0)
            if status.new:
                shown += 1
                wrong += _is_wrong(controller, status, poses, images, covered)
                longest_ms = max(longest_ms, controller.shown_in_ms)
            if number % 20 == 0:
                view.draw_layers()
                for each in (view, through):
                    each.window.Render()
            number += 1
            if number % 500 == 0:
                gc.collect()
                memory_mb.append(_resident_mb())
                nodes.append(scene.GetNumberOfNodes())
                print(number, f"{memory_mb[-1]:.1f} MB", nodes[-1], "nodes", file=sys.stderr, flush=True)
        controller.close()
    kept = memory_mb[max(1, int(WARM_UP * len(memory_mb))) :] or [float("nan")]
    return {
        "frames": number,
        "shown": shown,
        "wrong": wrong,
        "minutes": round((time.monotonic() - begin) / 60, 1),
        "memory_mb": [round(kept[0], 1), round(kept[-1], 1)],
        "growth_percent": round(100 * (max(kept) / kept[0] - 1), 2),
        "nodes": sorted(set(nodes)),
        "longest_update_ms": round(longest_ms, 1),
    }


def _is_wrong(controller, status, poses, images, covered) -> bool:
    """Whether pixels, pose, transform and visibility on the screen belong to different frames."""
    from ExpectedAppearancesLib.mrml.live_scene import matrix_of
    from ExpectedAppearancesLib.mrml.live_stream import pixels_of

    pixels = pixels_of(controller.live.frame.GetImageData())
    number = status.result.frame.number
    is_covered = number % COVERED_EVERY == COVERED_EVERY - 1
    if not np.array_equal(pixels, covered if is_covered else images[number % POSES]):
        return True
    if is_covered:
        return controller.live.overlay_visible
    expected = np.diag([-1.0, -1.0, 1.0, 1.0]) @ np.linalg.inv(poses[number % POSES])
    apart_mm = np.abs(matrix_of(controller.live.transform)[:3, 3] - expected[:3, 3]).max()
    return not controller.live.overlay_visible or apart_mm > 2.0


def _resident_mb() -> float:
    import os

    with open("/proc/self/statm", encoding="ascii") as stream:
        return int(stream.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=20_000)
    parser.add_argument("--minutes", type=float, help="stream for so long instead")
    args = parser.parse_args()
    result = soak(args.frames, args.minutes)
    print(json.dumps(result, indent=1))
    sys.exit(0 if not result["wrong"] and result["growth_percent"] < 5 and len(result["nodes"]) == 1 else 1)


if __name__ == "__main__":
    main()
