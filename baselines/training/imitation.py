"""DAgger: imitation of a policy, labelled in the states that the network itself brings about.

The expert, an MPC by default, decides in every state; at first it also flies, later the network does. The
network is fitted to all labels so far, the longer the more there are. An expert that remembers more than its
observation shows cannot be imitated by a network that remembers nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from quad_envs.arguments.names import shown
from quad_envs.envs.team.options import TeamOptions
from quad_envs.envs.team.vector import TeamVectorEnv
from quad_envs.envs.tracking.options import TrackingOptions
from quad_envs.envs.tracking.vector import TrackingVectorEnv
from quad_envs.tasks import BaseTask, TeamTask
from quad_envs.wrappers.encoding import Encoding, hover_outputs

from ..errors import TrainingError
from ..evaluation.rollout import is_privileged
from ..policies.network import Floats, Network
from ..policies.network_policies import network_policy
from ..policies.protocol import Policy
from ..policies.registry import is_trained, make_policy, policy_name, policy_options
from .algorithm_options import DaggerOptions
from .beginning import require_continuable
from .features import require_measured, training_features
from .held_out import Progress, Training
from .observer import Observer
from .policy_gradient import Actor

if TYPE_CHECKING:
    import torch

_EXPERTS = {"tracking": "sdc-nmpc", "formation": "consensus-mpc", "target-tracking": "cooperative-mpc"}
_STREAM = 0xDA_66E2  # apart from the seeds of environments, so that no start is one of those held out


class LabelledFlights:
    """Flights of which every state is labelled with what an expert would do.

    Args:
        options: Of the task.
        expert: Decides from observations.
        rows: Number of flights, or of vehicles in as many teams as that makes.
        seed: Of the starts, and of who flies.
        stages: Of the preview that the network sees; None for the usual ones.
        disturbance_estimate: Whether it sees an estimate of the disturbance.
        heading_axes: Whether it sees in axes turned to the heading of the reference.
    """

    def __init__(
        self,
        options: TrackingOptions | TeamOptions,
        expert: Policy,
        rows: int,
        seed: int,
        stages: tuple[int, ...] | None = None,
        disturbance_estimate: bool = False,
        heading_axes: bool = False,
    ) -> None:
        self._size = options.vehicles if isinstance(options, TeamOptions) else 1
        count = max(1, rows // self._size)
        if isinstance(options, TeamOptions):
            self.env: TeamVectorEnv | TrackingVectorEnv = TeamVectorEnv(options, count)
        else:
            given = {field.name: getattr(options, field.name) for field in fields(options) if field.init}
            self.env = TrackingVectorEnv(count, **given)
        self.task: BaseTask = self.env.task
        encoding = Encoding(training_features(options, stages, disturbance_estimate, heading_axes))
        self._observer = Observer(encoding, self.task, self.env.num_envs)
        self.encoder = self._observer.encoder
        self.outputs = self.task.action_size if isinstance(self.task, TeamTask) else 4
        sequence = np.random.SeedSequence([_STREAM, seed])
        self._rng = np.random.default_rng(sequence)
        self._expert = expert
        self._observations, _ = self.env.reset(seed=sequence.generate_state(count, np.uint64).tolist())
        self._state: Any = None  # of the expert
        self._flown: Any = None  # of the network
        n = self.env.num_envs
        self._begins, self._done = np.ones(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)

    def collect(self, network: Network, beta: float, steps: int) -> tuple[Floats, Floats, float]:
        """Fly on.

        Args:
            network: Flies the rows that the expert does not.
            beta: Share of the rows that the expert flies.
            steps: Of every row.

        Returns:
            Scaled features (m, inputs), the expert's outputs (m, outputs) and the mean reward.
        """
        flier = network_policy(network, self.task, "learner")
        by_expert = (self._rng.random(self.env.num_envs) < beta)[:, None]
        seen, wanted, rewards = [], [], []
        for _ in range(steps):
            labels, self._state = self._expert.predict(self._observations, self._state, self._begins)
            if not np.isfinite(labels).all():
                raise ValueError(
                    f"the expert {policy_name(self._expert)!r} answers with actions that are not finite, "
                    "which nobody can imitate: choose another one (--hyper expert=sdc-nmpc)"
                )
            own, self._flown = flier.predict(self._observations, self._flown, self._begins)
            actions = np.where(by_expert, labels, own)
            flies = ~self._done  # a row that is done begins anew in this step, whatever the action
            seen.append(self._observer.see(self._observations, self._begins)[flies])
            wanted.append(hover_outputs(labels[flies], self.task))
            self._observations, reward, terminated, truncated, _ = self.env.step(actions)
            rewards.append(reward[flies])
            # A team begins anew when all of its vehicles are done.
            self._begins = np.repeat(self._done.reshape(-1, self._size).all(axis=1), self._size)
            self._done = terminated | truncated
        return np.concatenate(seen), np.concatenate(wanted), float(np.concatenate(rewards).mean())


class Labels:
    """All labels so far, in arrays that grow by doubling."""

    def __init__(self, inputs: int, outputs: int) -> None:
        self.count = 0
        self._x, self._y = np.empty((4096, inputs), np.float32), np.empty((4096, outputs), np.float32)

    def add(self, x: Floats, y: Floats) -> None:
        """Append rows."""
        last = self.count + len(x)
        while last > len(self._x):
            self._x, self._y = (np.concatenate([part, np.empty_like(part)]) for part in (self._x, self._y))
        self._x[self.count : last], self._y[self.count : last] = x, y
        self.count = last

    def draw(self, n: int, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """Rows at random, n of them."""
        import torch

        rows = rng.integers(0, self.count, n)
        return torch.from_numpy(self._x[rows]), torch.from_numpy(self._y[rows])


def make_expert(
    name: str,
    task: BaseTask,
    separation: float | None = None,
    reject_disturbance: bool = False,
    options: Mapping[str, Any] | None = None,
) -> Policy:
    """The policy to imitate.

    Args:
        name: Of the policy; empty for the one of the mission.
        task: Where it flies.
        separation: Distance that it keeps, m: what imitates it is less exact, and between the task's
            separation and a crash are 7 cm. None for the task's own.
        reject_disturbance: Whether an MPC estimates and rejects disturbances, for who sees the estimate.
        options: Of the policy, which come before these.

    Raises:
        ValueError: If it is unknown, has no such option, sees more than observations, or remembers what a
            network cannot.
    """
    mission = task.mission
    if not name and mission not in _EXPERTS:
        raise ValueError(
            f"dagger has no expert for {mission} tasks, whose actions are estimates: take "
            "quad/TargetTracking-v0"
        )
    if separation is not None:
        if not isinstance(task, TeamTask) or not separation >= task.separation:
            raise ValueError(
                f"hyperparameter separation is for teams, and at least their own, got {shown(separation)} m"
            )
        task = replace(task, separation=separation)
    name = name or _EXPERTS[mission]
    rejects = reject_disturbance and not is_trained(name) and "reject_disturbance" in policy_options(name)
    given = {"reject_disturbance": True} if rejects else {}
    expert = make_policy(name, task, **given | dict(options or {}))
    if is_privileged(expert):
        raise ValueError(
            f"expert {name!r} decides from the whole truth, a network from observations; choose another"
        )
    return expert


def _expert_of(task: BaseTask, options: DaggerOptions) -> Policy:
    return make_expert(
        options.expert, task, options.separation, options.disturbance_estimate, options.expert_options
    )


def check(
    task_options: TrackingOptions | TeamOptions, options: DaggerOptions, start: Network | None = None
) -> None:
    """Refuse what `train` would, before anything is written.

    Raises:
        ValueError: If the expert is not allowed, nobody measures a target, a hyperparameter is for teams, or
            training cannot go on from `start`.
    """
    task = task_options.task
    _expert_of(task, options)
    if isinstance(task_options, TeamOptions):
        require_measured(task_options)
    elif options.episode_steps is not None:
        raise ValueError(
            f"hyperparameter episode_steps = {options.episode_steps!r} is for teams: leave it out"
        )
    if start is not None:
        sees = options.disturbance_estimate, options.heading_axes
        features = training_features(task_options, options.stages, *sees)
        outputs = task.action_size if isinstance(task, TeamTask) else 4
        require_continuable(start, features, options.net_arch, outputs, options.squash)


def train(
    task_options: TrackingOptions | TeamOptions,
    options: DaggerOptions,
    seed: int,
    spent: Callable[[], float],
    start: Network | None = None,
) -> Training:
    """Train, see `algorithms`, and yield after each window.

    Raises:
        ValueError: If the expert is not allowed.
        TrainingError: If the loss is not finite.
    """
    import torch

    torch.manual_seed(seed)
    expert = _expert_of(task_options.task, options)
    check(task_options, options)
    if isinstance(task_options, TeamOptions) and options.episode_steps is not None:
        task_options = replace(task_options, max_cycles=options.episode_steps)
    flights = LabelledFlights(
        task_options,
        expert,
        options.n_envs,
        seed,
        options.stages,
        options.disturbance_estimate,
        options.heading_axes,
    )
    features, outputs = flights.encoder.encoding.features, flights.outputs
    actor = Actor(len(features.names), options.net_arch, outputs, options.squash)
    if start is not None:
        actor.load(start, features)
    labels, rng = Labels(len(features.names), outputs), np.random.default_rng([_STREAM, seed, 1])
    optimizer = torch.optim.Adam(actor.parameters, lr=options.learning_rate)
    network, update = Network(features, *actor.arrays(), squash=options.squash), 0
    while (share := spent()) < 1.0:
        beta = 0.0 if options.expert_flies <= 0.0 else max(0.0, 1.0 - share / options.expert_flies)
        x, y, reward = flights.collect(network, beta, options.n_steps)
        labels.add(x, y)
        for group in optimizer.param_groups:
            group["lr"] = options.learning_rate * (1.0 - (1.0 - options.final_rate) * share)
        update += 1
        first, last = options.gradient_steps, options.final_gradient_steps
        loss = _fit(actor, optimizer, labels, options, round(first + share * (last - first)), rng)
        if not np.isfinite(loss):
            raise TrainingError(f"the loss is {loss} at update {update}: the last good policy is kept")
        network = Network(features, *actor.arrays(), squash=options.squash)
        yield Progress(update, labels.count, reward), network


def _fit(
    actor: Actor,
    optimizer: torch.optim.Optimizer,
    labels: Labels,
    options: DaggerOptions,
    gradient_steps: int,
    rng: np.random.Generator,
) -> float:
    """Some minibatches; the last loss."""
    import torch

    loss = torch.zeros(())
    for _ in range(gradient_steps):
        x, y = labels.draw(options.batch_size, rng)
        optimizer.zero_grad()
        loss = torch.nn.functional.huber_loss(actor(x), y, delta=options.threshold)
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    return float(loss.detach())
