"""How joblib's backends say that a worker process was killed: on this machine, in Dask and in Ray."""

import sys
from concurrent.futures.process import BrokenProcessPool


def worker_deaths() -> tuple[type[BaseException], ...]:
    """The errors of a killed worker, of the backends that are in use.

    Dask runs a task again, elsewhere, and gives up after several deaths; the others tell of the first.
    """
    deaths: list[type[BaseException]] = [BrokenProcessPool]
    if "distributed" in sys.modules:
        from distributed import KilledWorker

        deaths.append(KilledWorker)
    if "ray" in sys.modules:
        from ray.exceptions import RayActorError, WorkerCrashedError

        deaths += [RayActorError, WorkerCrashedError]
    return tuple(deaths)
