"""Who runs the units of a sweep: processes here, or a cluster of Dask or Ray; no scheduler of our own.

An engine is a way to hand a call to another process and to get a future for it. What a unit gives comes back
through the future, so that the machines of a cluster need no common folder.
"""

from __future__ import annotations

import os
import pickle
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from functools import cache, partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple, TypeVar

from quad_envs.arguments.extras import install_command
from quad_envs.arguments.names import unknown_name

from ..errors import ResultsError
from ..files import source_digest
from ..interruptions import submit_to

Unit = TypeVar("Unit")
Submit = Callable[..., "Future[Any]"]

_ONE_AT_A_TIME = threading.Lock()  # in a process: a worker of a cluster may have several threads
_WATCH = 1.0  # s between two looks at who the parent is


class Engine(NamedTuple):
    """How to reach those who work."""

    start: Callable[[int | None], Any]  # jobs -> context with the function that submits a call
    package: str = ""  # that it needs
    install: str = ""  # how to get it


def check_engine(engine: str) -> None:
    """Check that an engine exists and is installed.

    Raises:
        ValueError: If not; it says how to install it.
    """
    if engine == SHARED_FOLDER:
        return
    if engine not in ENGINES:
        raise ValueError(unknown_name("engine", engine, [*ENGINES, SHARED_FOLDER]))
    package, install = ENGINES[engine][1:]
    if package and find_spec(package) is None:
        raise ValueError(f"engine {engine!r} needs the package {package}: {install}")


def run_units(
    work: Callable[[Unit], dict[str, Any]], units: Sequence[Unit], engine: str, jobs: int | None
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Run `work` on units that have a `number`, and yield (number, result) as they finish.

    What goes wrong in a unit is its result, `{"failure": text}`, after a second try; the others go on. So is
    the death of a process, which may also take along what others were at: each of those is tried again alone.

    Args:
        work: A function of a module, so that other processes find it. ResultsError ends the run.
        units: Their inputs.
        engine: One of ENGINES.
        jobs: How many at a time; None: one here, all that a cluster has.
    """
    if engine == "processes" and ((jobs or 1) == 1 or len(units) < 2):
        for unit in units:
            yield unit.number, tried(work, unit)  # type: ignore[attr-defined]
        return
    if not units:  # a cluster need not be joined
        return
    with ENGINES[engine].start(jobs) as submit:
        yield from _run_elsewhere(partial(submit, *_packed(work)), units, jobs or len(units))


def _packed(work: Callable[[Unit], dict[str, Any]]) -> tuple[Any, ...]:
    return _found_again, sys.path, source_digest(), work


def _run_elsewhere(submit: Submit, units: Sequence[Unit], limit: int) -> Iterator[tuple[int, dict[str, Any]]]:
    """Keep at most `limit` units under way; those whose process died follow in the end, one by one."""
    from cloudpickle import dumps

    waiting, suspects, running = deque(units), deque[Any](), dict[Any, Any]()
    alone = False
    while waiting or running or suspects:
        if not waiting and not running:
            alone = True
            waiting.append(suspects.popleft())
        while waiting and len(running) < (1 if alone else limit):
            unit = waiting.popleft()
            running[submit(dumps(unit))] = unit
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            unit = running.pop(future)
            try:
                yield unit.number, future.result()
            except ResultsError:
                raise
            except Exception as error:  # of the engine: `tried` answers for what the unit does
                if not alone:
                    suspects.append(unit)
                else:
                    yield unit.number, {"failure": f"its process ended without an answer ({_said(error)})"}


def tried(work: Callable[[Any], dict[str, Any]], unit: Any) -> dict[str, Any]:
    """The result of a unit, at the second try if need be, or what went wrong."""
    for attempt in (1, 2):
        try:
            return work(unit)
        except ResultsError:
            raise
        except Exception as error:
            failure = _said(error)
            if attempt == 2 or isinstance(error, ValueError):  # which would be the same again
                break
    return {"failure": failure}


def _said(error: BaseException) -> str:
    """An error as one line; of our own kinds the text alone, which names everything."""
    text = " ".join(str(error).split())
    kind = type(error)
    return (
        text if kind is ValueError or kind.__module__.startswith("baselines") else f"{kind.__name__}: {text}"
    )


def _found_again(path: list[str], source: str, work: Callable[[Any], Any], payload: bytes) -> dict[str, Any]:
    """`tried` in a process that may have begun before the user's modules could be found.

    Raises:
        ResultsError: If the process has other sources than the sweep: their numbers do not mix.
    """
    sys.path += [place for place in path if place not in sys.path]
    ours = _own_sources()
    if ours != source:
        raise ResultsError(
            f"a worker has other sources ({ours}) than this sweep ({source}): install the same "
            "version of quad-envs on every machine"
        )
    with _ONE_AT_A_TIME:
        return tried(work, pickle.loads(payload))


@cache
def _own_sources() -> str:
    """Digest of the code of this process, which was read when it began."""
    return source_digest()


@contextmanager
def _processes(jobs: int | None) -> Iterator[Submit]:
    """Processes of this machine, which end when this one does, however it ends."""
    from joblib.externals.loky import ProcessPoolExecutor
    from joblib.externals.loky.process_executor import BrokenProcessPool

    def begin() -> Any:
        return ProcessPoolExecutor(jobs, initializer=_end_with, initargs=(os.getpid(),))

    pool = begin()

    def submit(*call: Any) -> Future[Any]:
        nonlocal pool
        try:
            return submit_to(pool, *call)
        except BrokenProcessPool:  # one of its processes has died
            pool = begin()
            return submit_to(pool, *call)

    try:
        yield submit
    finally:
        pool.shutdown(wait=False, kill_workers=True)


def _end_with(parent: int) -> None:
    """Let this process end soon after its parent."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_WATCH)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _dask(jobs: int | None) -> Iterator[Submit]:
    """The cluster of Dask's configuration (DASK_SCHEDULER_ADDRESS), or a new one on this machine."""
    client = import_module("distributed").Client
    joined = import_module("dask.config").get("scheduler-address", None) is not None
    local = {} if joined else {"n_workers": jobs, "threads_per_worker": 1}
    with client(**local, set_as_default=False) as found:
        yield partial(found.get_executor(pure=False).submit)


@contextmanager
def _ray(jobs: int | None) -> Iterator[Submit]:
    """The cluster of RAY_ADDRESS, or the one that runs here, or a new one."""
    ray = import_module("ray")
    began = not ray.is_initialized()
    if began:
        ray.init(log_to_driver=False)
    remote = ray.remote(max_retries=2)
    try:
        yield lambda function, *arguments: remote(function).remote(*arguments).future()
    finally:
        if began:
            ray.shutdown()


ENGINES = {
    "processes": Engine(_processes),
    "ray": Engine(_ray, "ray", install_command("ray")),
    "dask": Engine(_dask, "distributed", install_command("dask")),
}
SHARED_FOLDER = "folder"  # no engine: see `shared`
