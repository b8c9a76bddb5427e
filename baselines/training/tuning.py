"""`tune`: the options of a controller, searched by CMA-ES on training starts for the score or the cost.

A generation is some candidates on the same starts, all of a candidate's flights at once. The best of each
generation is judged on held-out starts, and the best of those is what the folder holds.

tuned.json    the best policy, which `make_policy` makes of the folder
curve.csv     one row per judged candidate, as of a training
last.json     from where --resume goes on
config.json   task, policy, options, objective, seed, versions, revision, command
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from quad_envs.arguments.checks import (
    require_choice,
    require_mappings,
    require_paths,
    require_whole,
    require_words,
)
from quad_envs.arguments.field_comments import called_with
from quad_envs.arguments.kinds import is_number
from quad_envs.arguments.names import shown
from quad_envs.parameters import Array

from ..errors import ResultsError, TrainingError
from ..evaluation.evaluate import fly_and_measure
from ..files import (
    locked,
    plain_json,
    provenance,
    read_json,
    write_csv,
    write_json,
)
from ..interruptions import held, raise_lost, remembered
from ..policies.registry import from_outside, make_policy
from ..policies.tuned import DESCRIPTION, TunedPolicy, vehicle_of, write_tuned
from .clock import TrainingClock
from .held_out import HELD_OUT, HeldOutFlights, Point, Progress, read_point, training_options
from .tuned_options import Search, make_search
from .watching import Watcher

Objective = Literal["score", "quadratic_cost"]
FLIGHTS = 8  # of a candidate
SECONDS = 60.0  # budget, CPU-seconds
_SPREAD = 0.3  # decades, of the first generation
_VIOLATING = 10.0  # score that a flight loses if all its steps violate: limits come before the score
_CRASHED = 1e3  # beside any cost
_LAST = "last.json"
_LEARNED = ("C", "p_sigma", "pc", "g")  # of CMA-ES, beside its mean and sigma
_FILES = (DESCRIPTION, "curve.csv", _LAST, "config.json")


@dataclass(frozen=True, slots=True)
class TuningRequest:
    """The arguments of `tune`; the comment of a field is its documentation everywhere."""

    env_id: str  # id of the task
    policy: str  # a name of `make_policy` with options that can be tuned
    _: KW_ONLY
    objective: Objective = "score"  # what is better: a higher score, or a lower "quadratic_cost"
    seed: int = 0  # of the search and its starts, 0 to 99
    seconds: float | None = None  # budget in CPU-seconds of the search; 60 if neither this nor `episodes`
    episodes: int | None = None  # budget in episodes instead
    fields: Sequence[
        str
    ] = ()  # options to tune; all of Q, R, R_rate, ... that mean something if none is given
    out: str | Path | None = None  # folder; runs/tuned-POLICY-TASK-SEED if not given
    env_kwargs: Mapping[str, Any] | None = None  # of the environment
    options: Mapping[str, Any] | None = None  # of the policy, with which the search begins
    resume: bool = False  # go on with the search in the folder until the whole budget is used
    fresh: bool = False  # discard the search that is in the folder
    watcher: Watcher | None = None  # hears of the progress

    def __post_init__(self) -> None:
        require_words(env_id=self.env_id, policy=self.policy)
        require_mappings(env_kwargs=self.env_kwargs, options=self.options)
        require_paths(out=self.out)
        require_choice("objective", self.objective, Objective)
        require_whole("seed of a tuning", self.seed, 0, 99)
        if self.resume and self.fresh:
            raise ValueError("either resume or fresh: a search that is discarded cannot go on")
        if self.seconds is not None and self.episodes is not None:
            raise ValueError("the budget is either seconds (CPU-seconds) or episodes, not both")
        if self.seconds is not None and not (is_number(self.seconds) and self.seconds > 0.0):
            raise ValueError(f"seconds of a tuning must be a number > 0, got {shown(self.seconds)}")
        if self.episodes is not None:
            require_whole("episodes of a tuning", self.episodes, 1)
            object.__setattr__(self, "episodes", int(self.episodes))  # of numpy it is nothing for JSON
        object.__setattr__(self, "seed", int(self.seed))

    @property
    def folder(self) -> Path:
        """Where it goes."""
        task = self.env_id.rsplit("/", 1)[-1].removesuffix("-v0")
        return Path(self.out or Path("runs") / f"tuned-{self.policy}-{task}-{self.seed}")


@dataclass(frozen=True, slots=True)
class TuningResult:
    """What a tuning gave."""

    folder: Path  # which `make_policy` takes
    policy: str
    options: dict[str, Any]  # of the best
    best: Point
    curve: tuple[Point, ...]

    def to_dict(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "folder": str(self.folder),
            "policy": self.policy,
            "options": self.options,
            "best": self.best._asdict(),
            "curve": [point._asdict() for point in self.curve],
        }


@called_with(TuningRequest)
def tune(request: TuningRequest) -> TuningResult:
    """Tune the options of a controller, and leave a folder that `make_policy` takes.

    Training starts have seeds below 10 000; those of tables are never seen. Violations and crashes count more
    than any score. Equal seeds and a budget in episodes give equal results. Ctrl-C keeps what is finished.

    Raises:
        ValueError: If an argument is not allowed, or the policy has nothing to tune.
        ResultsError: If the folder is in use, holds another search, or cannot be written.
        TrainingError: If no candidate stays in the air.
    """
    return run_tuning(request)


def check_tuning(request: TuningRequest) -> Search:
    """Check what is asked for, and write nothing.

    Returns:
        What is going to be searched.

    Raises:
        ValueError: If an argument is not allowed, or the policy has nothing to tune.
    """
    task = training_options(request.env_id, dict(request.env_kwargs or {})).task
    given = request.options or {}
    if not from_outside(request.policy):
        make_policy(request.policy, task, **given)  # says what of the options is not allowed
    search = make_search(request.policy, task, given, request.fields)
    make_policy(request.policy, task, **search.options(np.zeros(search.size)))
    _require_a_generation(request, _cma(search, np.zeros(search.size)).population_size)
    return search


def _cma(search: Search, mean: Array, sigma: float = _SPREAD, seed: int = 0) -> Any:
    """Of cmaes: a normal distribution of candidates, in decades."""
    from cmaes import CMA

    return CMA(mean=mean, sigma=sigma, bounds=search.bounds, seed=seed)


def _state(cma: Any) -> dict[str, Any]:
    """What beside its mean and sigma a distribution has learned, and its random numbers, as plain values."""
    _, keys, position, has_gauss, gauss = cma._rng.get_state()
    return {
        **{name: getattr(cma, f"_{name}") for name in _LEARNED},
        "random": [keys.tobytes().hex(), int(position), int(has_gauss), float(gauss)],
    }


def _restore(cma: Any, last: Mapping[str, Any]) -> None:
    """Give a distribution that state; a search of before has none, and goes on with other candidates."""
    if "random" not in last:
        return
    for name in _LEARNED:
        value = last[name]
        setattr(cma, f"_{name}", np.array(value) if isinstance(value, list) else value)
    keys, *rest = last["random"]
    cma._rng.set_state(("MT19937", np.frombuffer(bytes.fromhex(keys), dtype=np.uint32), *rest))


def _require_a_generation(request: TuningRequest, candidates: int) -> None:
    least, asked = FLIGHTS * candidates, request.episodes
    if asked is not None and asked < least:
        raise ValueError(
            f"a tuning of {asked} episode{'s' * (asked != 1)} cannot compare anything: one generation of "
            f"{candidates} candidates flies {least}; give --episodes {least} or more, or "
            "tune fewer options (--tuned)"
        )


def tuning_begun(folder: Path) -> bool:
    """Whether a folder holds a search that can go on, or has used its budget."""
    return (folder / _LAST).exists()


def run_tuning(request: TuningRequest) -> TuningResult:
    """Do what is asked for, see `tune`."""
    search = check_tuning(request)
    held_out = HeldOutFlights(request.env_id, dict(request.env_kwargs or {}))
    path = request.folder
    with remembered(), locked(path):
        run = _Run(request, search, held_out)
        run.go()
        best = run.best()
        return TuningResult(path, request.policy, search.options(run.best_z), best, tuple(run.curve))


def loss_of(summary: Mapping[str, Any], crashes: int, objective: Objective) -> float:
    """What a candidate is minimised by.

    Args:
        summary: Of its flights.
        crashes: Number of flights that crashed.
        objective: Score or cost; of a cost its logarithm counts.
    """
    value = -summary["score"].mean
    if objective == "quadratic_cost":
        cost = summary["quadratic_cost"].mean
        value = math.log(cost) if cost > 0.0 else 0.0
    return float(value + _VIOLATING * summary["violation_share"].mean + _CRASHED * crashes)


class _Run:
    """One session of a search."""

    def __init__(self, request: TuningRequest, search: Search, held_out: HeldOutFlights) -> None:
        self.request, self.search, self.held_out, self.path = request, search, held_out, request.folder
        self.about = {
            "tuning": 1,
            "env_id": held_out.task.env_id,
            "env_kwargs": plain_json(dict(request.env_kwargs or {})),
            "policy": request.policy,
            "options": plain_json(search.given),
            "fields": list(search.names),
            "objective": request.objective,
            "seed": request.seed,
        }
        self.curve: list[Point] = []
        self.best_z, self.best_loss, mean = np.zeros(search.size), math.inf, np.zeros(search.size)
        seconds, self.generation, self.episodes = 0.0, 0, 0
        sigma = _SPREAD
        last = self._read() if request.resume else None
        if last is not None:
            mean, self.best_z = np.array(last["mean"]), np.array(last["best"])
            self.best_loss, sigma = last["loss"], last["sigma"]
            seconds, self.generation, self.episodes = last["seconds"], last["generation"], last["episodes"]
        self.clock = TrainingClock(seconds)
        self.cma = _cma(search, mean, sigma, 1000 * request.seed + self.generation)
        if last is None:
            self._begin()
        else:
            _restore(self.cma, last)
            self._write_best()  # whoever died between these files
            self._write_curve()
        self.env = HeldOutFlights(request.env_id, dict(request.env_kwargs or {}), FLIGHTS).env

    def best(self) -> Point:
        """The best judged candidate."""
        return min(self.curve, key=self._judged_loss)

    def share(self) -> float:
        """Share of the budget that is used up."""
        if self.request.episodes is not None:
            return float(self.episodes + self._least() - 1) / self.request.episodes
        return self.clock.seconds / (self.request.seconds or SECONDS)

    def go(self) -> None:
        """Search until the budget is used up."""
        watcher = self.request.watcher
        try:
            if not self.curve:
                self._judge(np.zeros(self.search.size))
            while self.share() < 1.0:
                raise_lost()
                with self.clock.running():
                    asked = [(z, self._loss(z)) for z in self._candidates()]
                    self.cma.tell(asked)
                self.generation += 1
                self.episodes += FLIGHTS * len(asked)
                if watcher is not None:
                    watcher.updated(self.share(), None)
                self._judge(min(asked, key=lambda pair: pair[1])[0])
        finally:
            if watcher is not None:
                watcher.close()
        if self.best().crashes >= self.best().flights:
            raise TrainingError(
                f"no candidate for {self.request.policy!r} stays in the air on {self.request.env_id}: all "
                f"{self.best().flights} flights of the best one crash; begin from options that fly "
                f"(--policy-set), or make the task easier. What was tried is kept in {str(self.path)!r}"
            )

    def _candidates(self) -> list[Array]:
        return [self.cma.ask() for _ in range(self.cma.population_size)]

    def _loss(self, z: Array) -> float:
        """Of a candidate, on the starts of this generation."""
        starts = HELD_OUT // 100
        seed = starts * self.request.seed + FLIGHTS * self.generation % (starts - FLIGHTS)
        policy = make_policy(self.request.policy, self.held_out.task, **self.search.options(z))
        found = fly_and_measure(policy, self.env, FLIGHTS, seed)
        crashes = sum(bool(record.crashed) for record in found.records)
        return loss_of(found.summary(), crashes, self.request.objective)

    def _judged_loss(self, point: Point) -> float:
        value = -point.score
        if self.request.objective == "quadratic_cost":
            value = math.log(point.quadratic_cost) if point.quadratic_cost > 0.0 else math.inf
        if not math.isfinite(value):
            value = 0.0
        return value + _VIOLATING * point.violation_share + _CRASHED * point.crashes

    def _judge(self, z: Array) -> None:
        """Judge a candidate on held-out starts, and save."""
        policy = make_policy(self.request.policy, self.held_out.task, **self.search.options(z))
        progress = Progress(self.generation, self.held_out.task.episode_steps * self.episodes, math.nan)
        point = self.held_out.judge_policy(policy, self.clock.seconds, progress)
        loss = self._judged_loss(point)
        best = loss < self.best_loss
        with held():  # what is judged is saved, or neither
            self.curve.append(point)
            if best:
                self.best_z, self.best_loss = z, loss
            # First the file that has it all, from which the others are made anew if this ends between them.
            write_json(self.path / _LAST, self._last())
            if best:
                self._write_best()
            self._write_curve()
        if self.request.watcher is not None:
            self.request.watcher.judged(point, best)

    def _write_best(self) -> None:
        task = self.held_out.task
        options = self.search.options(self.best_z)
        tuned = TunedPolicy(self.request.policy, options, task.env_id, vehicle_of(task))
        write_tuned(self.path, tuned, {**self.about, **self.best()._asdict(), **tuned._asdict()})

    def _write_curve(self) -> None:
        write_csv(self.path / "curve.csv", [each._asdict() for each in self.curve])

    def _last(self) -> dict[str, Any]:
        """All of the search, so that it goes on as if nothing had been."""
        found: dict[str, Any] = plain_json(
            {
                "mean": self.cma.mean,
                "sigma": float(self.cma._sigma),
                "best": self.best_z,
                "loss": self.best_loss,
                "seconds": self.clock.seconds,
                "generation": self.generation,
                "episodes": self.episodes,
                "curve": [point._asdict() for point in self.curve],
                **_state(self.cma),
            }
        )
        return found

    def _least(self) -> int:
        """Episodes of a generation."""
        return FLIGHTS * int(self.cma.population_size)

    def _config(self) -> dict[str, Any] | None:
        path = self.path / "config.json"
        if not path.exists():
            return None
        found = read_json(path)
        if isinstance(found, dict) and found.get("tuning"):
            return found
        raise ResultsError(
            f"{str(self.path)!r} holds a config.json that no tuning wrote; choose another folder"
        )

    def _begin(self) -> None:
        """Make the folder ready for a new search."""
        found = self._config()
        foreign = [name for name in _FILES if (self.path / name).exists()]
        if found is None and foreign:
            raise ResultsError(
                f"{str(self.path)!r} holds a {foreign[0]} of something else; choose another folder"
            )
        if found is not None and not self.request.fresh and (self.path / _LAST).exists():
            raise ResultsError(
                f"{str(self.path)!r} holds a tuning of {found['policy']} on {found['env_id']}: go on with it "
                "(--resume), discard it (--fresh), or choose another folder"
            )
        for name in _FILES:
            (self.path / name).unlink(missing_ok=True)
        write_json(self.path / "config.json", {**self.about, **provenance()})

    def _read(self) -> dict[str, Any] | None:
        """Where the search in the folder goes on; None if it ended before its first candidate was judged."""
        found = self._config()
        if found is None:
            raise ResultsError(
                f"{str(self.path)!r} holds no tuning that could be resumed; leave --resume out"
            )
        for name, value in self.about.items():
            if found.get(name) != value:
                raise ResultsError(
                    f"{str(self.path)!r} holds another tuning: its {name} is {json.dumps(found.get(name))}, "
                    f"asked for is {json.dumps(value)}; give the same, or choose another folder"
                )
        if not (self.path / _LAST).exists():
            return None
        last: dict[str, Any] = read_json(self.path / _LAST)
        rows = last.get("curve")
        if rows is None:  # a search of before
            with open(self.path / "curve.csv", newline="") as file:
                rows = list(csv.DictReader(file))
        self.curve = [
            read_point({name: "nan" if x is None else x for name, x in row.items()}) for row in rows
        ]
        return last
