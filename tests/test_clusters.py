"""A tiny suite on a Dask and on a Ray cluster, a worker of which is killed, ends as on one machine."""

import contextlib
import json
import os
import signal
from collections.abc import Iterator

import joblib
import pytest

from lerobot_swr.reproduction import execution
from lerobot_swr.reproduction.cells import Cell, Labels, Store
from lerobot_swr.reproduction.demonstrations import Demonstrations
from lerobot_swr.reproduction.execution import reproduce, run_chain
from lerobot_swr.reproduction.settings import ReproductionSettings

WORKERS = 2


@contextlib.contextmanager
def dask_cluster() -> Iterator[str]:
    """A Dask cluster of processes, active in joblib; yields the backend's name."""
    distributed = pytest.importorskip("distributed", reason="needs the extra [dask]")
    with (
        distributed.LocalCluster(
            n_workers=WORKERS, threads_per_worker=1, processes=True, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster),
    ):
        yield "dask"


@contextlib.contextmanager
def ray_cluster() -> Iterator[str]:
    """A Ray cluster, active in joblib; yields the backend's name."""
    ray = pytest.importorskip("ray", reason="needs the extra [ray]")
    from ray.util.joblib import register_ray

    os.environ.setdefault("RAY_raylet_start_wait_time_s", "300")  # on a busy machine
    ray.init(num_cpus=WORKERS, include_dashboard=False, log_to_driver=False)
    register_ray()
    try:
        yield "ray"
    finally:
        ray.shutdown()


def tiny_suite(small_maze, output_dir) -> ReproductionSettings:
    """Two trainings of two seeds, and what is measured on them."""
    return ReproductionSettings(
        suite="table1",
        datasets=[small_maze.name],
        dataset_dir=small_maze.parent,
        policies=["bc", "zbc"],
        policy_options={"backbone.hidden_dim": 16, "backbone.num_hidden": 2},
        steps=20,
        seeds=2,
        n_rollouts=6,
        output_dir=output_dir,
        jobs=None,
    )


def results_of(settings: ReproductionSettings) -> list:
    """Key and result of every cell."""
    stored = [json.loads(path.read_text()) for path in sorted((settings.output_dir / "results").iterdir())]
    return [(one["key"], one["result"]) for one in stored]


@pytest.fixture(scope="module")
def local(small_maze, tmp_path_factory):
    """Results of the suite on this machine alone."""
    settings = tiny_suite(small_maze, tmp_path_factory.mktemp("local"))
    with joblib.parallel_config(n_jobs=1):
        assert reproduce(settings) == []
    return results_of(settings)


@pytest.mark.slow
@pytest.mark.parametrize("cluster", [dask_cluster, ray_cluster])
def test_cells_of_a_killed_worker_are_computed_by_another(tmp_path, monkeypatch, cluster):
    """Four cells without any work, one of which kills its worker once: all are done."""
    store = Store(tmp_path / "store")
    cells = [Cell("similarity", Labels("data", "", name), {"name": name}) for name in "abcd"]
    killed = tmp_path / "killed"

    def run_in_worker(chain, *args):
        def compute(one, *_):
            if one.labels.condition == "b" and not killed.exists():
                killed.touch()
                os.kill(os.getpid(), signal.SIGKILL)
            return {"name": one.labels.condition}

        execution._compute = compute  # of the worker process
        return run_chain(chain, *args)

    monkeypatch.setattr(execution, "run_chain", run_in_worker)
    data = Demonstrations("data", tmp_path, "", {}, ())
    with cluster() as backend, joblib.parallel_config(backend=backend, n_jobs=WORKERS):
        assert execution.run_cells(cells, store, {"data": data}, jobs=None) == []
    assert killed.exists()
    assert [store.read(one)["name"] for one in cells] == list("abcd")


@pytest.mark.slow
@pytest.mark.parametrize("cluster", [dask_cluster, ray_cluster])
def test_a_suite_on_a_cluster_survives_a_killed_worker(small_maze, local, tmp_path, monkeypatch, cluster):
    """kill -9 of a worker within its first training: every cell ends, with the results of one machine."""
    killed = tmp_path / "killed"

    def run_in_worker(chain, store, *args):
        def compute(one, *more):
            with contextlib.suppress(FileExistsError):
                killed.touch(exist_ok=False)
                killed.write_text(f"{os.getpid()}")
                os.kill(os.getpid(), signal.SIGKILL)
            return whole(one, *more)

        whole = execution._compute  # of the worker process
        execution._compute = compute
        try:
            return run_chain(chain, store, *args)
        finally:
            execution._compute = whole

    monkeypatch.setattr(execution, "run_chain", run_in_worker)
    settings = tiny_suite(small_maze, tmp_path / "cluster")
    with cluster() as backend, joblib.parallel_config(backend=backend, n_jobs=WORKERS):
        assert reproduce(settings) == []
    assert killed.read_text() != f"{os.getpid()}"
    assert results_of(settings) == local
    assert not list(Store(settings.output_dir).root.glob("work/*/running"))
