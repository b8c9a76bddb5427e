"""A network as the policy that it was trained to be: with estimates of the disturbance, of a target."""

from __future__ import annotations

from quad_envs.tasks import BaseTask

from .estimators import Estimators, asks_for_estimates
from .network import Network, NetworkPolicy
from .protocol import Actions, PolicyState
from .row_policy import Flags, RowPolicy
from .rows import require_finite


class EstimatingPolicy(RowPolicy):
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
        super().__init__(self._estimators.given, name, self._estimators.memory_size)
        self.network, self.kind = network, kind

    def _decide(self, obs: Actions, state: PolicyState, start: Flags) -> tuple[Actions, PolicyState]:
        require_finite(obs, self.task.layout.slices)
        seen, memory, targets = self._estimators.extend(obs, state.memory, start)
        actions, _ = self._network.predict(seen)
        return actions, state._replace(memory=memory, estimates=targets)


def network_policy(
    network: Network, task: BaseTask, name: str, kind: str = ""
) -> NetworkPolicy | EstimatingPolicy:
    """The policy of a network; arguments as of `NetworkPolicy`.

    Raises:
        ValueError: If the task does not fit it.
    """
    made = EstimatingPolicy if asks_for_estimates(network.features, task) else NetworkPolicy
    return made(network, task, name, kind)
