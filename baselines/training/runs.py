"""`train`: any algorithm on any task it can act on, with a budget, a learning curve and checkpoints.

Nothing here knows an algorithm: each is a generator, see `algorithms`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quad_envs.arguments.field_comments import called_with

from ..errors import CheckpointError, ResultsError, TrainingError
from ..files import locked
from ..interruptions import held, raise_lost, remembered
from ..policies.network import Network
from .algorithms import generator_of, require_resumable
from .clock import TrainingClock
from .held_out import CHOOSING, HeldOutFlights, Point, Progress, Training, better
from .plans import Plan, Start, make_plan, read_start
from .request import TrainingRequest
from .run_folder import RunFolder
from .watching import Watcher, tensorboard_log

_EVALUATIONS = 30  # in a budget
_PAUSE = 0.5  # CPU-seconds between evaluations, at least, in a budget of seconds
_KEPT = 0.01  # share of violating steps of one vehicle with limits, that counts as keeping them
_LIMIT = "limit"  # hyperparameter that bounds the share of violating steps


@dataclass(frozen=True, slots=True)
class TrainingResult:
    """What a training gave."""

    folder: Path  # a checkpoint itself, of the best policy
    env_id: str
    algorithm: str
    seed: int
    best: Point
    curve: tuple[Point, ...]

    def to_dict(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "folder": str(self.folder),
            "env": self.env_id,
            "algorithm": self.algorithm,
            "seed": self.seed,
            "best": self.best._asdict(),
            "curve": [point._asdict() for point in self.curve],
        }


@called_with(TrainingRequest)
def train(request: TrainingRequest) -> TrainingResult:
    """Train a network, and leave a folder that is a checkpoint of the best one.

    Equal seeds and a budget in steps give equal runs; one in CPU-seconds ends where the machine's speed has
    it end. Ctrl-C saves and is raised again.

    Raises:
        ValueError: If an argument is not allowed or the algorithm cannot act on the task.
        MissingPackageError: If what the algorithm needs is not installed.
        ResultsError: If the folder is in use, holds another run, or cannot be written.
        CheckpointError: If a policy cannot be written or read.
        TrainingError: If training diverges; the last good policies are kept.
    """
    return run_training(request)


def run_training(request: TrainingRequest) -> TrainingResult:
    """Do what is asked for, see `train`."""
    plan, path = make_plan(request), request.folder
    held_out = HeldOutFlights(plan.env_id, plan.env_kwargs)
    with remembered(), locked(path):
        folder = plan.folder(path)
        if request.resume:
            require_resumable(plan.algorithm)
        if request.resume and folder.has_policy():
            start = _resume(folder, plan)
        else:
            folder.begin(request.fresh or request.resume)  # what has no last policy was being discarded
            start = Start(plan.network)
        run = _Run(folder, plan, held_out, start, request.watcher)
        run.go()
        return TrainingResult(
            path, plan.env_id, plan.algorithm, plan.seed, run.best_point(), tuple(run.curve)
        )


def _resume(folder: RunFolder, plan: Plan) -> Start:
    """Where the run in the folder goes on."""
    start = read_start(folder)
    folder.mend(start.curve)
    if plan.budget.share(start.seconds, start.steps) >= 1.0:
        raise ResultsError(
            f"{str(folder.path)!r} has used {start.seconds:.1f} CPU-seconds and {start.steps} steps, all of "
            f"{plan.budget}: give more, with --seconds or --steps for the whole run"
        )
    folder.note_session()
    return start


class _Run:
    """One session of training: turns the generator, judges now and then, saves."""

    def __init__(
        self, folder: RunFolder, plan: Plan, held_out: HeldOutFlights, start: Start, watcher: Watcher | None
    ) -> None:
        self.folder, self.plan, self.budget, self.held_out = folder, plan, plan.budget, held_out
        self.start, self.limit = start, limit_of(plan)
        self.curve: list[Point] = list(start.curve)
        self.best = start.best
        self.clock = TrainingClock(start.seconds)
        self.progress = Progress(start.updates, start.steps, math.nan)
        self.network: Network | None = None  # the last one that is not saved yet
        self._judged = -math.inf  # CPU-seconds at the last evaluation
        self._next = 0.0  # share of the budget at which the next one is due
        self._watchers: list[Watcher] = [] if watcher is None else [watcher]
        self._unsaved: CheckpointError | ResultsError | None = None

    def best_point(self) -> Point:
        """The best evaluation."""
        assert self.best is not None
        return self.best

    def go(self) -> None:
        """Train until the budget is used up."""
        plan, more = self.plan, {} if self.start.network is None else {"start": self.start.network}
        # A resumed run draws other flights than those it has seen.
        seed = plan.seed + 1_000_003 * self.start.resumed
        with one_thread():
            updates = generator_of(plan.algorithm)(plan.task_options, plan.options, seed, self.share, **more)
            self._watchers += tensorboard_log(self.folder.path / "tensorboard")
            try:
                self._turn(updates)
            finally:
                updates.close()
                self._end()
        if self._unsaved is not None:
            raise self._unsaved
        if self.best is None:
            raise TrainingError(f"{plan.algorithm} made no update within {self.budget}; give it more")

    def share(self) -> float:
        """Share of the budget that is used up."""
        return self.budget.share(self.clock.seconds, self.progress.steps)

    def _turn(self, updates: Training) -> None:
        """Update after update."""
        while True:
            raise_lost()
            try:
                with self.clock.running():
                    found = next(updates, None)
            except (TrainingError, FloatingPointError, ValueError) as error:
                if self.network is None and not isinstance(error, TrainingError):
                    raise
                raise TrainingError(self._diverged(error)) from error
            if found is None:
                return
            progress, self.network = found
            self.progress = Progress(
                self.start.updates + progress.update,
                self.start.steps + progress.steps,
                float(progress.reward),
            )
            if not math.isfinite(self.progress.reward):
                raise TrainingError(self._diverged(f"the reward is {self.progress.reward}"))
            share = self.share()
            for watcher in self._watchers:
                watcher.updated(share, self.progress)
            if self._due(share):
                self._judge()

    def _due(self, share: float) -> bool:
        """Whether to evaluate; in a budget of steps at fixed steps, so that equal seeds give equal runs."""
        if share < self._next or share >= 1.0:  # the end is judged when all is done
            return False
        return self.budget.steps is not None or self.clock.seconds - self._judged >= _PAUSE

    def _judge(self) -> None:
        """Evaluate the network, and save it."""
        assert self.network is not None
        point = self.held_out.judge(self.network, self.clock.seconds, self.progress)
        with held():  # what is judged is saved, or neither
            self._take(point)

    def _take(self, point: Point) -> None:
        """Save a network that was judged, and tell of it."""
        assert self.network is not None
        self._judged, self._next = point.cpu_seconds, self.share() + 1.0 / _EVALUATIONS
        self.curve.append(point)
        best = better(point, self.best, self.limit)
        if best:
            self.best = point
        about, failure = self._about(point), ""
        try:
            # First the one from which --resume goes on: what it says makes the others whole, see `_resume`.
            self.folder.save_last(self.network, about)
            if best:
                self.folder.save_best(self.network, about)
            self.folder.write_curve(self.curve)
            self._unsaved = None
        except (CheckpointError, ResultsError) as error:
            # Training may outlive a full disk; what was saved before is still whole.
            self._unsaved = error
            failure = f"not saved, training goes on: {error}"
        for watcher in self._watchers:  # after saving: what is shown can be resumed
            watcher.judged(point, best)
            if failure:
                watcher.noted(failure)

    def _about(self, point: Point) -> dict[str, Any]:
        """What a checkpoint says of its making."""
        assert self.best is not None
        return {
            **point._asdict(),
            "starts": {"seed": CHOOSING, "flights": self.held_out.flights},
            "budget": str(self.budget),
            "resumed": self.start.resumed,
            "best": self.best._asdict(),
        }

    def _end(self) -> None:
        """Judge and save what was not, however training ended."""
        try:
            if self.network is not None and (
                not self.curve or self.curve[-1].updates != self.progress.update
            ):
                self._judge()
        finally:
            for watcher in self._watchers:
                watcher.close()

    def _diverged(self, why: Any) -> str:
        kept = "nothing was learned before"
        if self.network is not None:
            kept = f"the best policy before and the last finite one are kept in {str(self.folder.path)!r}"
        return f"training stopped at update {self.progress.update + 1}: {why}; {kept}"


def limit_of(plan: Plan) -> float | None:
    """Share of violating steps under which the best policy is chosen by its score; None: by its score alone.

    A vehicle with limits keeps them first, whatever the algorithm: more score by more violations is no better
    policy. Who trains for another share says so by its hyperparameter.
    """
    asked: float | None = getattr(plan.options, _LIMIT, None)
    task = plan.task_options.task
    kept = task.mission == "tracking" and task.constraint_names
    return _KEPT if asked is None and kept else asked


@contextmanager
def one_thread() -> Iterator[None]:
    """Networks this small train faster on one thread, and CPU-seconds compare."""
    try:
        import torch
    except ImportError:  # a learner of the user's own that does without
        yield
        return
    torch.optim.Adam([torch.zeros(1, requires_grad=True)])  # imports two more seconds of torch, once
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
