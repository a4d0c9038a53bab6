"""What the driver prints about graphics cards, and the run that shall use one."""

from __future__ import annotations

import pytest

from ExpectedAppearancesLib.gpus import Gpu, device_arguments, parse_gpus

PRINTED = """0, NVIDIA RTX A4000, 16376
1, NVIDIA H100, 80GB HBM3, 81559
2, Broken, [N/A]
No devices were found
"""


def test_cards_are_read_with_their_memory():
    first, second = parse_gpus(PRINTED)
    assert first == Gpu(0, "NVIDIA RTX A4000", 16376 / 1024)
    assert (second.name, second.key) == ("NVIDIA H100, 80GB HBM3", "cuda:1")
    assert parse_gpus("") == parse_gpus("NVIDIA-SMI has failed because it couldn't communicate") == []


@pytest.mark.parametrize(
    ("device", "option", "visible"), [("auto", "auto", None), ("cpu", "cpu", None), ("cuda:1", "cuda", "1")]
)
def test_a_run_sees_only_its_card(device, option, visible):
    options, environment = device_arguments(device)
    assert options == ["--device", option]
    assert environment.get("CUDA_VISIBLE_DEVICES") == visible
