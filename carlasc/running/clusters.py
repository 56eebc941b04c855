"""Opening a Dask cluster: on this machine, at the address of a scheduler, on Slurm, or of any
cluster class of Dask.
"""

from __future__ import annotations

import gc
import importlib
import logging
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from typing import Any

from carlasc.errors import ArgumentError, CarlascError, import_extra
from carlasc.running.clients import Versions, one_line_if_lost
from carlasc.running.pools import DEATHS, ONE_THREAD, inherited_by_workers
from carlasc.running.ray_tasks import connected
from carlasc.running.spreading import DaskClient, LazyClient, Run

_CONNECT_S = "10s"  # the Dask setting carlasc.connect-timeout replaces it; fact: cluster-connect
_WORKERS_S = "10m"  # the Dask setting carlasc.workers-timeout replaces it; fact: cluster-workers
_REFILL_S = 2.0
_FORMS = "local, local:N, tcp://HOST:PORT, ray://HOST:PORT, slurm, or the dotted path of a class"
_SETTINGS = {
    "distributed.scheduler.allowed-failures": DEATHS - 1,
    # a worker holds only its current task, so that no other task is lost if it dies
    "distributed.scheduler.worker-saturation": 1.0,
    **{f"distributed.nanny.pre-spawn-environ.{name}": "1" for name in ONE_THREAD},
    "distributed.worker.profile.enabled": False,  # the profiler samples stacks continuously
    "distributed.admin.large-graph-warning-threshold": "1GB",
}


@contextmanager
def open_cluster(where: str, *, workers: int | None = None) -> Iterator[LazyClient]:
    """Yield a Dask or Ray cluster for `run_all` and every argument `executor`.

    The cluster starts with the first task, and is stopped at the end of the block, immediately if
    the block fails. All workers need the same version of carlasc, and must read and write the same
    files under the same names: on a shared file system, or in an object store.

    Args:
        where: "local": new processes on this machine; "local:N": N processes; "tcp://HOST:PORT"
            ("tls://", "ws://"): a running scheduler; "ray://HOST:PORT": a running Ray cluster;
            "slurm": Slurm jobs, as in the configuration file of Dask (`jobqueue.slurm`);
            "package.module.Class": a class that starts a cluster when it is called without
            arguments.
        workers: number of processes of "local", None for one per core; number of jobs or workers of
            the other clusters that are started.

    Raises:
        ArgumentError: `where` has none of these forms, or the number of workers is missing.
        DependencyError: Dask, or Ray for "ray://", is not installed.
        CarlascError: the scheduler does not answer, no worker starts in time, or a worker has other
            versions.
    """
    with ExitStack() as open_things:
        if where.startswith("ray://"):
            yield LazyClient(partial(open_things.enter_context, connected(where)))
            return
        distributed = import_extra("distributed", "cluster")
        start = _starter(where, workers)

        def connect() -> DaskClient:
            import dask

            open_things.enter_context(_quiet())
            open_things.enter_context(dask.config.set(_SETTINGS))
            place = where if start is None else open_things.enter_context(_started(start))
            client: DaskClient = open_things.enter_context(_connected(distributed, place, where))
            return client

        yield LazyClient(connect)


def _starter(where: str, workers: int | None) -> Callable[[], Any] | None:
    """Return the function that starts a cluster; None for the address of a running one.

    Raises:
        ArgumentError: `where` has none of the known forms.
    """
    if re.match(r"(tcp|tls|ws|wss|ucx)://", where):
        return None
    if match := re.fullmatch(r"local(?::([1-9][0-9]*))?", where):
        if match[1] and workers not in (None, int(match[1])):
            raise ArgumentError(
                "workers", expected=f"no number of workers with {where}", found=workers
            )
        return partial(_start_local, int(match[1]) if match[1] else Run(workers).processes)
    module, _, name = (
        "dask_jobqueue.SLURMCluster".rpartition(".") if where == "slurm" else where.rpartition(".")
    )
    if where == "slurm":
        import_extra(module, "cluster")
    if not re.fullmatch(r"\w+(\.\w+)*", module):
        raise ArgumentError("cluster", expected=_FORMS, found=repr(where))
    try:
        kind = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ArgumentError("cluster", expected=_FORMS, found=f"{where!r} ({error})") from error
    return partial(_start_class, kind, where, workers)


def _start_local(workers: int) -> Any:
    from distributed import LocalCluster

    try:
        cluster = LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            # no limit, as without a cluster: Dask would pause or kill workers although memory is
            # free
            memory_limit=None,
            dashboard_address="127.0.0.1:0",  # a free port, because the default port may be in use
            silence_logs=logging.CRITICAL,
        )
    except (RuntimeError, OSError) as error:
        raise CarlascError("cluster local", problem=f"it does not start: {error}") from error
    _keep(cluster, workers)
    return cluster


def _start_class(kind: Callable[[], Any], where: str, workers: int | None) -> Any:
    """Start the cluster of a class, and ask for workers."""
    try:
        cluster = kind()
        if workers is not None:
            _keep(cluster, workers)
    except Exception as error:
        raise CarlascError(f"cluster {where}", problem=f"it does not start: {error}") from error
    if workers is None and not getattr(cluster, "plan", True):
        cluster.close()
        raise ArgumentError(
            "workers", expected=f"the number of jobs or workers that {where} starts", found="none"
        )
    return cluster


def _keep(cluster: Any, workers: int) -> None:
    """Request workers from a cluster, and replace lost workers repeatedly."""
    from tornado.ioloop import PeriodicCallback

    number = {"jobs": workers} if hasattr(cluster, "job_script") else {"n": workers}

    def refill() -> None:
        for name, worker in list(cluster.workers.items()):
            # Dask does not replace a worker that died while it started
            if hasattr(worker, "kill") and worker.status.name in ("closed", "failed"):
                del cluster.workers[name]
        cluster.scale(**number)

    cluster.scale(**number)
    if isinstance(getattr(cluster, "workers", None), dict):
        callback = cluster.periodic_callbacks["carlasc-refill"] = PeriodicCallback(
            refill, 1000 * _REFILL_S
        )
        cluster.loop.add_callback(callback.start)


@contextmanager
def _started(start: Callable[[], Any]) -> Iterator[Any]:
    """Start a cluster, yield it, and stop it at the end."""
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # here, because its start unblocks Ctrl-C
    with inherited_by_workers():
        cluster = start()
    try:
        yield cluster
    except BaseException:
        _kill_workers(cluster)
        raise
    finally:
        cluster.close()


def _kill_workers(cluster: Any) -> None:
    """Kill the processes of a cluster on this machine during their tasks.

    Other jobs end when the cluster is closed.
    """
    import asyncio

    async def kill() -> None:
        nannies = [worker for worker in cluster.workers.values() if hasattr(worker, "kill")]
        await asyncio.gather(
            *(nanny.kill(timeout=0.1) for nanny in nannies), return_exceptions=True
        )

    if hasattr(cluster, "workers"):
        cluster.sync(kill)


@contextmanager
def _connected(distributed: Any, place: Any, where: str) -> Iterator[Any]:
    """Yield a client of a scheduler with at least one worker.

    All workers have the versions of this process.
    """
    import dask
    from dask.utils import parse_timedelta

    connect_s = parse_timedelta(dask.config.get("carlasc.connect-timeout", _CONNECT_S))
    workers_s = parse_timedelta(dask.config.get("carlasc.workers-timeout", _WORKERS_S))
    failure = None
    try:
        client = distributed.Client(place, timeout=connect_s, set_as_default=False)
    except (OSError, ValueError, RuntimeError, TypeError) as error:
        failure = CarlascError(
            f"cluster {where}",
            problem=f"no scheduler answers: {error}",
            advice="check the address, and that the scheduler is running",
        )
    if failure:
        # Dask closes a client that could not start only in its finalizer. To avoid a deadlock with
        # the start of another client, the finalizer must run now, so the cause, which refers to the
        # client, is dropped.
        gc.collect()
        raise failure
    try:
        with one_line_if_lost(client):
            try:
                client.wait_for_workers(1, timeout=workers_s)
            except TimeoutError as error:
                raise CarlascError(
                    f"cluster {where}",
                    problem=f"no worker started within {workers_s:g} s",
                    advice="check its jobs or workers, or wait longer: "
                    "DASK_CARLASC__WORKERS_TIMEOUT=1h",
                ) from error
            ours = Versions.here()  # workers that start later are checked before their first task
            for worker, versions in client.run(Versions.here, on_error="return").items():
                if not isinstance(versions, Versions):
                    raise CarlascError(
                        f"worker {worker}",
                        expected=f"carlasc {ours.carlasc}",
                        found=f"none ({versions})",
                    )
                ours.check(versions, worker)
        yield client
    finally:
        with suppress(TimeoutError):  # the scheduler may have ended
            client.close(timeout=1)


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress logs and warnings of Dask, because failures are reported in one line."""
    names = [
        name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"
    ]
    before = {name: logging.getLogger(name).level for name in names}
    try:
        for name in names:
            logging.getLogger(name).setLevel(logging.CRITICAL)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="distributed")
            yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)
