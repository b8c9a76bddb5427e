"""Flights of teams as a differentiable function of the actions of all vehicles.

The forward pass is the environments' compiled step: resets, disturbances and sensor noise included. The
backward pass is its adjoint, in which the last two are given, and sensitivities pass between vehicles by
rewards, by what is sensed and by messages, back to the step in which these were sent. No gradient passes
through a new beginning.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quad_envs.arguments.names import shown
from quad_envs.envs.team.adjoint import TeamRecord, advance_teams_vjp, observe_teams_vjp, team_scratch
from quad_envs.envs.team.batch import TeamBatch
from quad_envs.envs.team.exchange import N_MOTION
from quad_envs.envs.team.options import TeamOptions
from quad_envs.envs.tracking.adjoint import action_slopes
from quad_envs.lanes import ALIVE, COEFFICIENTS, COMMAND, FORCE_MAX, N_PLANT, PLANT, STEP, WANTED
from quad_envs.observations.features import Features
from quad_envs.parameters import N_COEFFICIENTS
from quad_envs.plant import N_INPUT, Array
from quad_envs.references.table_row import N_TABLE
from quad_envs.wrappers.encoding import Encoding

from .features import require_measured, training_features
from .flights import Bools, Floats
from .observer import Observer


class TeamStep(NamedTuple):
    """One step of all teams, as far as its adjoint needs it."""

    record: TeamRecord
    t: int  # which step of its window
    slopes: Array  # (n, 4), of the commands by the actions
    rewards: Array  # (n,)
    crashed: Bools  # (n,)
    done: Bools  # (n,), vehicles whose team began anew


class DifferentiableTeams:
    """Teams of one task, from starts of the environment, at all times of the episode.

    Args:
        options: Of the task; see `require_differentiable`.
        n: Number of vehicles of all teams, rounded down to whole teams, but at least one.
        seed: Of the starts.
        features: That a network sees, of `training_features`; None for the default ones. No gradient passes
            through estimates.
        separation: m, below which the cost counts the distance between vehicles; None for the task's own.

    Raises:
        ValueError: If the task cannot be differentiated, or the separation is below the task's.
    """

    def __init__(
        self,
        options: TeamOptions,
        n: int,
        seed: int,
        features: Features | None = None,
        separation: float | None = None,
    ) -> None:
        require_differentiable(options, separation)
        self._size = options.vehicles
        self.teams = max(1, n // self._size)
        self.n = self.teams * self._size
        self.rng = np.random.default_rng(seed)
        self.batch = TeamBatch(options, self.teams)
        self.task = self.batch.task
        self._kept = options.separation if separation is None else float(separation)
        self._observer = Observer(Encoding(features or training_features(options)), self.task, self.n)
        seen = self._observer.encoder.task.layout
        self._columns, self._width = self.features.columns(seen), seen.size
        self._believed = seen.slices.get("estimate")  # what a filter of its own says of the target
        self._scale = np.asarray(self.features.scale)
        self._scratch = team_scratch(self._size, options.substeps, self.task.layout.sensed)
        self._out = np.empty((self.n, self.task.layout.size), dtype=np.float32)
        # The first episodes are cut at random, so that the teams are at all times of the episode.
        self._cut = self.rng.integers(1, self.task.episode_steps + 1, self.teams)
        self._told = self.batch.fresh_scores()
        self._begin(np.arange(self.teams))
        self._seen = self._observer.see(self._out, np.ones(self.n, dtype=np.bool_))
        self.begin_window(0)

    @property
    def features(self) -> Features:
        """What the network sees."""
        return self._observer.encoder.encoding.features

    def _begin(self, index: NDArray[np.int64]) -> None:
        self.batch.begin(index, [self.rng] * len(index), self._out.reshape(-1), self._told)

    def begin_window(self, n_steps: int) -> None:
        """Forget what is owed to earlier steps: a window of n_steps follows."""
        self._t, self._owed = 0, np.zeros((n_steps, self.n, N_MOTION))

    def observe(self) -> Floats:
        """Scaled features of all vehicles as they are, (n, features)."""
        return self._seen

    def observe_vjp(self, step: TeamStep, bar: Floats) -> tuple[Array, Array]:
        """Sensitivities to the plants (n, 16) and the last commands (n, 4) from those to `observe`.

        Those to motions that were sent earlier wait for their step: go back step by step. What a filter
        believes of a target is given; where it is relative to the vehicle is not.
        """
        full = np.zeros((self.n, self._width))
        full[:, self._columns] = bar / self._scale
        plants, commands, arrays = np.empty((self.n, N_PLANT)), np.empty((self.n, N_INPUT)), self.batch.arrays
        observe_teams_vjp(
            step.record, step.t, arrays.tables, arrays.task, arrays.team, full, self._owed, plants, commands,
            self._scratch,
        )  # fmt: skip
        if self._believed is not None:
            first = self._believed.start + 1
            plants[:, :3] -= full[:, first : first + 3]
        return plants, commands

    def advance(self, actions: Floats) -> TeamStep:
        """One step of all teams; those that end begin anew."""
        vehicles, arrays = self.batch.vehicles, self.batch.arrays
        plants, previous = vehicles.read(PLANT, N_PLANT), vehicles.read(COMMAND, N_INPUT)
        steps, ages, flew = (
            vehicles.read(STEP).astype(np.int64),
            self.batch.ages(),
            vehicles.read(ALIVE) > 0.0,
        )
        disturbances = self.batch.coming_disturbances()
        self.batch.step(np.ascontiguousarray(actions).reshape(-1), self._out.reshape(-1), self._told)
        scores = self.batch.scores(self._told.copy())
        slopes = np.empty((self.n, N_INPUT))
        action_slopes(actions, arrays.task, slopes)
        record = TeamRecord(
            plants=plants,
            previous=previous,
            commands=vehicles.read(COMMAND, N_INPUT),
            after=vehicles.read(PLANT, N_PLANT),
            wanted=vehicles.read(WANTED, N_TABLE),
            steps=steps,
            ages=ages,
            flew=flew,
            crashed=scores.crashed,
            force_max=vehicles.read(FORCE_MAX, N_INPUT),
            coefficients=vehicles.read(COEFFICIENTS, N_COEFFICIENTS),
            disturbances=disturbances,
        )
        self._seen = self._observer.see(self._out)
        self._cut -= 1
        ended = (scores.terminated | scores.truncated).reshape(self.teams, -1).all(axis=1) | (self._cut == 0)
        if ended.any():
            self._cut[ended] = self.task.episode_steps
            self._begin(np.flatnonzero(ended))
            rows = np.flatnonzero(np.repeat(ended, self._size))
            self._seen[rows] = self._observer.see(self._out[rows], np.ones(len(rows), dtype=np.bool_), rows)
        self._t += 1
        done = np.repeat(ended, self._size)
        return TeamStep(record, self._t - 1, slopes, scores.reward, scores.crashed, done)

    def advance_vjp(
        self, step: TeamStep, bar_after: Array, bar_commands: Array, bar_rewards: Array, bar_cost: float = 0.0
    ) -> tuple[Array, Array, Array]:
        """Adjoint of `advance`.

        Args:
            step: It.
            bar_after: Sensitivity to the plants afterwards, (n, 16).
            bar_commands: To the commands, as the next observation shows them, (n, 4).
            bar_rewards: To the rewards, (n,).
            bar_cost: To the violation cost of each vehicle, with `separation` as the distance to keep.

        Returns:
            Sensitivities to the actions (n, 4), the plants (n, 16) and the commands before (n, 4).
        """
        flew_on, arrays = ~step.done[:, None], self.batch.arrays
        plants = np.empty((self.n, N_PLANT))
        commands, previous = np.empty((self.n, N_INPUT)), np.empty((self.n, N_INPUT))
        advance_teams_vjp(
            step.record, arrays.tables, arrays.task, arrays.team, self._kept, bar_after * flew_on,
            bar_rewards, float(bar_cost), plants, commands, previous, self._scratch,
        )  # fmt: skip
        return (commands + bar_commands * flew_on) * step.slopes, plants, previous


def require_differentiable(options: TeamOptions, separation: float | None = None) -> None:
    """Check that a policy gradient passes through a team.

    Args:
        options: Of the task.
        separation: See `DifferentiableTeams`.

    Raises:
        ValueError: If not; the message names what is in its way, and the remedy.
    """
    require_measured(options)
    if separation is not None and not separation >= options.separation:
        raise ValueError(
            f"hyperparameter separation must be at least the task's own, {options.separation:g} m, got "
            f"{shown(separation)} m"
        )
    if options.reward != "bounded":
        raise ValueError(f"the analytic policy gradient needs reward='bounded', got {shown(options.reward)}")
    if options.comm == "plan":
        raise ValueError(
            "the analytic policy gradient does not pass through plans that vehicles send: choose comm='state'"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they were given
        again = replace(options).graphs
    if not all(map(np.array_equal, again, options.graphs)):
        raise ValueError(
            f"graph {shown(options.graph)} is drawn at random: it gives other neighbours each time that it "
            "is asked, and comm slots of a network belong to fixed ones. Give edges, a matrix or a schedule "
            "(Switching, Timed), or let messages be lost at random with drop_out"
        )
