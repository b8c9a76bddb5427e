"""Kernels compiled before anything flies, by all cores: a moment of each environment and of each policy."""

from __future__ import annotations

import contextlib
import pickle
import sys
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from threading import Lock, Thread
from time import perf_counter
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numba.core import event

from quad_envs.compilation.decorators import announce_no_more, kept_in
from quad_envs.registration import TEAMS, TRACKING

from ..interruptions import submit_to
from ..policies.environments import make_env, task_of
from ..policies.registry import TEAM_POLICIES, TRACKING_POLICIES, PolicyEntry, make_policy, serving
from ..policies.trained import shipped_for
from .choices import EnvChoice, PolicyChoice
from .progress import Progress, said_seconds
from .unit_flights import fly_unit
from .units import Unit

_COMPILING = "numba:compile"  # numba's event
_FEW_SECONDS = 0.2  # of flight, enough to call every kernel
_LIMITED = "quad/CorridorTracking-v0"
_LONG = 2.0  # s, from which a piece is worth a line of its own


class Piece(NamedTuple):
    """Calls the kernels of one thing. What it calls is a function of a module, so that processes find it."""

    title: str
    call: Callable[[Unit], object]
    unit: Unit


def registered(unit: Unit) -> PolicyEntry | None:
    """The row of a unit's policy in the registry; None for networks and for policies from outside.

    A tuned controller has that of the controller.
    """
    if unit.policy.train is not None or not unit.named:
        return None
    return TEAM_POLICIES.get(unit.policy.name) or TRACKING_POLICIES.get(unit.policy.name)


def compile_for(units: Sequence[Unit]) -> None:
    """Call every kernel that these units need, so that nobody waits for one while they fly.

    A kernel that is kept from an earlier run is loaded instead, which takes a moment. Networks and policies
    from outside are left out: the former need no kernel of their own, the latter are none of ours.
    """
    first: dict[tuple[str, str], Unit] = {}
    for unit in units:
        if registered(unit) is not None:
            first.setdefault((unit.policy.name, TEAMS.get(unit.env.id, "")), _short(unit))
    if first:
        names = dict.fromkeys(name for name, _ in first)
        _compile(_pieces(list(first.values())), list(first.values()), ", ".join(names), None)


def compile_everything(jobs: int | None = None) -> Path | None:
    """Compile what every registered environment and policy needs, also many at once, networks and pictures.

    Args:
        jobs: Processes; None: as many as there are cores.

    Returns:
        Where the kernels are kept; None if no folder can be written, and they are not.
    """
    units = [_unit(env_id, name) for env_id in (*TRACKING, *TEAMS) for name in _policies(env_id)]
    each = {unit.env.id: unit for unit in units}.values()
    whole = [Piece(f"{unit.env.id}, many and drawn", _step_many_and_draw, unit) for unit in each]
    rare = [
        Piece("vehicles drawn at random", fly_unit, _unit(_LIMITED, "hover", randomize=0.1)),
        Piece("a safety filter", _decide, _unit(_LIMITED, "safe:hover")),
    ]
    _compile([*_pieces(units), *rare, *whole], [], "everything", jobs)
    return kept_in()


def _policies(env_id: str) -> list[str]:
    """All that fly in an environment; one network stands for all of them."""
    mission = (
        "tracking" if env_id in TRACKING else str(import_module(TEAMS[env_id]).raw_env.options_type.mission)
    )
    return [*serving(mission), *shipped_for(env_id)[:1]]


def _unit(env_id: str, policy: str, **kwargs: Any) -> Unit:
    """A flight as anybody flies it: a shorter one may have arguments of other types."""
    return Unit(0, EnvChoice(env_id, kwargs), PolicyChoice(policy), policy, 1, 0)


def _short(unit: Unit) -> Unit:
    """One flight of a few control periods, of which nothing is saved."""
    kwargs = {key: value for key, value in unit.env.kwargs.items() if key != "max_episode_steps"}
    env = replace(unit.env, kwargs={**kwargs, "time_limit": _FEW_SECONDS})
    return unit._replace(env=env, episodes=1)


def _pieces(units: Sequence[Unit]) -> list[Piece]:
    """Environments first, since whole flights need them; then decisions, the longest first.

    All MPCs share a solver. The longest of them is next, and the others are last: until then it is compiled.
    Among these the quick ones come first: `score-nmpc` finds the kernel of `nmpc`, once that is there.
    """
    hover = {unit.env.id: unit._replace(policy=PolicyChoice("hover"), policy_name="hover") for unit in units}
    envs = [Piece(unit.env.id, fly_unit, unit) for unit in hover.values()]
    policies: dict[tuple[str, str], Piece] = {}
    for unit in units:
        entry = registered(unit)
        call = fly_unit if entry is None or entry.privileged else _decide
        key = unit.policy.name if entry else "a network", TEAMS.get(unit.env.id, "")
        policies.setdefault(key, Piece(unit.policy.name, call, unit))
    longest = sorted(policies.values(), key=_decision_ms, reverse=True)
    mpcs = [piece for piece in longest if (entry := registered(piece.unit)) is not None and entry.mpc]
    return [*envs, *mpcs[:1], *(piece for piece in longest if piece not in mpcs), *mpcs[:0:-1]]


def _decision_ms(piece: Piece) -> float:
    entry = registered(piece.unit)
    return 0.0 if entry is None else entry.decision_ms


def _decide(unit: Unit) -> None:
    """One decision, without the environment's kernels: on an observation of zeros."""
    env = make_env(unit.env.id, **unit.env.kwargs)
    task: Any = task_of(env)
    policy = make_policy(unit.policy_name, env, **unit.options)
    policy.predict(np.zeros((getattr(env, "max_num_agents", 1), task.layout.size), dtype=np.float32), None)


def _step_many_and_draw(unit: Unit) -> None:
    """A step of several flights in one call, and a picture."""
    if unit.env.id in TEAMS:
        rows: Any = import_module(TEAMS[unit.env.id]).vector_env(2, **unit.env.kwargs)
    else:
        rows = gymnasium.make_vec(unit.env.id, num_envs=2, **unit.env.kwargs)
    rows.reset(seed=0)
    rows.step(np.zeros(rows.action_space.shape, dtype=np.float32))
    shown = make_env(unit.env.id, render_mode="rgb_array", **unit.env.kwargs)
    shown.reset(seed=0)
    shown.render()


def _compile(pieces: Sequence[Piece], flights: Sequence[Unit], title: str, jobs: int | None) -> None:
    """Call all pieces, with the help of other processes once one has to be compiled; then fly the flights."""
    from joblib import cpu_count

    total = len(pieces) + len(flights)
    progress, done, lock = Progress("compile", total), 0, Lock()

    def finished(what: str, seconds: float) -> None:
        nonlocal done
        with lock:
            done += 1
            progress.move(done, total)
            if seconds > _LONG and done < total:
                progress.write(f"compile: {what} is ready, {done} of {total}")

    begin, waiting = perf_counter(), deque(pieces)
    helpers = _Helpers(waiting, min(jobs or cpu_count(), len(pieces)) - 1, finished)
    try:
        with warnings.catch_warnings(), helpers:
            warnings.simplefilter("ignore")  # they are said when the units fly
            for piece in helpers.rest():
                progress.describe(f"compile {piece.title}")
                _timed(piece, finished)
            for unit in flights:  # which load what other processes compiled
                _timed(Piece(unit.policy.name, fly_unit, unit), finished)
        progress.write(f"compile: {title}; took {said_seconds(perf_counter() - begin)}")
    finally:
        progress.close()


def _timed(piece: Piece, finished: Callable[[str, float], None]) -> None:
    begin = perf_counter()
    piece.call(piece.unit)
    finished(piece.title, perf_counter() - begin)


class _Helpers(event.Listener):
    """Processes that take pieces from the same queue, begun when the first kernel has to be compiled.

    Args:
        waiting: The queue, from which the caller takes pieces, too.
        count: How many processes.
        finished: Called with the title of a piece and how long it took, s.
    """

    def __init__(self, waiting: deque[Piece], count: int, finished: Callable[[str, float], None]) -> None:
        self._waiting, self._count, self._finished = waiting, count, finished
        self._threads: list[Thread] = []
        self._pools: list[Any] = []

    def __enter__(self) -> _Helpers:
        event.register(_COMPILING, self)
        return self

    def __exit__(self, *error: object) -> None:
        event.unregister(_COMPILING, self)
        self._waiting.clear()
        for pool in self._pools:
            pool.shutdown(wait=False, kill_workers=True)

    def on_start(self, event: Any) -> None:
        """A kernel has to be compiled: it is worth while to have help, if what helpers compile is kept."""
        if not self._threads and kept_in() is not None:
            self._threads = [Thread(target=self._help, daemon=True) for _ in range(self._count)]
            for thread in self._threads:
                thread.start()

    def on_end(self, event: Any) -> None:
        """Nothing to do when it is compiled."""

    def rest(self) -> Iterator[Piece]:
        """Pieces for the caller; ends when all are done, by whomever."""
        while self._waiting:
            while self._waiting:
                with contextlib.suppress(IndexError):  # a helper was faster
                    yield self._waiting.popleft()
            for thread in self._threads:
                thread.join()  # one that failed puts its piece back

    def _help(self) -> None:
        from cloudpickle import dumps
        from joblib.externals.loky import ProcessPoolExecutor

        pool = ProcessPoolExecutor(1)
        self._pools.append(pool)
        while self._waiting:
            with contextlib.suppress(IndexError):  # another one was faster
                piece, begin = self._waiting.popleft(), perf_counter()
                try:
                    submit_to(pool, _call, sys.path, dumps(piece)).result()
                except Exception:  # the caller meets it where it can be seen
                    self._waiting.append(piece)
                    return
                self._finished(piece.title, perf_counter() - begin)


def _call(path: list[str], payload: bytes) -> None:
    """Call a piece in a process that may have begun before the user's modules could be found."""
    sys.path += [place for place in path if place not in sys.path]
    announce_no_more()
    piece = pickle.loads(payload)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        piece.call(piece.unit)
