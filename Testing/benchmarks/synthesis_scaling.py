"""How the cost of synthesis grows with the number of images and textures: three sizes, a process each."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SIZES = ((12, 2), (24, 4), (48, 8))  # images, textures
SIZE_PX, ITERATIONS = 64, 8
ROUNDS = 2


def measure(inputs: Path) -> dict:
    """{"synthesis": {"scaling": [{"images", "textures", "cpu_seconds_per_image", "peak_memory_mb"}, ...]}}.

    Processor time, and the least of a few runs: what others do on the computer moves the wall clock far more.
    """
    found = []
    for images, textures in SIZES:
        command = [sys.executable, __file__, str(inputs), str(images), str(textures)]
        runs = [subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(ROUNDS)]
        found.append(min(map(json.loads, runs), key=lambda run: run["cpu_seconds_per_image"]))
    return {"synthesis": {"scaling": found}}


def _run(inputs: Path, images: int, count: int) -> dict:
    import numpy as np
    import psutil

    from ExpectedAppearancesLib.appearances.stage import synthesize_case
    from ExpectedAppearancesLib.case.case import Case
    from ExpectedAppearancesLib.masks.stage import render_case
    from ExpectedAppearancesLib.textures.library import Texture, read_library, shipped_textures_folder

    first = read_library(shipped_textures_folder())[0]
    # What a texture shows does not change what it costs.
    textures = [Texture(f"t{i}", np.roll(first.image, 16 * i, axis=2 - i % 2), first.labels) for i in range(count)]
    peak = 0

    def progress(_fraction, _message):
        nonlocal peak
        peak = max(peak, psutil.Process().memory_info().rss)

    with tempfile.TemporaryDirectory() as folder:
        case = Case.create(Path(folder) / "case", inputs / "vessels.vtp", inputs / "cortex.vtp", inputs / "camera.json")
        render_case(case, lambda *_: None, poses=images)
        arguments = {"method": "image", "size_px": SIZE_PX, "iterations": ITERATIONS}
        synthesize_case(case, textures[:1], lambda *_: None, "surface", size_px=SIZE_PX, iterations=1)  # loads all
        begin = time.process_time()
        synthesize_case(case, textures, progress, **arguments)
        seconds = time.process_time() - begin
    return {
        "images": images,
        "textures": count,
        "cpu_seconds_per_image": round(seconds / images, 3),
        "peak_memory_mb": round(peak / 2**20),
    }


if __name__ == "__main__":
    print(json.dumps(_run(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))))
