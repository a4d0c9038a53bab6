"""Measure stages beside plain references, in one run, into build/benchmark.json: ratios hold where times do not."""

from __future__ import annotations

import argparse
import importlib
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

# Modules of this folder with measure(inputs_folder) -> dict of keys of benchmark.json. Each runs in a process of its
# own: VTK and torch's threads do not meet, and memory is its own.
STAGES = ("masks", "synthesis", "synthesis_scaling", "surface_views", "registration", "live_update")
LIMIT_S = 900


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--inputs", type=Path, metavar="DIR", help="vessels.vtp, cortex.vtp, camera.json, textures/; else generated"
    )
    parser.add_argument("--out", type=Path, default=Path("build/benchmark.json"))
    parser.add_argument("--only", nargs="+", choices=STAGES, default=STAGES, metavar="STAGE", help="not all stages")
    parser.add_argument("--measure", choices=STAGES, help=argparse.SUPPRESS)  # in the stage's own process
    args = parser.parse_args()
    if args.measure:
        result = importlib.import_module(args.measure).measure(args.inputs)
        args.out.write_text(json.dumps(result), encoding="utf-8")
        return 0
    failed = []
    result: dict = {}
    with tempfile.TemporaryDirectory() as folder:
        inputs = args.inputs or _generated(Path(folder) / "inputs")
        for stage in args.only:
            begin, part = time.monotonic(), Path(folder) / f"{stage}.json"
            command = [sys.executable, __file__, "--measure", stage, "--inputs", str(inputs), "--out", str(part)]
            try:
                ended = subprocess.run(command, timeout=LIMIT_S).returncode
            except subprocess.TimeoutExpired:
                ended = f"more than {LIMIT_S} s"
            if ended == 0:
                _merge(result, json.loads(part.read_text(encoding="utf-8")))
            else:
                failed.append(stage)
            print(f"{stage}: {time.monotonic() - begin:.0f} s" + (f", FAILED ({ended})" if ended else ""), flush=True)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=1))
    return 1 if failed else 0


def _merge(into: dict, found: dict) -> None:
    for key, value in found.items():
        if isinstance(value, dict) and isinstance(into.get(key), dict):
            into[key].update(value)
        else:
            into[key] = value


def _generated(folder: Path) -> Path:
    from ExpectedAppearancesLib.case.meshes import write_vtp
    from ExpectedAppearancesLib.demo.vessel_tree import demo_camera, generate_case_meshes
    from ExpectedAppearancesLib.geometry.camera import write_camera

    folder.mkdir(parents=True)
    for name, mesh in zip(("vessels", "cortex"), generate_case_meshes(0), strict=True):
        write_vtp(folder / f"{name}.vtp", mesh)
    write_camera(folder / "camera.json", demo_camera())
    return folder


if __name__ == "__main__":
    sys.exit(main())
