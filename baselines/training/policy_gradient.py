"""Analytic policy gradient: the reward's gradient by backpropagation through the compiled dynamics.

Model-based: it knows the equations of motion and the reward. Windows of some steps of many flights are rolled
out and taken back; flights go on from window to window. The objective is
sum_t gamma^t (log(r_t + eps) - w c_t) with the violation cost c: the gradient of the bounded reward itself
vanishes where a flight is far off and where a violation exceeds its scale. Evaluation is on the reward alone.
In a team all vehicles share the network, and each one's objective moves those that it hears and senses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from quad_envs.envs.team.options import TeamOptions
from quad_envs.envs.tracking.options import TrackingOptions
from quad_envs.observations.features import Features
from quad_envs.wrappers.encoding import hover_actions, hover_slopes

from ..errors import TrainingError
from ..policies.network import Floats, Network, Squash
from .algorithm_options import PolicyGradientOptions
from .beginning import require_continuable
from .differentiable import Flights, S
from .features import require_own_axes, training_features
from .flights import DifferentiableFlights
from .held_out import Progress, Training
from .team_flights import DifferentiableTeams, require_differentiable


class Actor:
    """A tanh network in torch.

    Args:
        inputs: Number of features.
        hidden: Widths of its layers.
        outputs: Numbers that it gives.
        squash: "tanh": outputs lie in [-1, 1]; "clip": they are left as they are, and flights clip them.
    """

    def __init__(self, inputs: int, hidden: tuple[int, ...], outputs: int, squash: Squash = "tanh") -> None:
        import torch

        self.squash = squash
        sizes = (inputs, *hidden, outputs)
        self.layers = [torch.nn.Linear(a, b) for a, b in pairwise(sizes)]
        with torch.no_grad():  # begins near hover
            self.layers[-1].weight.mul_(0.1)
            self.layers[-1].bias.zero_()
        self.parameters = [parameter for layer in self.layers for parameter in layer.parameters()]

    def __call__(self, x: Any) -> Any:
        """Outputs for scaled features (n, inputs), (n, outputs)."""
        from .tanh import fast_tanh_

        for layer in self.layers[:-1]:
            x = fast_tanh_(layer(x))
        x = self.layers[-1](x)
        return fast_tanh_(x) if self.squash == "tanh" else x

    def load(self, network: Network, features: Features) -> None:
        """Take over the weights of a network.

        Raises:
            ValueError: If it has other layers, or sees something else than `features`.
        """
        import torch

        *hidden, outputs = [layer.out_features for layer in self.layers]
        require_continuable(network, features, tuple(hidden), outputs, self.squash)
        with torch.no_grad():
            for layer, W, b in zip(self.layers, network.weights, network.biases, strict=True):
                layer.weight.copy_(torch.from_numpy(W.T.copy()))
                layer.bias.copy_(torch.from_numpy(b))

    def arrays(self) -> tuple[tuple[Floats, ...], tuple[Floats, ...]]:
        """Weights (inputs, outputs) and biases as numpy arrays."""
        return (
            tuple(np.ascontiguousarray(layer.weight.detach().numpy().T) for layer in self.layers),
            tuple(layer.bias.detach().numpy().copy() for layer in self.layers),
        )


def _window_gradient(
    actor: Actor,
    flights: Flights[S],
    options: PolicyGradientOptions,
    n_steps: int,
    epsilon: float,
) -> float:
    """Roll a window out, take it back, leave the gradient in the actor's parameters; the mean reward."""
    import torch

    seen, outputs, records = [], [], []
    flights.begin_window(n_steps)
    for _ in range(n_steps):
        x = torch.from_numpy(flights.observe()).requires_grad_()
        out = actor(x)
        seen.append(x)
        outputs.append(out)
        commanded = np.clip(out.detach().numpy(), -1.0, 1.0)
        records.append(flights.advance(hover_actions(commanded, flights.task)))
    n = flights.n
    plants, commands = np.zeros((n, 16)), np.zeros((n, 4))
    for t in range(n_steps - 1, -1, -1):
        record, x, out = records[t], seen[t], outputs[t]
        weight = -(options.gamma**t) / (n * n_steps)
        rewards = np.where(record.crashed, 0.0, weight / (record.rewards + epsilon))
        actions, plants, commands = flights.advance_vjp(
            record, plants, commands, rewards, -weight * options.penalty
        )
        asked = out.detach().numpy()
        slopes = hover_slopes(asked, flights.task) * (np.abs(asked) <= 1.0)
        out.backward(torch.from_numpy((actions * slopes).astype(np.float32)))
        assert x.grad is not None
        own, last = flights.observe_vjp(record, x.grad.numpy())
        plants, commands = plants + own, commands + last
    return float(np.mean([record.rewards for record in records]))


def check(
    task_options: TrackingOptions | TeamOptions, options: PolicyGradientOptions, start: Network | None = None
) -> None:
    """Refuse what `train` would, before anything is written.

    Raises:
        ValueError: If the task cannot be differentiated, a hyperparameter is for the other kind of task, or
            training cannot go on from `start`.
    """
    if isinstance(task_options, TeamOptions):
        require_differentiable(task_options, options.separation)
        require_own_axes(task_options, options.heading_axes)
    else:
        for name in ("stages", "separation", "episode_steps"):
            if getattr(options, name) is not None:
                raise ValueError(
                    f"hyperparameter {name} = {getattr(options, name)!r} is for teams: leave it out"
                )
    if start is not None:
        sees = options.disturbance_estimate, options.heading_axes
        features = training_features(task_options, options.stages, *sees)
        require_continuable(start, features, options.net_arch, 4, options.squash)


def _flights_of(
    task_options: TrackingOptions | TeamOptions, options: PolicyGradientOptions, seed: int
) -> Flights[Any]:
    """Flights to train in."""
    check(task_options, options)
    if isinstance(task_options, TeamOptions):
        longest = task_options.task.episode_steps
        cycles = min(options.episode_steps or longest, longest)
        trained = replace(task_options, terminate="team", substeps=options.substeps, max_cycles=cycles)
        features = training_features(trained, options.stages, options.disturbance_estimate)
        return DifferentiableTeams(trained, options.n_envs, seed, features, options.separation)
    flown = replace(task_options, substeps=options.substeps)
    features = training_features(flown, None, options.disturbance_estimate, options.heading_axes)
    return DifferentiableFlights(flown, options.n_envs, seed, features)


def train(
    task_options: TrackingOptions | TeamOptions,
    options: PolicyGradientOptions,
    seed: int,
    spent: Callable[[], float],
    start: Network | None = None,
) -> Training:
    """Train, see `algorithms`, and yield after each update.

    Raises:
        ValueError: If the task cannot be differentiated.
        TrainingError: If the gradient is not finite.
    """
    import torch

    torch.manual_seed(seed)
    flights = _flights_of(task_options, options, seed)
    actor = Actor(len(flights.features.names), options.net_arch, 4, options.squash)
    if start is not None:
        actor.load(start, flights.features)
    optimizer = torch.optim.Adam(actor.parameters, lr=options.learning_rate)
    update, steps = 0, 0
    while (share := spent()) < 1.0:
        for group in optimizer.param_groups:
            group["lr"] = options.learning_rate * (1.0 - (1.0 - options.final_rate) * share)
        optimizer.zero_grad()
        epsilon = options.epsilon * (options.final_epsilon / options.epsilon) ** share
        n_steps = round(options.n_steps + share * (options.final_n_steps - options.n_steps))
        reward = _window_gradient(actor, flights, options, n_steps, epsilon)
        norm = float(torch.nn.utils.clip_grad_norm_(actor.parameters, options.max_grad_norm))
        if not np.isfinite(norm):
            raise TrainingError(f"the gradient is {norm} at update {update}: the last good policy is kept")
        optimizer.step()
        update += 1
        steps += flights.n * n_steps
        network = Network(flights.features, *actor.arrays(), squash=options.squash)
        yield Progress(update, steps, reward), network
