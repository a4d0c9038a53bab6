"""Shards on a dask.distributed cluster, against the same run here."""

import json
import os
import signal
import threading
import time
from collections import Counter

import pytest
from cases import texture, write_inputs

from ExpectedAppearancesLib.appearances import store
from ExpectedAppearancesLib.appearances.stage import synthesize_case
from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.errors import CancelledError
from ExpectedAppearancesLib.masks.stage import render_case

distributed = pytest.importorskip("distributed")
STYLES = "abcd"


def make_case(folder) -> Case:
    paths = write_inputs(folder)
    case = Case.create(folder / "case", paths["vessels.vtp"], paths["cortex.vtp"], paths["camera.json"])
    render_case(case, lambda *_: None, poses=1)
    return case


@pytest.fixture
def cluster():
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1", memory_limit=0
    ) as cluster:
        yield cluster


def executor_of(cluster) -> str:
    return "dask://" + cluster.scheduler_address.removeprefix("tcp://")


def synthesize(case, executor="local", progress=lambda *_: None):
    textures = [texture(name, (30 * i, 200 - 30 * i, 90)) for i, name in enumerate(STYLES)]
    synthesize_case(case, textures, progress, "surface", size_px=32, seeds=2, iterations=6, executor=executor)


def test_a_worker_killed_half_way_loses_no_image_and_makes_none_twice(cluster, tmp_path, one_thread):
    there, here = make_case(tmp_path / "there"), make_case(tmp_path / "here")
    folder = store.folder_of(there, "surface")
    killed = []

    def kill_a_holder():
        """A worker that holds a claim, and so is in the middle of a shard, once something is finished."""
        deadline = time.monotonic() + 120
        while not killed and time.monotonic() < deadline:
            if any(folder.glob("finished/*.jsonl")):
                for path in folder.glob("claims/*.json"):
                    try:
                        pid = json.loads(path.read_text())["pid"]
                        os.kill(pid, getattr(signal, "SIGKILL", signal.SIGTERM))
                    except (OSError, ValueError):
                        continue
                    killed.append(pid)
                    break
            time.sleep(0.005)

    watcher = threading.Thread(target=kill_a_holder)
    watcher.start()
    synthesize(there, executor_of(cluster))
    watcher.join()
    assert killed and os.getpid() not in killed
    lines = [line for path in folder.glob("finished/*.jsonl") for line in path.read_text().splitlines() if line]
    made = Counter(json.loads(line)["image"] for line in lines)
    assert made == {f"{style}-{seed}.png": 1 for style in STYLES for seed in range(2)}
    assert not list(folder.glob("claims/*"))
    synthesize(here)
    for name in made:
        assert (folder / name).read_bytes() == (store.folder_of(here, "surface") / name).read_bytes()
    assert store.read_index(there, "surface") == store.read_index(here, "surface")


def test_cancelling_stops_the_workers_too(cluster, tmp_path):
    case = make_case(tmp_path)
    folder = store.folder_of(case, "surface")

    def cancel(_fraction, _message):
        if list(folder.glob("claims/*")):
            raise CancelledError("stop")

    with pytest.raises(CancelledError):
        synthesize(case, executor_of(cluster), cancel)
    deadline = time.monotonic() + 60
    while list(folder.glob("claims/*")) and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(1.0)
    assert not list(folder.glob("claims/*"))
    finished = len(list(folder.glob("*-?.png")))
    assert finished < 2 * len(STYLES)
    synthesize(case, executor_of(cluster))
    assert len(store.read_appearances(case, "surface")[1]) == 2 * len(STYLES)


def test_a_cluster_whose_workers_are_all_gone_is_told(tmp_path):
    """It is waited for a worker, as long as it takes; who watches must know that."""

    def told(_fraction, message):
        if "no worker" in message:
            raise CancelledError(message)

    nobody = distributed.LocalCluster(n_workers=0, processes=True, dashboard_address=None, host="127.0.0.1")
    with nobody, pytest.raises(CancelledError, match="start `dask worker`"):
        synthesize(make_case(tmp_path), executor_of(nobody), told)


@pytest.fixture
def one_thread():
    """As the workers have: in fp32 roundings may depend on it."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
