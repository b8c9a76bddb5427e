"""The table of ids: each is one environment class with its default keyword arguments."""

from __future__ import annotations

from typing import Any, NoReturn

import gymnasium
import pettingzoo
from gymnasium.envs.registration import EnvSpec

from .arguments.names import shown
from .episode_limit import SuiteSpec

ENTRY = "quad_envs.envs.tracking.env:TrackingEnv"
VECTOR_ENTRY = "quad_envs.envs.tracking.vector:TrackingVectorEnv"

TIME_LIMIT, DT = 10.0, 0.05  # s, length of an episode and control period, where nothing else is said
# Defaults of each tracking id; any keyword argument of TrackingEnv overrides them in `gymnasium.make`.
TRACKING: dict[str, dict[str, Any]] = {
    "quad/Regulation-v0": {"reference": "setpoint", "start_box": 3.0},
    "quad/HelixTracking-v0": {"reference": "helix"},
    "quad/SpiralTracking-v0": {"reference": "spiral"},
    "quad/LineTracking-v0": {"reference": "lines"},
    "quad/LemniscateTracking-v0": {"reference": "lemniscate"},
    "quad/RandomTracking-v0": {"reference": "random"},
    # Where constraints bind: along the walls, faster than the speed limit, with weak and slow rotors, from
    # anywhere in the box. An MPC that ignores its state rows violates them in about half of the steps.
    "quad/CorridorTracking-v0": {
        "reference": "racetrack",
        "kappa": 0.3125,
        "rate_limit": 5.0,
        "tilt_limit": 0.35,
        "velocity_limit": 1.8,
        "position_limit": ((-2.0, -1.2, -1.0), (2.0, 1.2, 1.0)),
        "start_box": (1.5, 0.8, 0.6),
        "time_limit": 15.0,
    },
}


# The multi-agent ids; the module has `parallel_env`, `env` and `vector_env`.
TEAMS: dict[str, str] = {
    "quad/Formation-v0": "quad_envs.formation_v0",
    "quad/TargetTracking-v0": "quad_envs.target_tracking_v0",
    "quad/CooperativeEstimation-v0": "quad_envs.cooperative_estimation_v0",
}


# Mean reward of a step of exact NMPC over 20 starts from seed 0, `quad-envs evaluate ID nmpc`. Times the
# steps of an episode this is the id's `reward_threshold`: who reaches it flies as well as the yardstick.
NMPC_SCORES: dict[str, float] = {
    "quad/Regulation-v0": 0.815,
    "quad/HelixTracking-v0": 0.820,
    "quad/SpiralTracking-v0": 0.745,
    "quad/LineTracking-v0": 0.810,
    "quad/LemniscateTracking-v0": 0.806,
    "quad/RandomTracking-v0": 0.813,
    "quad/CorridorTracking-v0": 0.508,
}


def tracking_spec(env_id: str, defaults: dict[str, Any]) -> SuiteSpec:
    """What Gymnasium knows of an id."""
    steps = round(defaults.get("time_limit", TIME_LIMIT) / defaults.get("dt", DT))
    return SuiteSpec(
        env_id,
        entry_point=ENTRY,
        vector_entry_point=VECTOR_ENTRY,
        max_episode_steps=steps,
        reward_threshold=round(NMPC_SCORES[env_id] * steps, 6),
        kwargs={"env_id": env_id, **defaults},
    )


def refuse_team(env_id: str, num_envs: int = 8, **kwargs: Any) -> NoReturn:
    """What `gymnasium.make` and `make_vec` call for an id of several vehicles.

    Raises:
        gymnasium.error.NameNotFound: Always; it shows the lines that make the environment.
    """
    module = TEAMS[env_id]
    given = [f"{name}={shown(value)}" for name, value in kwargs.items() if value is not None]
    raise gymnasium.error.NameNotFound(
        f"{env_id} has several vehicles: it is a PettingZoo environment, not one of Gymnasium. Make it with "
        f"{module}.parallel_env({', '.join(given)}), or many teams in one call with "
        f"{module}.vector_env({', '.join([f'num_teams={num_envs}', *given])})"
    )


def register() -> None:
    """Register every id with Gymnasium or PettingZoo; calling it again changes nothing.

    Gymnasium knows the ids of teams, too, so that it says where they are.
    """
    for env_id, defaults in TRACKING.items():
        if env_id not in gymnasium.registry:
            gymnasium.registry[env_id] = tracking_spec(env_id, defaults)
    for env_id in TEAMS:
        if env_id not in gymnasium.registry:
            entry, own = f"{__name__}:{refuse_team.__name__}", {"env_id": env_id}
            gymnasium.registry[env_id] = EnvSpec(
                env_id, entry_point=entry, vector_entry_point=entry, kwargs=own
            )
    if hasattr(pettingzoo, "register"):  # from PettingZoo 1.27 on
        for env_id, module in TEAMS.items():
            if env_id not in pettingzoo.parallel_registry:
                pettingzoo.register("parallel", env_id, f"{module}:parallel_env")
                pettingzoo.register("aec", env_id, f"{module}:env")
