"""From a frame to its pose on the CPU: the whole of it, and the network alone, for networks of 128 and 256 px.

The network is the quick preset's, untrained, with the phantom's operations added, so that the poses are true ones.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
from live_update import ADD_LIMIT_MM, phantom_case

FRAMES = 24
ROUNDS = 3
SIZES_PX = (128, 256)  # of the network's input; of the quick preset 128


def measure(inputs_folder: Path | None = None) -> dict:
    """registration: for each size {median_ms, p95_ms, fastest_ms, cpu_ms, network_...}; frames of 256 px, 2 threads."""
    return {"registration": {f"{size}_px": _measure(size, inputs_folder) for size in SIZES_PX}}


def _measure(size_px: int, inputs_folder: Path | None) -> dict:
    from ExpectedAppearancesLib.demo.phantom import PhantomPainter
    from ExpectedAppearancesLib.geometry.displacement import add_mm
    from ExpectedAppearancesLib.registration.predictor import Predictor

    with tempfile.TemporaryDirectory() as folder:
        phantom = phantom_case(Path(folder), inputs_folder, size_px)
        predictor = Predictor(phantom.case.model_folder)
        camera = predictor.camera.resized(256, 256)
        poses = [phantom.pose(i / FRAMES) for i in range(FRAMES)]
        with PhantomPainter(phantom, camera) as painter:
            frames = [painter.paint(pose) for pose in poses]
        image = np.zeros((1, 3, size_px, size_px), np.float32)
        whole, whole_cpu, network, network_cpu = [], [], [], []
        for i in range(FRAMES * ROUNDS):
            prediction = _timed(lambda n=i % FRAMES: predictor.predict(frames[n], camera), whole, whole_cpu)
            _timed(lambda: predictor._session.run(None, {"image": image}), network, network_cpu)
            found = prediction.camera_from_world
            true = poses[i % FRAMES]
            if found is None or add_mm(phantom.case.vessels.vertices_mm, true[None], found[None])[0] > ADD_LIMIT_MM:
                raise RuntimeError("the phantom's pose is wrong; what is measured is not a registration")
    return {
        "median_ms": _ms(np.median(whole)),
        "p95_ms": _ms(np.percentile(whole, 95)),
        "fastest_ms": _ms(np.min(whole)),
        "cpu_ms": _ms(np.median(whole_cpu)),
        "network_median_ms": _ms(np.median(network)),
        "network_fastest_ms": _ms(np.min(network)),
        "network_cpu_ms": _ms(np.median(network_cpu)),
    }


def _timed(work, seconds: list, cpu_seconds: list):
    """What `work` gives; its time by the clock and of the process's processors are appended."""
    begin, cpu = time.perf_counter(), time.process_time()
    result = work()
    seconds.append(time.perf_counter() - begin)
    cpu_seconds.append(time.process_time() - cpu)
    return result


def _ms(seconds: float) -> float:
    return round(1000 * float(seconds), 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=Path, metavar="DIR", help="vessels.vtp and cortex.vtp; else generated")
    print(json.dumps(measure(parser.parse_args().inputs), indent=1))


if __name__ == "__main__":
    main()
