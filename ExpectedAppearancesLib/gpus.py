"""Graphics cards as the driver lists them, and how a run is given one of them; found without loading torch."""

from __future__ import annotations

from dataclasses import dataclass

PROGRAM = "nvidia-smi"
QUERY = ("--query-gpu=index,name,memory.total", "--format=csv,noheader,nounits")


@dataclass(frozen=True)
class Gpu:
    """index: as the driver counts. memory_gb: all of it, used or not."""

    index: int
    name: str
    memory_gb: float

    @property
    def key(self) -> str:
        """What `device_arguments` takes."""
        return f"cuda:{self.index}"


def parse_gpus(output: str) -> list[Gpu]:
    """From what PROGRAM prints for QUERY, lines such as "0, NVIDIA RTX A4000, 16376" (MiB); others are left out."""
    gpus = []
    for line in output.splitlines():
        parts = [part.strip() for part in line.split(",")]
        if len(parts) >= 3 and parts[0].isdigit() and parts[-1].replace(".", "", 1).isdigit():
            gpus.append(Gpu(int(parts[0]), ", ".join(parts[1:-1]), float(parts[-1]) / 1024))
    return gpus


def device_arguments(device: str) -> tuple[list[str], dict[str, str]]:
    """Options and environment of a run for 'auto', 'cpu' or 'cuda:N'. A run sees only the card that it shall use."""
    kind, _, index = device.partition(":")
    if kind == "cuda" and index:
        # By the bus, as the driver counts; CUDA's own order puts the fastest first.
        return ["--device", "cuda"], {"CUDA_DEVICE_ORDER": "PCI_BUS_ID", "CUDA_VISIBLE_DEVICES": index}
    return ["--device", kind], {}
