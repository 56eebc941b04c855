"""Opening a cluster: on this machine, at the address of a Dask scheduler, on Slurm, or of any class that follows Dask's protocol."""

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
from carlasc.running.spreading import DaskClient, LazyClient, Run

_CONNECT_S = "10s"  # Dask's setting carlasc.connect-timeout replaces it
_WORKERS_S = "10m"  # the same of carlasc.workers-timeout
_REFILL_S = 2.0
_FORMS = "local, local:N, tcp://HOST:PORT, slurm, or the dotted path of a class"
_SETTINGS = {
    "distributed.scheduler.allowed-failures": DEATHS - 1,
    "distributed.scheduler.worker-saturation": 1.0,  # a worker holds the task that it works on: no other dies with it
    **{f"distributed.nanny.pre-spawn-environ.{name}": "1" for name in ONE_THREAD},
    "distributed.worker.profile.enabled": False,  # it samples stacks all the time
    "distributed.admin.large-graph-warning-threshold": "1GB",
}


@contextmanager
def open_cluster(where: str, *, workers: int | None = None) -> Iterator[LazyClient]:
    """Yield a Dask cluster that `run_all`, and all that take an `executor`, accept.

    It is started when it first has something to do, and what was started is stopped at the end, at once if the block fails.

    All workers need the same version of carlasc, and read and write the same files under the same names: on a shared file system, or
    in an object store.

    Args:
        where: "local": new processes on this machine; "local:N": N of them; "tcp://HOST:PORT" ("tls://", "ws://"): a scheduler that
            runs already; "slurm": jobs of Slurm, as Dask's configuration file describes them (`jobqueue.slurm`);
            "package.module.Class": a class that starts a cluster when it is called without arguments.
        workers: number of processes of "local", all cores if None; number of jobs or workers that the others are asked for.

    Raises:
        ArgumentError: `where` has none of these forms, or the number of workers is missing.
        DependencyError: Dask is not installed.
        CarlascError: the scheduler does not answer, no worker comes, or a worker has other versions.
    """
    distributed = import_extra("distributed", "cluster")
    start = _starter(where, workers)
    with ExitStack() as open_things:

        def connect() -> DaskClient:
            import dask

            open_things.enter_context(_quiet())
            open_things.enter_context(dask.config.set(_SETTINGS))
            place = where if start is None else open_things.enter_context(_started(start))
            client: DaskClient = open_things.enter_context(_connected(distributed, place, where))
            return client

        yield LazyClient(connect)


def _starter(where: str, workers: int | None) -> Callable[[], Any] | None:
    """Return what starts a cluster; None if it runs already.

    Raises:
        ArgumentError: `where` has no form that is known.
    """
    if re.match(r"(tcp|tls|ws|wss|ucx)://", where):
        return None
    if match := re.fullmatch(r"local(?::([1-9][0-9]*))?", where):
        if match[1] and workers not in (None, int(match[1])):
            raise ArgumentError("workers", expected=f"none beside {where}", found=str(workers))
        return partial(_start_local, int(match[1]) if match[1] else Run(workers).processes)
    module, _, name = "dask_jobqueue.SLURMCluster".rpartition(".") if where == "slurm" else where.rpartition(".")
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
            memory_limit=None,  # as without a cluster: a limit would pause or kill workers that a machine has memory for
            dashboard_address="127.0.0.1:0",  # a free port: the usual one may be taken
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
        raise ArgumentError("workers", expected=f"the number of jobs or workers that {where} starts", found="none")
    return cluster


def _keep(cluster: Any, workers: int) -> None:
    """Ask a cluster for workers, and again and again for those that it lost for good."""
    from tornado.ioloop import PeriodicCallback

    number = {"jobs": workers} if hasattr(cluster, "job_script") else {"n": workers}

    def refill() -> None:
        for name, worker in list(cluster.workers.items()):
            # one that died while it started: Dask does not try again
            if hasattr(worker, "kill") and worker.status.name in ("closed", "failed"):
                del cluster.workers[name]
        cluster.scale(**number)

    cluster.scale(**number)
    if isinstance(getattr(cluster, "workers", None), dict):
        callback = cluster.periodic_callbacks["carlasc-refill"] = PeriodicCallback(refill, 1000 * _REFILL_S)
        cluster.loop.add_callback(callback.start)


@contextmanager
def _started(start: Callable[[], Any]) -> Iterator[Any]:
    """Yield a cluster that is started, and stop it at the end."""
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # when it is started with the first process, it lets Ctrl-C through
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
    """End the processes of a cluster on this machine in the middle of their tasks; jobs elsewhere end when the cluster is closed."""
    import asyncio

    async def kill() -> None:
        nannies = [worker for worker in cluster.workers.values() if hasattr(worker, "kill")]
        await asyncio.gather(*(nanny.kill(timeout=0.1) for nanny in nannies), return_exceptions=True)

    if hasattr(cluster, "workers"):
        cluster.sync(kill)


@contextmanager
def _connected(distributed: Any, place: Any, where: str) -> Iterator[Any]:
    """Yield a client of a scheduler that has at least one worker, all of them with our versions."""
    import dask
    from dask.utils import parse_timedelta

    connect_s = parse_timedelta(dask.config.get("carlasc.connect-timeout", _CONNECT_S))
    workers_s = parse_timedelta(dask.config.get("carlasc.workers-timeout", _WORKERS_S))
    failure = None
    try:
        client = distributed.Client(place, timeout=connect_s, set_as_default=False)
    except (OSError, ValueError, RuntimeError, TypeError) as error:
        failure = CarlascError(
            f"cluster {where}", problem=f"no scheduler answers: {error}", advice="check the address, and that it runs"
        )
    if failure:
        # Dask does not close a client that could not start: its finalizer does. If that ran while another client starts,
        # each would wait for the other, so it runs now, and the cause, which holds the client, is not kept.
        gc.collect()
        raise failure
    try:
        with one_line_if_lost(client):
            try:
                client.wait_for_workers(1, timeout=workers_s)
            except TimeoutError as error:
                raise CarlascError(
                    f"cluster {where}",
                    problem=f"no worker came within {workers_s:g} s",
                    advice="look at its jobs or workers, or wait longer: DASK_CARLASC__WORKERS_TIMEOUT=1h",
                ) from error
            ours = Versions.here()  # workers that come later are checked before their first task
            for worker, found in client.run(Versions.here, on_error="return").items():
                if not isinstance(found, Versions):
                    raise CarlascError(f"worker {worker}", expected=f"carlasc {ours.carlasc}", found=f"none ({found})")
                ours.check(found, worker)
        yield client
    finally:
        with suppress(TimeoutError):  # a scheduler that is gone does not answer
            client.close(timeout=1)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask from logging and warning: what goes wrong is told in one line."""
    names = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] == "distributed"]
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
