"""A network as the policy that it was trained to be: with estimates of the disturbance, of a target."""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike, NDArray

from quad_envs.tasks import BaseTask

from .estimators import Estimators, asks_for_estimates
from .network import Network, NetworkPolicy
from .protocol import Actions, PolicyState
from .rows import as_rows, as_starts, require_finite, state_of


class EstimatingPolicy:
    """A network that sees an estimate; what the estimators remember travels in the state.

    Args:
        network: Whose features have an estimate, of the disturbance, of the target or of both.
        task: Where it flies, without the estimate.
        name: For tables.
        kind: What it knows: "model-free", "imitation" or "model-based".

    Raises:
        ValueError: If there is nothing of the kind to estimate in the task, or it does not fit the network.
    """

    # Of the task: what it sees, the scale of its outputs, and what estimators take for nominal.
    decides_from = (
        *("layout", "limits.kappa", "params", "dt", "sensor_noise"),
        *("sensor", "sensor_sigma", "prior_velocity", "prior_sigma"),
    )

    def __init__(self, network: Network, task: BaseTask, name: str, kind: str = "") -> None:
        self._estimators = Estimators(network.features, task)
        self._network = NetworkPolicy(network, self._estimators.task, name, kind)
        self.network, self.task, self.name, self.kind = network, self._estimators.given, name, kind

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
        kept = state_of(state, len(obs), self._estimators.memory_size)
        seen, memory, targets = self._estimators.extend(obs, kept.memory, start)
        actions, _ = self._network.predict(seen)
        return actions[0] if one else actions, kept._replace(memory=memory, estimates=targets)


def network_policy(
    network: Network, task: BaseTask, name: str, kind: str = ""
) -> NetworkPolicy | EstimatingPolicy:
    """The policy of a network; arguments as of `NetworkPolicy`.

    Raises:
        ValueError: If the task does not fit it.
    """
    made = EstimatingPolicy if asks_for_estimates(network.features, task) else NetworkPolicy
    return made(network, task, name, kind)
