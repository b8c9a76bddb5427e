"""What of a policy's options can be tuned: numbers, searched on a scale on which a step means a factor."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np

from controllers.mpc.options import MpcOptions
from quad_envs.arguments.names import unknown_name
from quad_envs.parameters import MOST_WEIGHT, Array
from quad_envs.tasks import Task, TeamTask

from ..policies.registry import options_type, policy_options, serving

AnyTask = Task | TeamTask
# Entries of the state that share a factor: x and y, as frame "heading" needs them, and their kin.
_GROUPS = ((0, 1), (2,), (3, 4), (5,), (6, 7), (8,), (9, 10), (11,))
_MOST_MARGIN = 0.9  # of half the distance between the narrowest limits
_MOST = 3.0  # decades that a number may go from where it began


def _always(task: AnyTask, options: Mapping[str, Any]) -> bool:
    return True


class Knob(NamedTuple):
    """An option that is tuned."""

    size: int  # numbers of the search that it takes
    value: Callable[[Array, AnyTask, Any], Any]  # of its numbers (size,), in decades; given the default
    acts: Callable[[AnyTask, Mapping[str, Any]], bool] = _always  # whether its value changes anything
    needs: str = ""  # what else has to be so that it does
    usual: Callable[[AnyTask, Mapping[str, Any]], bool] = _always  # whether it is tuned unless named


def _state_weight(z: Array, task: AnyTask, default: Any) -> Any:
    weight = np.array(task.weights.Q if default is None else default * np.ones(12), dtype=np.float64)
    factors = np.ones(12)
    for factor, group in zip(10.0**z, _GROUPS, strict=True):
        factors[list(group)] = factor
    return _plain(weight * factors if weight.ndim == 1 else weight * np.sqrt(np.outer(factors, factors)))


def _input_weight(z: Array, task: AnyTask, default: Any) -> Any:
    weight = np.array(task.weights.R if default is None else default * np.ones(4), dtype=np.float64)
    return _plain(weight * 10.0 ** z[0])


def _plain(weight: Array) -> Any:
    """A diagonal, (n,), within what weights may be, or a matrix, (n, n), as lists."""
    return (np.minimum(weight, MOST_WEIGHT) if weight.ndim < 2 else weight).tolist()


def _positive(z: Array, task: AnyTask, default: Any) -> Any:
    """A number, or entries that share a factor."""
    scaled = np.asarray(default, dtype=np.float64) * 10.0 ** z[0]
    return scaled.tolist() if scaled.ndim else float(scaled)


def _share(z: Array, task: AnyTask, default: Any) -> float:
    return min(1.0, float((0.5 if default == "auto" else default) * 10.0 ** z[0]))


def _floor(z: Array, task: AnyTask, default: Any) -> float:
    return _share(z, task, MpcOptions(floor=default).least_weight(task.limits))


def _change_weight(z: Array, task: AnyTask, default: Any) -> Any:
    return float(10.0 ** (z[0] - 2.0)) if default is None else _positive(z, task, default)


def _margin(z: Array, task: AnyTask, default: Any) -> float:
    """Less than what leaves nothing between the narrowest limits of the state."""
    lower, upper = task.limits.state_box()
    return min(float(_positive(z, task, default)), _MOST_MARGIN * float(np.min(upper - lower)) / 2.0)


def _limited(task: AnyTask, options: Mapping[str, Any]) -> bool:
    return len(task.constraint_names) > 0


def _estimates(task: AnyTask, options: Mapping[str, Any]) -> bool:
    return bool(options["reject_disturbance"])


def _follows_noise(task: AnyTask, options: Mapping[str, Any]) -> bool:
    """Whether a disturbance estimator takes its gain from the noise of the sensors."""
    return _estimates(task, options) and options["estimator_gain"] == "auto"


def _fades(task: AnyTask, options: Mapping[str, Any]) -> bool:
    """Whether a plan expects an estimated disturbance to fade."""
    return _estimates(task, options) and bool(np.isfinite(options["disturbance_correlation_time"]))


def _own_gain(task: AnyTask, options: Mapping[str, Any]) -> bool:
    return bool(options["estimator_gain"] != "auto")


def _for_score(task: AnyTask, options: Mapping[str, Any]) -> bool:
    return bool(options["objective"] == "score")


def _never(task: AnyTask, options: Mapping[str, Any]) -> bool:
    return False


def _samples(z: Array, task: AnyTask, default: Any) -> int:
    return int(np.clip(round(default * 10.0 ** z[0]), 1, max(1, task.layout.preview)))


# Options by name, whichever policy has them; all but the horizon, which costs time, unless asked for.
KNOBS: dict[str, Knob] = {
    "Q": Knob(len(_GROUPS), _state_weight),
    "R": Knob(1, _input_weight),
    "R_rate": Knob(1, _change_weight),
    "terminal": Knob(1, _positive),
    "margin": Knob(1, _margin, _limited, "a limit of the state, as --set tilt_limit=0.35"),
    # The gain itself where the caller gives a number; one that follows the noise of the sensors goes on to.
    "estimator_gain": Knob(1, _share, _estimates, "--policy-set reject_disturbance=true", _own_gain),
    "estimator_gain_scale": Knob(
        1, _positive, _follows_noise, '--policy-set reject_disturbance=true, and estimator_gain "auto"'
    ),
    "disturbance_correlation_time": Knob(
        1,
        _positive,
        _fades,
        "--policy-set reject_disturbance=true, and a finite disturbance_correlation_time",
    ),
    "floor": Knob(1, _floor, _for_score, "--policy-set objective=score"),
    "horizon": Knob(1, _samples, usual=_never),
}


class Search(NamedTuple):
    """The options that are searched, and the policy's own with what the caller has set."""

    names: tuple[str, ...]
    task: AnyTask
    defaults: dict[str, Any]
    given: dict[str, Any]

    @property
    def size(self) -> int:
        """Numbers that are searched."""
        return sum(KNOBS[name].size for name in self.names)

    @property
    def bounds(self) -> Array:
        """Of these numbers, (size, 2)."""
        return np.tile([-_MOST, _MOST], (self.size, 1))

    def options(self, z: Array) -> dict[str, Any]:
        """The options of a point of the search, (size,); those of the policy at 0 but for R_rate, 0.01."""
        out, at = dict(self.given), 0
        for name in self.names:
            knob = KNOBS[name]
            out[name] = knob.value(z[at : at + knob.size], self.task, self.defaults[name])
            at += knob.size
        return out


def make_search(policy: str, task: AnyTask, options: Mapping[str, Any], names: Sequence[str] = ()) -> Search:
    """What is to be searched of a policy.

    Args:
        policy: A name of `make_policy`.
        task: For which it is tuned.
        options: Of the policy, which the search begins with.
        names: Options to tune; none: all of KNOBS that the policy has and that mean something for the task.

    Raises:
        ValueError: If a name is none of KNOBS, is there twice, or changes nothing here; or the policy has
            nothing to tune.
    """
    kind = options_type(policy)
    own = {entry.name for entry in fields(kind)} if kind is not None else set()
    known = [name for name in KNOBS if name in own]
    if not known:
        able = ", ".join(each for each, entry in serving(task.mission).items() if entry.mpc)
        raise ValueError(
            f"policy {policy!r} has no option that can be tuned ({', '.join(KNOBS)}); the MPCs have "
            f"some: {able}"
        )
    defaults = {**policy_options(policy), **options}
    if "horizon" in defaults:
        defaults["horizon"] = min(defaults["horizon"], task.layout.preview)
    for name in names:
        if name not in known:
            raise ValueError(unknown_name(f"option of {policy!r} to tune:", name, known))
        _require_effect(name, task, defaults)
    if len(set(names)) < len(names):
        raise ValueError(f"an option to tune is named twice: {', '.join(names)}")
    chosen = tuple(names) or tuple(name for name in known if _is_usual(name, task, defaults))
    return Search(chosen, task, defaults, dict(options))


def _is_usual(name: str, task: AnyTask, defaults: Mapping[str, Any]) -> bool:
    """Whether an option is tuned if none is named."""
    knob = KNOBS[name]
    return knob.acts(task, defaults) and knob.usual(task, defaults) and not _is_zero(defaults[name])


def _is_zero(value: Any) -> bool:
    return value is not None and not isinstance(value, str) and not np.any(value)


def _require_effect(name: str, task: AnyTask, defaults: Mapping[str, Any]) -> None:
    """Refuse an option all of whose values would fly alike."""
    if not KNOBS[name].acts(task, defaults):
        raise ValueError(
            f"{name} changes nothing here, so that there is nothing to tune: it needs {KNOBS[name].needs}"
        )
    if _is_zero(defaults[name]):
        raise ValueError(
            f"{name} is searched by factors, and 0 stays 0: begin with a number > 0 (--policy-set {name}=...)"
        )
