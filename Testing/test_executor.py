"""Jobs, such as the trainings of a study, on the workers of a dask.distributed cluster."""

from __future__ import annotations

from pathlib import Path

import pytest
from cases import wait_until

from ExpectedAppearancesLib import executor
from ExpectedAppearancesLib.errors import CancelledError, InputError

ON_THIS_COMPUTER = {"processes": False, "protocol": "tcp", "dashboard_address": "127.0.0.1:0", "host": "127.0.0.1"}


def note_work(job, progress, stopped):
    """A job for a cluster: leaves a file; 'bad' fails, 'long' waits to be stopped."""
    folder, name = Path(job[0]), job[1]
    if name == "bad":
        wait_until(lambda: (folder / "long").exists(), 60)
        raise InputError("bad: a job that fails")
    (folder / name).write_text("")
    if name == "long":
        wait_until(stopped, 60)
        (folder / "stopped").write_text("")
        raise CancelledError("stopped")


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("dask.distributed", reason="dask.distributed is not installed")
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, **ON_THIS_COMPUTER) as cluster:
        yield "dask://" + cluster.scheduler_address.removeprefix("tcp://")


def test_jobs_run_on_a_cluster(cluster, tmp_path):
    executor.check_executor(cluster)
    heard = []
    executor.run_jobs([(str(tmp_path), n) for n in "xyz"], note_work, cluster, lambda f, _text: heard.append(f))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x", "y", "z"]
    assert [fraction for fraction in heard if fraction] == pytest.approx([1 / 3, 2 / 3, 1])


def test_a_study_whose_cluster_has_no_worker_says_so(tmp_path, monkeypatch):
    """It waits for one as long as it takes, as after the last one was killed."""
    distributed = pytest.importorskip("dask.distributed", reason="dask.distributed is not installed")
    monkeypatch.setattr(executor, "ASK_EVERY_S", 0.1)
    monkeypatch.setattr(executor, "STOP_S", 0.1)

    def told(_fraction, message):
        if "no worker" in message:
            raise CancelledError(message)

    nobody = distributed.LocalCluster(n_workers=0, **ON_THIS_COMPUTER)
    with nobody, pytest.raises(CancelledError, match="start `dask worker`"):
        address = "dask://" + nobody.scheduler_address.removeprefix("tcp://")
        executor.run_jobs([(str(tmp_path), "x")], note_work, address, told)


def test_a_failing_job_of_a_cluster_stops_the_others(cluster, tmp_path):
    with pytest.raises(InputError, match="bad: a job that fails"):
        executor.run_jobs([(str(tmp_path), n) for n in ("long", "bad")], note_work, cluster, lambda *_: None)
    assert (tmp_path / "stopped").exists()


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch):
    pytest.importorskip("dask.distributed", reason="dask.distributed is not installed")
    monkeypatch.setattr(executor, "CONNECT_S", 0.5)
    with pytest.raises(InputError, match=r"no dask scheduler answers at tcp://127\.0\.0\.1:9"):
        executor.connect("dask://127.0.0.1:9")


@pytest.mark.parametrize("name", ["slurm", "dask://", "dask://host", "dask://host:port"])
def test_unknown_executors_are_refused(name):
    with pytest.raises(InputError, match="dask://HOST:PORT"):
        executor.check_executor(name)
