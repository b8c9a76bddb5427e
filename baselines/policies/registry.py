"""The names that `make_policy` knows, and what it makes of them."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping
from dataclasses import fields
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from quad_envs.arguments.field_comments import field_comments
from quad_envs.arguments.kinds import holds_booleans, is_limit
from quad_envs.arguments.names import shown, unknown_name

from ..errors import CheckpointError
from .outside import build, installed_policies, is_outside, named_in_file, names_factory, outside_options
from .protocol import Policy
from .trained import load_policy, names_trained, shipped_policies
from .tuned import DESCRIPTION, names_tuned, read_tuned

if TYPE_CHECKING:  # not at run time: tasks load numba, and `quad-envs list` has to be quick
    from controllers.mpc.options import SafetyOptions
    from quad_envs.tasks import BaseTask, Task, TeamTask


class _Option(NamedTuple):
    """What is known of an option before a policy is made."""

    default: Any
    hint: str  # its annotation


class PolicyEntry(NamedTuple):
    """A row of the registry."""

    module: str
    factory: str  # name in the module: called with the task and the options
    description: str
    missions: tuple[str, ...] = ("tracking",)  # that it serves, see `BaseTask.mission`
    decision_ms: float = 0.05  # about, of a vehicle: sweeps fly the quick ones first, and estimate their time
    privileged: bool = False  # it sees `env.state()`: a yardstick, listed apart
    mpc: bool = False  # it plans with a model, and is what learned policies are asked to beat


_LEAST_PLAN = 2  # samples, of a safety filter
SAFE = "safe:"  # before the name of a policy: a safety filter stands in front of it
_FORMATION, _TARGET, _ESTIMATION = "formation", "target-tracking", "estimation"
TEAM_MISSIONS = (_FORMATION, _TARGET, _ESTIMATION)

# Names that `make_policy` knows for tracking tasks.
TRACKING_POLICIES: dict[str, PolicyEntry] = {
    "lmpc": PolicyEntry(
        "controllers",
        "LinearMPC",
        "linear MPC on the hover model (chapter 3)",
        decision_ms=0.06,
        mpc=True,
    ),
    "sdc-nmpc": PolicyEntry(
        "controllers",
        "SdcNmpc",
        "MPC on the state-dependent model (chapter 4)",
        decision_ms=0.13,
        mpc=True,
    ),
    "nmpc": PolicyEntry(
        "controllers",
        "ExactNmpc",
        "MPC on the exact model: real-time iteration, or SQP",
        decision_ms=0.2,
        mpc=True,
    ),
    "score-nmpc": PolicyEntry(
        "controllers.mpc.exact",
        "ScoreNmpc",
        "the same, planning for the score instead of the quadratic cost",
        decision_ms=0.2,
        mpc=True,
    ),
    "sdre": PolicyEntry(
        "controllers", "Sdre", "state-dependent Riccati feedback, without preview", decision_ms=0.08
    ),
    "lqr": PolicyEntry(
        "controllers", "Lqr", "constant feedback of the hover model, without preview", decision_ms=0.01
    ),
    "feedback-linearization": PolicyEntry(
        "controllers",
        "FeedbackLinearization",
        "feedback linearization with an attitude loop",
        decision_ms=0.01,
    ),
    "hover": PolicyEntry(
        "baselines.policies.tracking", "Hover", "hover thrust, whatever happens", decision_ms=0.0
    ),
    "random": PolicyEntry("baselines.policies.tracking", "Random", "uniform random actions", decision_ms=0.0),
}

# And for teams; "hover" and "random" serve both.
TEAM_POLICIES: dict[str, PolicyEntry] = {
    "consensus-mpc": PolicyEntry(
        "baselines.policies.cooperative",
        "ConsensusMpc",
        "consensus, collision avoidance and MPC of each vehicle (chapter 5)",
        (_FORMATION,),
        mpc=True,
    ),
    "cooperative-mpc": PolicyEntry(
        "baselines.policies.cooperative",
        "make_cooperative_mpc",
        "the same beside a target that it estimates (chapter 7)",
        (_TARGET, _ESTIMATION),
        mpc=True,
    ),
    "ekf": PolicyEntry(
        "baselines.policies.estimation",
        "EkfPolicy",
        "extended Kalman filter on the measurements held (chapter 6)",
        (_ESTIMATION,),
    ),
    "trilateration": PolicyEntry(
        "baselines.policies.estimation",
        "TrilaterationPolicy",
        "trilateration where four ranges allow it, else the Kalman filter (chapter 6)",
        (_ESTIMATION,),
    ),
    "central-mpc": PolicyEntry(
        "baselines.policies.central",
        "CentralMpcPolicy",
        "one MPC over the whole team, from the whole truth (8.2.3)",
        (_FORMATION, _TARGET),
        decision_ms=0.5,
        privileged=True,
    ),
    "hover": PolicyEntry(
        "baselines.policies.team",
        "TeamHover",
        "hover thrust, whatever happens",
        TEAM_MISSIONS,
        decision_ms=0.0,
    ),
    "random": PolicyEntry(
        "baselines.policies.team", "TeamRandom", "uniform random actions", TEAM_MISSIONS, decision_ms=0.0
    ),
}


def serving(mission: str) -> dict[str, PolicyEntry]:
    """The policies that serve a mission."""
    table = TRACKING_POLICIES if mission == "tracking" else TEAM_POLICIES
    return {name: entry for name, entry in table.items() if mission in entry.missions}


def policy_entry(name: str, mission: str | None = None) -> PolicyEntry:
    """The row of a policy in the registry.

    Args:
        name: Of the policy.
        mission: That it has to serve; None: any.

    Raises:
        ValueError: If there is no such policy, or it serves other missions; it names those that serve.
    """
    known = TEAM_POLICIES | TRACKING_POLICIES
    if name not in known:
        able = known if mission is None else serving(mission)
        names = [*able, *shipped_policies(), *installed_policies()]
        in_file = named_in_file(name)
        if in_file:
            raise ValueError(f"unknown policy {shown(name)}; {in_file}")
        raise ValueError(
            unknown_name("policy", name, names)
            + ", the folder of a trained one, or module:factory of your own"
        )
    if mission is None:
        return known[name]
    able = serving(mission)
    if name not in able:
        serves = " and ".join(known[name].missions)
        raise ValueError(
            f"policy {name!r} is for {serves} tasks, not for {mission}; those that are: {', '.join(able)}"
        )
    return able[name]


def behind_filter(name: str) -> str:
    """The name of the policy behind a safety filter, `safe:NAME`; of any other, itself."""
    return name.removeprefix(SAFE)


def is_mpc(name: str) -> bool:
    """Whether a name is that of an MPC that sees what others see."""
    entry = (TRACKING_POLICIES | TEAM_POLICIES).get(name)
    return entry is not None and entry.mpc


def _is_filtered(source: Any) -> bool:
    return isinstance(source, str) and source.startswith(SAFE)


def is_trained(name: str | os.PathLike[str]) -> bool:
    """Whether a name is that of a trained policy, filtered or not, and not of a controller."""
    if _is_filtered(name):
        return is_trained(behind_filter(str(name)))
    return not (name in TEAM_POLICIES | TRACKING_POLICIES or names_factory(name)) and names_trained(name)


def from_outside(source: Any) -> bool:
    """Whether a policy, or its name, is none of this suite, whose own names go before others."""
    if _is_filtered(source):
        return from_outside(behind_filter(source))
    if isinstance(source, str) and (source in TEAM_POLICIES | TRACKING_POLICIES or is_trained(source)):
        return False
    return is_outside(source)


def _factory(entry: PolicyEntry) -> Callable[..., Any]:
    found: Callable[..., Any] = getattr(import_module(entry.module), entry.factory)
    return found


def policy_name(policy: Any, otherwise: str = "") -> str:
    """Name of a policy for tables: its own, or else the other one, or else its class."""
    return str(getattr(policy, "name", otherwise or type(policy).__name__))


def policy_options(name: str) -> dict[str, Any]:
    """Options of a policy and their defaults.

    Raises:
        ValueError: If the name is unknown.
        PolicyError: If it is one of the user's that cannot be imported.
    """
    if from_outside(name) and not _is_filtered(name):
        return outside_options(name)
    return {option: known.default for option, known in _known_options(name).items()}


def policy_comments(name: str) -> dict[str, str]:
    """What the options of a policy mean, of those that say so beside a field.

    Raises:
        ValueError: If the name is unknown.
    """
    if _is_filtered(name):
        return field_comments(_filter_options())
    kind = None if from_outside(name) else _options_type(_factory(policy_entry(name)))
    return {} if kind is None else field_comments(kind)


def _filter_options() -> type[SafetyOptions]:
    from controllers.mpc.options import SafetyOptions

    return SafetyOptions


def options_type(name: str) -> type[Any] | None:
    """The dataclass of a policy's options, as of `policy_options`; None: it takes keywords, or is trained."""
    others = _is_filtered(name) or from_outside(name) or is_trained(name)
    return None if others else _options_type(_factory(policy_entry(name)))


def _options_type(factory: Callable[..., Any]) -> type[Any] | None:
    """The dataclass of the options that a factory takes behind the task; None: it takes keywords."""
    kind: type[Any] | None = getattr(factory, "options_type", None)
    return kind


def _known_options(name: str) -> dict[str, _Option]:
    """Of a policy: the fields of its options, or the parameters of its factory behind the task."""
    factory = None if _is_filtered(name) else _factory(policy_entry(name))
    kind = _filter_options() if factory is None else _options_type(factory)
    if kind is not None:
        return {field.name: _Option(field.default, str(field.type)) for field in fields(kind)}
    assert factory is not None
    parameters = list(inspect.signature(factory).parameters.values())[1:]
    return {one.name: _Option(one.default, str(one.annotation)) for one in parameters}


def _check_kind(name: str, option: str, known: _Option, value: Any) -> None:
    """Refuse a word for a number and the like; whether the number is allowed, the controller knows."""
    default, hint = known
    if "ArrayLike" in hint:
        kind, fits = "numbers", not isinstance(value, str) and not holds_booleans(value)
    elif isinstance(default, bool):
        kind, fits = "True or False", isinstance(value, bool | np.bool_)
    elif isinstance(default, int | float):
        kind, fits = "a number", is_limit(value)
    elif isinstance(default, str) and default != "auto":  # "auto" stands for a number, too
        kind, fits = "a name", isinstance(value, str)
    else:
        kind, fits = "no boolean", "Any" in hint or "bool" in hint or not isinstance(value, bool | np.bool_)
    if not fits:
        raise ValueError(
            f"{option} of policy {name!r} must be {kind}, got {shown(value)} (default {default!r})"
        )


def make_policy(name: str | os.PathLike[str] | Any, env: Any, **options: Any) -> Policy:
    """A policy for a task.

    Args:
        name: One of TRACKING_POLICIES, or for a team one of TEAM_POLICIES; or a trained or tuned policy: the
            folder of its training, or the name of a shipped one; or one of the user's: `module:factory`, the
            name of an entry point, a factory, or a policy. A factory is called with the task, or with the
            environment if its first parameter is called `env`. `safe:` before a name puts a safety filter in
            front, see `safe`; options are then those of the filter.
        env: An environment (wrapped or not), a vector environment, an id, or a Task. Only its Task is used.
        options: Of the policy, see `policy_options`; MPCs take `horizon`, `solver` and what their chapter
            offers. A horizon that is not given is 25, or the preview of the task where that is shorter.
            Feedback linearization uses the acceleration of the reference where there is a preview.

    Raises:
        ValueError: If the name, an option or its value is not allowed, the policy is for other tasks, or the
            horizon exceeds the preview.
        CheckpointError: If a trained or tuned policy cannot be read, or is for other tasks.
        PolicyError: If one of the user's cannot be made; the message names the line of the user's file.
    """
    from .environments import environment_of, task_of

    if _is_filtered(name):
        return safe(behind_filter(str(name)), env, **options)
    if from_outside(name):
        made: Policy = build(name, lambda: task_of(env), lambda: environment_of(env), options)
        return made
    if is_trained(name) and names_tuned(name):
        if options:
            raise ValueError(f"a tuned policy has the options that were found, got {', '.join(options)}")
        tuned = read_tuned(name, task_of(env))
        if tuned.policy not in TEAM_POLICIES | TRACKING_POLICIES:  # nor may a file say what code to run
            raise CheckpointError(
                f"tuned policy {os.fspath(name)!r}: policy {shown(tuned.policy)} in {DESCRIPTION} is none "
                "that can be tuned; tune again with quad-envs tune"
            )
        policy: Any = make_policy(tuned.policy, env, **tuned.options)
        policy.name = os.path.basename(os.path.abspath(name))
        return cast("Policy", policy)
    if is_trained(name):
        if options:
            raise ValueError(f"a trained policy has no options, got {', '.join(options)}")
        return load_policy(name, env)
    name = str(name)
    known = _known_options(name)
    _check_options(name, known, options)
    defaults = {option: each.default for option, each in known.items()}
    task: BaseTask = task_of(env)
    factory = _factory(policy_entry(name, task.mission))
    if task.mission in TEAM_MISSIONS:
        return _make_team_policy(name, factory, cast("TeamTask", task), defaults, options)
    return _make_tracking_policy(name, factory, cast("Task", task), defaults, options)


def safe(policy: str | os.PathLike[str] | Any, env: Any, **options: Any) -> Policy:
    """A policy behind a predictive safety filter, so that it keeps the limits of its task.

    Each command, within rate limit and rotor box, is kept as far as an MPC with hard limits can go on from
    it, see `controllers.SafetyFilter`. Where the policy answers with NaN the MPC's own command is taken.

    Args:
        policy: Anything with `predict`, or what `make_policy` takes: a name, a folder, `module:factory`.
        env: As for `make_policy`.
        options: Of the filter, see `controllers.SafetyOptions`: `margin`, `weight`, `horizon`,
            `reject_disturbance`, ... A horizon that is not given is 25, or the preview where that is shorter.

    Raises:
        ValueError: If the task has no limits or several vehicles, the policy is filtered already, or an
            option is not allowed.
    """
    from .environments import task_of
    from .safe import SafePolicy, task_to_keep

    task = task_to_keep(task_of(env))
    if isinstance(policy, str) and _is_filtered(policy):
        raise ValueError(f"policy {policy!r} has a safety filter already: one is enough, name it without")
    known = _known_options(SAFE)
    _check_options(f"{SAFE}NAME", known, options)
    preview = task.layout.preview
    kind = _filter_options()
    if preview < _LEAST_PLAN:
        raise ValueError(
            f"a safety filter plans {_LEAST_PLAN} samples along the preview or more, the observation has "
            f"{preview}: gym.make({task.env_id!r}, preview=25)"
        )
    options.setdefault("horizon", min(known["horizon"].default, preview))
    if isinstance(options["horizon"], int) and options["horizon"] > preview:
        raise ValueError(
            f"a safety filter looks {options['horizon']} steps ahead, the observation {preview}: choose "
            f"horizon <= {preview}, or gym.make({task.env_id!r}, preview={options['horizon']})"
        )
    made = make_policy(policy, env)
    name = os.fspath(policy) if isinstance(policy, str | os.PathLike) else policy_name(made)
    return SafePolicy(made, task, kind(**options), name)


def _check_options(name: str, known: Mapping[str, _Option], options: Mapping[str, Any]) -> None:
    """Refuse options that a policy does not have, and values of another kind."""
    for option, value in options.items():
        if option not in known:
            raise ValueError(unknown_name(f"option of policy {name!r}:", option, known))
        _check_kind(name, option, known[option], value)


def _built(name: str, factory: Callable[..., Any], task: BaseTask, options: Mapping[str, Any]) -> Any:
    kind = _options_type(factory)
    try:
        return factory(task, **options) if kind is None else factory(task, kind(**options))
    except TypeError as error:
        raise ValueError(f"policy {name!r} refused its options {dict(options)}: {error}") from error


def _make_tracking_policy(
    name: str,
    factory: Callable[..., Any],
    task: Task,
    defaults: Mapping[str, Any],
    options: dict[str, Any],
) -> Policy:
    """A controller behind the observations of one vehicle."""
    from .tracking import ControllerPolicy

    preview = task.layout.preview
    wanted: Any = options.get("horizon", defaults.get("horizon"))
    if "horizon" in defaults:
        options.setdefault("horizon", max(1, min(wanted, preview)))
    if "acceleration_feed_forward" in defaults:
        options.setdefault("acceleration_feed_forward", defaults["acceleration_feed_forward"] and preview > 0)
    controller = _built(name, factory, task, options)
    if controller.horizon > preview:
        remedy = "" if preview == 0 else f"choose horizon <= {preview}, or "
        if "horizon" not in defaults:
            remedy = "choose acceleration_feed_forward=False, or "
        raise ValueError(
            f"policy {name!r} looks {controller.horizon} steps ahead, the observation {preview}: "
            f"{remedy}gym.make({task.env_id!r}, preview={wanted or controller.horizon})"
        )
    return ControllerPolicy(controller, task, name)


def _make_team_policy(
    name: str,
    factory: Callable[..., Any],
    task: TeamTask,
    defaults: Mapping[str, Any],
    options: dict[str, Any],
) -> Policy:
    """A policy that reads the observations of agents; in a formation its leader needs the preview."""
    preview = task.layout.preview
    if "horizon" in defaults and task.mission == _FORMATION:
        horizon = options.setdefault("horizon", max(1, min(defaults["horizon"], preview)))
        if horizon > preview:
            remedy = "" if preview == 0 else f"choose horizon <= {preview}, or "
            raise ValueError(
                f"policy {name!r} looks {horizon} steps ahead, the leader sees {preview}: {remedy}make "
                f"{task.env_id!r} with preview={horizon}"
            )
    policy: Policy = _built(name, factory, task, options)
    return policy
