"""Certificates of chapter 9 for a policy in an environment: what the theory says of it, and what not."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from controllers.model import hover_pair
from controllers.qp.riccati import lqr_gain
from controllers.stability.certificates import Decrease, linear_matrix_inequality, terminal_decrease
from controllers.stability.invariant import (
    Ellipsoid,
    Halfspaces,
    inscribed_ellipsoid,
    largest_ellipsoid,
    law_halfspaces,
)
from quad_envs.arguments.checks import require_whole
from quad_envs.parameters import Array

from ..files import plain_json
from ..policies.environments import make_env
from ..policies.registry import TRACKING_POLICIES, is_trained, make_policy, policy_options
from . import verdicts
from .flight import Trace, fly
from .region import Stay, linear_stay, random_starts, shrunk_stay
from .verdicts import Certificate

CERTIFIABLE = ("lmpc", "sdc-nmpc", "sdre", "lqr", "nmpc")  # the last one at hover alone
_AT_HOVER_ALONE = ("nmpc",)
_MOST_STARTS, _START_BYTES = 100_000, 10_000  # plants, windows and memories of an MPC
_LARGEST = "largest-ellipsoid", "Largest invariant ellipsoid inside the limits (max log det, LMI)"
_INSCRIBED = "ellipsoid", "Invariant ellipsoid of the Riccati weight inside the limits"


class Region(NamedTuple):
    """An ellipsoid with what became of the starts in it."""

    ellipsoid: Ellipsoid
    linear: Stay
    plant: list[Stay]


class Report(NamedTuple):
    """All certificates of one policy, and what the figures are drawn from."""

    env: str
    policy: str
    options: Mapping[str, Any]
    seed: int
    certificates: list[Certificate]
    trace: Trace | None  # None where the policy can be certified at hover alone
    gain: Array  # (4, 12), terminal gain at hover
    limits: Halfspaces
    regions: dict[str, Region]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        found: dict[str, Any] = plain_json(
            {
                "env": self.env,
                "policy": self.policy,
                "options": dict(self.options),
                "seed": self.seed,
                "certificates": [certificate._asdict() for certificate in self.certificates],
            }
        )
        return found

    def __str__(self) -> str:
        head = f"{self.policy} in {self.env}, flight from seed {self.seed}"
        return "\n\n".join([head, *map(str, self.certificates)])


def certify(
    env_id: str,
    policy_name: str,
    *,
    env_kwargs: Mapping[str, Any] | None = None,
    policy_kwargs: Mapping[str, Any] | None = None,
    seed: int = 0,
    starts: int = 100,
    on_step: Callable[[], Any] = lambda: None,
) -> Report:
    """Examine a policy by the theory of chapter 9.

    Args:
        env_id: A tracking environment.
        policy_name: One of CERTIFIABLE.
        env_kwargs: Keyword arguments of the environment.
        policy_kwargs: Options of the policy.
        seed: Of the flight and of the random starts.
        starts: Number of random starts in each ellipsoid.
        on_step: Called after each of the four parts.

    Raises:
        ValueError: If a name or an option is not allowed, or the policy has no terminal weight to certify.
    """
    require_whole("seed", seed, 0)
    require_whole("starts", starts, 2, _MOST_STARTS, lambda n: n * _START_BYTES)
    options = dict(policy_kwargs or {})
    _require_certifiable(policy_name, options)
    env, policy = _make(env_id, policy_name, dict(env_kwargs or {}), options)
    hover = _hover(policy)
    found = [verdicts.terminal_inequality(hover.decrease, hover.smallest)]
    on_step()
    trace = None
    if policy_name in _AT_HOVER_ALONE:
        reason = (
            f"{policy_name} linearises anew along each plan; chapter 9 has one pair of matrices per sample"
        )
        found.append(verdicts.not_computed("descent", "Descent and feasibility along the flight", reason))
    else:
        trace = fly(policy, env, seed)
        found += [verdicts.terminal_limits(trace), verdicts.value_descent(trace)]
        found += [verdicts.frozen_inequality(trace)] if policy_name in ("sdc-nmpc", "sdre") else []
    on_step()
    regions = {}
    for (key, title), make in (_INSCRIBED, _inscribed), (_LARGEST, _largest):
        try:
            regions[key] = _region(make(hover), hover, policy.controller, starts, seed)
            found.append(verdicts.ellipsoid_verdict(key, title, *regions[key], starts))
        except ModuleNotFoundError as error:
            found.append(verdicts.not_computed(key, title, str(error)))
        on_step()
    return Report(env_id, policy_name, options, seed, found, trace, hover.K, hover.limits, regions)


class _Hover(NamedTuple):
    """The linear model at hover with its law, and the limits as the law meets them."""

    A_K: Array
    K: Array
    P: Array
    limits: Halfspaces
    decrease: Decrease
    smallest: float  # eigenvalue of the matrix of (9.16)


def _hover(policy: Any) -> _Hover:
    task = policy.task
    A, B = hover_pair(task.params, task.dt)
    Q, R = task.weights.Q_matrix(), task.weights.R_matrix()
    K, P = lqr_gain(A, B, Q, R)
    A_K = A - B @ K
    margin = getattr(getattr(policy.controller, "options", None), "margin", 0.0)  # laws keep none
    limits = law_halfspaces(task, K, A_K, margin)
    smallest = float(np.linalg.eigvalsh(linear_matrix_inequality(A, B, K, P, Q, R))[0])
    return _Hover(A_K, K, P, limits, terminal_decrease(A, B, K, P, Q, R), smallest)


def _inscribed(hover: _Hover) -> Ellipsoid:
    return inscribed_ellipsoid(hover.P, hover.limits)


def _largest(hover: _Hover) -> Ellipsoid:
    return largest_ellipsoid(hover.A_K, hover.limits)


def _region(ellipsoid: Ellipsoid, hover: _Hover, controller: Any, starts: int, seed: int) -> Region:
    points = random_starts(ellipsoid, starts, seed)
    linear = linear_stay(ellipsoid, hover.limits, hover.A_K, points)
    return Region(ellipsoid, linear, shrunk_stay(ellipsoid, hover.limits, controller, hover.K, points))


def _require_certifiable(name: str, options: Mapping[str, Any]) -> None:
    """Refuse what has no terminal weight, or a plan with more than one pair of matrices."""
    if name not in CERTIFIABLE:
        if not is_trained(name) and name not in TRACKING_POLICIES:
            policy_options(name)  # says that the name is unknown, and what is near
        raise ValueError(
            f"policy {name!r} has no terminal weight and no gain of a Riccati equation that chapter 9 could "
            f"certify; those that have: {', '.join(CERTIFIABLE)}"
        )
    if options.get("R_rate") is not None:
        raise ValueError(
            "R_rate makes the cost depend on the command before, of which the terminal cost of chapter "
            "9 knows nothing: certify without it"
        )
    if options.get("relinearisations"):
        raise ValueError(
            f"relinearisations={options['relinearisations']!r} takes new matrices along the plan, chapter 9 "
            "freezes one pair per sample: certify relinearisations=0"
        )


def _make(env_id: str, name: str, env_kwargs: dict[str, Any], options: dict[str, Any]) -> tuple[Any, Any]:
    """Environment and policy, with one sample more to see than to plan."""
    env = make_env(env_id, **env_kwargs)
    if hasattr(env, "possible_agents"):
        raise ValueError(
            f"{env_id!r} has several vehicles; chapter 9 is about one: certify a tracking environment, as "
            "quad/HelixTracking-v0"
        )
    policy: Any = make_policy(name, env, **options)
    controller = policy.controller
    if env.unwrapped.task.layout.preview <= controller.horizon:
        env.close()
        env = make_env(env_id, **{**env_kwargs, "preview": controller.horizon + 1})
        options = {**options, "horizon": controller.horizon} if controller.horizon else options
        policy = make_policy(name, env, **options)
    return env, policy
