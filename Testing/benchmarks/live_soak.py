"""Stream for a long time: memory stays flat, nodes stay as many, and no frame is shown with another frame's pose.

python Testing/benchmarks/live_soak.py --frames 20000                # as fast as it goes
python Testing/benchmarks/live_soak.py --minutes 30 --rate 10        # as a microscope would, on a small share of a core
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
SAMPLE_EVERY = 250  # frames between two readings of memory and nodes
WARM_UP = 0.1  # share of the readings before those that count


def soak(frames: int, minutes: float | None = None, rate_hz: float = 0.0) -> dict:
    """Stream the phantom at small size, `rate_hz` frames a second (0: as fast as it goes), and count wrong frames."""
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
        views = LiveViews(view.logic, lambda: (through.node, through.camera_node, (80, 60)))
        controller = LiveController(scene, views)
        source = scene.AddNewNodeByClass("vtkMRMLVectorVolumeNode", "Stream")
        controller.start(Choice(folder + "/case", SourceKind.NODE, node_name=source.GetID(), stale_s=60))
        while controller.loading:
            controller.tick(0.05)
        memory_mb, nodes, wrong, shown, longest_ms = [], [], 0, 0, 0.0
        begin, cpu_s = time.monotonic(), time.process_time()
        number = 0
        while number < frames if minutes is None else time.monotonic() - begin < 60 * minutes:
            if rate_hz > 0:
                time.sleep(max(0.0, begin + number / rate_hz - time.monotonic()))
            is_covered = number % COVERED_EVERY == COVERED_EVERY - 1
            image = covered if is_covered else images[number % POSES]
            controller._session.push(LiveFrame(image, time.monotonic(), number))
            status = controller.tick(5.0)
            if status.new:
                shown += 1
                wrong += int(_is_wrong(controller, status, poses, images, covered))
                longest_ms = max(longest_ms, controller.shown_in_ms)
            if number % 20 == 0:
                view.draw_layers()
                for each in (view, through):
                    each.window.Render()
            number += 1
            if number % SAMPLE_EVERY == 0:
                gc.collect()
                memory_mb.append(_resident_mb())
                nodes.append(scene.GetNumberOfNodes())
                print(number, f"{memory_mb[-1]:.1f} MB", nodes[-1], "nodes", file=sys.stderr, flush=True)
        dropped = status.dropped
        controller.close()
    kept = memory_mb[max(1, int(WARM_UP * len(memory_mb))) :] or [float("nan")]
    return {
        "frames": number,
        "shown": shown,
        "wrong": wrong,
        "dropped": dropped,
        "minutes": round((time.monotonic() - begin) / 60, 1),
        "cpu_share": round((time.process_time() - cpu_s) / (time.monotonic() - begin), 3),
        "memory_mb": [round(kept[0], 1), round(kept[-1], 1)],
        "growth_percent": round(100 * (max(kept) / kept[0] - 1), 2),
        "nodes": sorted(set(nodes)),
        "longest_update_ms": round(longest_ms, 1),
    }


def _is_wrong(controller, status, poses, images, covered) -> bool:
    """Whether pixels, pose, transform and visibility on the screen belong to different frames."""
    from ExpectedAppearancesLib.mrml.live_stream import pixels_of
    from ExpectedAppearancesLib.mrml.scene import matrix_of

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
    parser.add_argument("--rate", type=float, default=0.0, metavar="HZ", help="frames a second; 0: as fast as it goes")
    args = parser.parse_args()
    result = soak(args.frames, args.minutes, args.rate)
    print(json.dumps(result, indent=1))
    whole = result["shown"] > 0 and not result["wrong"]
    sys.exit(0 if whole and result["growth_percent"] < 5 and len(result["nodes"]) == 1 else 1)


if __name__ == "__main__":
    main()
