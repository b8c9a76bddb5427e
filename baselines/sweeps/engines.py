"""Who runs the units of a sweep: joblib's backends for processes, Ray and Dask; no scheduler of our own."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from importlib import import_module
from importlib.util import find_spec
from typing import Any, TypeVar

from quad_envs.extras import install_command
from quad_envs.names import unknown_name

ENGINES = ("processes", "ray", "dask")
_NEEDS = {
    "ray": ("ray", install_command("ray")),
    "dask": ("distributed", 'pip install "dask[distributed]"'),
}

Unit = TypeVar("Unit")


def check_engine(engine: str) -> None:
    """Check that an engine exists and is installed.

    Raises:
        ValueError: If not; it says how to install it.
    """
    if engine not in ENGINES:
        raise ValueError(unknown_name("engine", engine, ENGINES))
    if engine in _NEEDS and find_spec(_NEEDS[engine][0]) is None:
        raise ValueError(f"engine {engine!r} needs the package {_NEEDS[engine][0]}: {_NEEDS[engine][1]}")


def run_units(
    work: Callable[[Unit], dict[str, Any]], units: Sequence[Unit], engine: str, jobs: int
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Run `work` on units that have a `number`, and yield (number, result) as they finish.

    Args:
        work: A function of a module, so that other processes find it.
        units: Their inputs.
        engine: One of ENGINES.
        jobs: How many at a time.
    """
    if engine == "processes" and (jobs == 1 or len(units) < 2):
        for unit in units:
            yield _with_number(work, unit)
        return
    yield from _run_parallel(work, units, engine, jobs)


def _with_number(work: Callable[[Unit], dict[str, Any]], unit: Unit) -> tuple[int, dict[str, Any]]:
    return unit.number, work(unit)  # type: ignore[attr-defined]


def _found_again(path: list[str], payload: bytes) -> tuple[int, dict[str, Any]]:
    """`_with_number` in a process that may have begun before the user's modules could be found."""
    sys.path += [place for place in path if place not in sys.path]
    work, unit = pickle.loads(payload)
    return _with_number(work, unit)


def _run_parallel(
    work: Callable[[Unit], dict[str, Any]], units: Sequence[Unit], engine: str, jobs: int
) -> Iterator[tuple[int, dict[str, Any]]]:
    import joblib
    from cloudpickle import dumps

    with ExitStack() as stack:
        stack.enter_context(joblib.parallel_config(backend=_start(engine, jobs, stack), n_jobs=jobs))
        tasks = [joblib.delayed(_found_again)(sys.path, dumps((work, unit))) for unit in units]
        try:
            results = joblib.Parallel(return_as="generator_unordered", batch_size=1)(tasks)
        except (
            ValueError
        ):  # a backend that returns lists only: in pieces, so that little is lost by an interruption
            pieces = [tasks[i : i + 2 * jobs] for i in range(0, len(tasks), 2 * jobs)]
            results = (result for piece in pieces for result in joblib.Parallel(batch_size=1)(piece))
        yield from results


def _start(engine: str, jobs: int, stack: ExitStack) -> str:
    """Make the backend known to joblib; its name there."""
    if engine == "ray":
        import_module("ray.util.joblib").register_ray()
        return "ray"
    if engine == "dask":
        client = import_module("distributed").Client
        # With an address in Dask's configuration (DASK_SCHEDULER_ADDRESS) this joins that cluster.
        stack.enter_context(client(n_workers=jobs, threads_per_worker=1, set_as_default=True))
        return "dask"
    return "loky"
