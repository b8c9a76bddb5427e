"""What an environment's `spec` says: arguments in plain form, and how long its episodes are."""

from __future__ import annotations

from gymnasium.envs.registration import EnvSpec

from ..tracking.batch import TrackingBatch
from .plain import plain_spec


class Specified:
    """Takes the specification that Gymnasium makes, and keeps it in plain form."""

    _spec: EnvSpec | None = None
    _batch: TrackingBatch

    @property
    def spec(self) -> EnvSpec | None:
        """How to make this environment again; survives `to_json` and `EnvSpec.from_json`."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        options = self._batch.options
        steps, asked = options.episode_steps, options.max_episode_steps
        self._spec = None if spec is None else plain_spec(spec, steps, asked)
