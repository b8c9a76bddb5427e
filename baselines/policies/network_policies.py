"""A network as the policy that it was trained to be: with an estimate of the disturbance or of a target."""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike, NDArray

from quad_envs.tasks import BaseTask, TeamTask

from .disturbance_estimate import DisturbanceEstimator, sees_estimate
from .network import Network, NetworkPolicy
from .protocol import Actions, PolicyState
from .rows import as_rows, as_starts, require_finite, state_of
from .target_estimate import TargetBelief, sees_target_estimate


class EstimatingPolicy:
    """A network that sees an estimate; what the estimator remembers travels in the state.

    Args:
        network: Whose features have an estimate, of the disturbance or of the target.
        task: Where it flies, without the estimate.
        name: For tables.
        kind: What it knows: "model-free", "imitation" or "model-based".

    Raises:
        ValueError: If there is nothing of the kind to estimate in the task, or it does not fit the network.
    """

    # Of the task: what it sees, the scale of its outputs, and what the estimator takes for nominal.
    decides_from = (
        *("layout", "limits.kappa", "params", "dt", "sensor_noise"),
        *("sensor", "sensor_sigma", "prior_velocity", "prior_sigma"),
    )

    def __init__(self, network: Network, task: BaseTask, name: str, kind: str = "") -> None:
        self._estimator: DisturbanceEstimator | TargetBelief
        if isinstance(task, TeamTask) and sees_target_estimate(network.features, task):
            self._estimator = TargetBelief(task)
        else:
            self._estimator = DisturbanceEstimator(task)
        self._network = NetworkPolicy(network, self._estimator.task, name, kind)
        self.network, self.task, self.name, self.kind = network, self._estimator.given, name, kind

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.name!r}, {self.task.env_id!r})"

    def predict(
        self,
        observation: NDArray[Any],
        state: PolicyState | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Actions, PolicyState]:
        """Choose actions; see `Policy` and `NetworkPolicy.predict`.

        Raises:
            ValueError: If a shape is wrong or an observation is not finite; it names the part.
        """
        obs, one = as_rows(observation, self.task.layout.size)
        require_finite(obs, self.task.layout.slices)
        start = as_starts(episode_start, len(obs))
        kept = state_of(state, len(obs), self._estimator.memory_size)
        if isinstance(self._estimator, TargetBelief):
            seen, memory, estimates = self._estimator.believe(obs, kept.memory, start)
            kept = kept._replace(estimates=estimates)
        else:
            seen, memory = self._estimator.extend(obs, kept.memory, start)
        actions, _ = self._network.predict(seen)
        return actions[0] if one else actions, kept._replace(memory=memory)


def network_policy(
    network: Network, task: BaseTask, name: str, kind: str = ""
) -> NetworkPolicy | EstimatingPolicy:
    """The policy of a network; arguments as of `NetworkPolicy`.

    Raises:
        ValueError: If the task does not fit it.
    """
    estimates = sees_estimate(network.features) or sees_target_estimate(network.features, task)
    made = EstimatingPolicy if estimates else NetworkPolicy
    return made(network, task, name, kind)
