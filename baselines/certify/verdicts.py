"""What the numbers of a flight and of an ellipsoid mean, in plain words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.stability.certificates import Decrease
from controllers.stability.invariant import Ellipsoid
from quad_envs.parameters import Array

from .flight import Trace
from .region import Stay

HOLDS, LINEAR_ONLY, FAILS, NOT_COMPUTED = "HOLDS", "HOLDS FOR THE LINEAR MODEL ONLY", "FAILS", "NOT COMPUTED"
_VALUE_TOLERANCE = 1e-6  # of the value, at least 1e-6: observations are of single precision
_ROW_TOLERANCE = 1e-6  # SI, of a limit


class Certificate(NamedTuple):
    """One statement of the theory, whether it holds here, and what it would not promise even so."""

    key: str
    title: str
    verdict: str
    text: str
    numbers: Mapping[str, Any]
    not_promised: str

    def __str__(self) -> str:
        return f"[{self.verdict}] {self.title}\n    {self.text}\n    Not promised: {self.not_promised}"


class Descent(NamedTuple):
    """V(next) - V + stage cost along a flight, (T-1,), of each reading of what comes next."""

    model: Array
    plant: Array
    following: Array


def descent(trace: Trace) -> Descent:
    """How far the value function is from falling by the stage cost, Eq. (9.10): positive is too little."""
    V, stage = trace.value[:-1], trace.stage[:-1]
    model, plant, following = (
        layer[:-1] - V + stage for layer in (trace.model, trace.plant, trace.following)
    )
    return Descent(model, plant, following)


def share(kept: NDArray[np.bool_]) -> float:
    """Share of True; 1 of nothing."""
    return float(np.mean(kept)) if len(kept) else 1.0


def first_step(kept: NDArray[np.bool_]) -> int | None:
    """Index of the first False; None where all are True."""
    return None if kept.all() else int(np.argmin(kept))


def terminal_inequality(found: Decrease, smallest: float) -> Certificate:
    """Eqs. (9.6), (9.16) at hover, for the terminal weight and its own gain."""
    text = (
        f"largest eigenvalue of (A - BK)'Q_f(A - BK) - Q_f + Q + K'RK at hover: {-found.margin:.2g} "
        f"(rounding: {found.tolerance:.1g}); smallest eigenvalue of the LMI (9.16): {smallest:.2g}. "
    )
    if found.holds:
        text += "Q_f solves the Riccati equation of hover, so it holds with equality: there is no margin."
    else:
        text += "Q_f is no bound of the cost behind the horizon."
    return Certificate(
        "terminal-inequality",
        "Terminal inequality at hover, (9.6) = (9.16)",
        HOLDS if found.holds else FAILS,
        text,
        {"largest_eigenvalue": -found.margin, "tolerance": found.tolerance, "smallest_of_lmi": smallest},
        "anything where limits are active, or of a model other than hover's.",
    )


def terminal_limits(trace: Trace) -> Certificate:
    """Eqs. (9.17), (9.18) along the flight."""
    inputs, outputs = trace.inputs >= -_ROW_TOLERANCE, trace.outputs >= -_ROW_TOLERANCE
    k = first_step(inputs & outputs)
    text = f"kept at {share(inputs & outputs):.1%} of {len(inputs)} samples"
    if np.isposinf(trace.outputs).all():
        text += " (the problem that is solved has no state limits)"
    if k is not None:
        kind = "rotor" if not inputs[k] else "state"
        slack = trace.inputs[k] if not inputs[k] else trace.outputs[k]
        text += (
            f"; first fails at step {k}, because the terminal law would exceed a {kind} limit by "
            f"{-slack:.3g} {'N' if kind == 'rotor' else 'SI'}"
        )
    return Certificate(
        "terminal-limits",
        "Limits under the terminal law just behind the plan, (9.17), (9.18), sign corrected",
        HOLDS if k is None else FAILS,
        text + ".",
        {
            "share": share(inputs & outputs),
            "first_failure": k,
            "smallest_input_slack": float(trace.inputs.min()),
            "smallest_output_slack": float(trace.outputs.min()),
        },
        "recursive feasibility: it is one step, not an invariant set (see the ellipsoid).",
    )


def value_descent(trace: Trace) -> Certificate:
    """Eqs. (9.7) to (9.10) along the flight."""
    found = descent(trace)
    tolerance = _VALUE_TOLERANCE * np.maximum(1.0, np.abs(trace.value[:-1]))
    kept = [layer <= tolerance for layer in found]
    falls = trace.following[:-1] - trace.value[:-1] <= tolerance
    shares = dict(zip(("model", "plant", "following"), map(share, kept), strict=True))
    texts = [
        f"the optimal cost falls by the stage cost at {shares['model']:.1%} of the samples if the model of "
        f"the sample is right, at {shares['plant']:.1%} from where the plant came to be, at "
        f"{shares['following']:.1%} as the next sample poses its problem; it falls at all at "
        f"{share(falls):.1%}"
    ]
    verdict = HOLDS if kept[2].all() else LINEAR_ONLY if kept[0].all() else FAILS
    layer = 0 if verdict == FAILS else 1 if not kept[1].all() else 2
    k = first_step(kept[layer])
    if k is not None:
        texts.append(
            f"first fails at step {k}, by {found[layer][k]:.3g} of {trace.value[k]:.4g}, because "
            f"{_why(trace, layer, k)}"
        )
    worst = [_worst(layer) for layer in found]
    return Certificate(
        "descent",
        "Descent of the value function along the flight, (9.7) to (9.10)",
        verdict,
        "; ".join(texts) + ".",
        {
            **{f"share_{name}": value for name, value in shares.items()},
            "share_falls": share(falls),
            "first_failure": k,
            **{f"worst_{name}": value for name, value in zip(shares, worst, strict=True)},
        },
        "descent on the plant, which has rotor lag and is not linear; nor any descent behind a reference "
        "that moves: chapter 9 is about the regulator.",
    )


def _worst(layer: Array) -> float:
    finite = layer[np.isfinite(layer)]
    return float(finite.max()) if len(finite) else float("nan")


def _why(trace: Trace, layer: int, k: int) -> str:
    """The first cause that applies, in the order in which the proof needs them."""
    if not np.isfinite([trace.value[k], (trace.model, trace.plant, trace.following)[layer][k]]).all():
        return "the problem has no solution there"
    if layer == 1:
        return "the plant is not the model: rotor lag, and what the linearisation leaves out"
    if layer == 2:
        return "the next sample freezes other matrices, or turns the frame"
    if trace.moving[k]:
        return "the reference moves, and its next point is not what the model does at rest"
    if trace.departure[k] > _ROW_TOLERANCE * 10.0:
        return "the command flown is not the plan's: limits clipped it, or a fallback"
    if trace.decrease[k] > trace.tolerance[k]:
        return f"the terminal weight fails (9.6) there: largest eigenvalue {trace.decrease[k]:.3g}"
    if min(trace.inputs[k], trace.outputs[k]) < 0.0:
        return "the plan ends where its terminal law would exceed a limit"
    return "a limit was active"


def frozen_inequality(trace: Trace) -> Certificate:
    """Eqs. (9.25) to (9.30) with the matrices frozen at each sample."""
    parts = {
        "value finite (9.25), (9.26)": np.isfinite(trace.value),
        "limits (9.27)": trace.feasible > 0.0,
        "terminal inequality (9.28)": trace.decrease <= trace.tolerance,
        "terminal input (9.29)": trace.inputs >= -_ROW_TOLERANCE,
        "terminal output (9.30)": trace.outputs >= -_ROW_TOLERANCE,
    }
    together = np.all(list(parts.values()), axis=0)
    k = first_step(together)
    text = f"all hold at {share(together):.1%} of {len(together)} samples: "
    text += ", ".join(f"{name} {share(kept):.1%}" for name, kept in parts.items())
    if k is not None:
        name = next(name for name, kept in parts.items() if not kept[k])
        text += f". First fails at step {k}, because of {name}"
        if "9.28" in name:
            text += (
                f": the largest eigenvalue is {trace.decrease[k]:.3g} with the gain that suits Q_f best, so "
                "no K satisfies it"
            )
    exists = share(trace.riccati_weight <= 10.0 * trace.tolerance)
    text += f". With Q_f = P(x_k) and its own K, (9.28) holds at {exists:.1%} (with equality)."
    return Certificate(
        "frozen-matrices",
        "Feasibility at each sample of the flight with A(x_k), B(x_k) frozen, (9.25) to (9.30)",
        HOLDS if k is None else FAILS,
        text,
        {
            "share": share(together),
            "first_failure": k,
            "shares": {name: share(kept) for name, kept in parts.items()},
            "share_with_riccati_weight": exists,
            "share_with_riccati_gain": share(trace.riccati_gain <= trace.tolerance),
            "largest_eigenvalue": _worst(trace.decrease),
            "median_eigenvalue": float(np.median(trace.decrease)),
            "largest_gamma": _worst(trace.value),
        },
        "stability: frozen matrices that are all stable say nothing of a system whose matrices change, and "
        "with Q_f = P(x_k) the value functions of two samples cannot be compared (9.7).",
    )


def ellipsoid_verdict(
    key: str, title: str, ellipsoid: Ellipsoid, linear: Stay, plant: list[Stay], starts: int
) -> Certificate:
    """The invariant set, and what random starts in it did."""
    first, last = plant[0], plant[-1]
    verdict = FAILS if not linear.holds else HOLDS if first.holds else LINEAR_ONLY
    text = (
        f"x'Px <= {ellipsoid.level:.4g}, touching the limit of {ellipsoid.binding}; pure offsets up to "
        f"{_reach(ellipsoid):.3g} m along x. Of {starts} random starts in it {linear.together:.0%} stay, "
        f"keep the limits and come to rest on the linear model; on the plant {first.inside:.0%} stay, "
        f"{first.limits:.0%} keep the limits, {first.converged:.0%} come to rest"
    )
    if not first.safe:
        text += (
            f"; shrunk to {last.fraction:g} of its radius {last.limits:.0%} keep the limits and "
            f"{last.converged:.0%} come to rest"
        )
    return Certificate(
        key,
        title,
        verdict,
        text + ".",
        {
            "level": ellipsoid.level,
            "binding": ellipsoid.binding,
            "size": ellipsoid.size,
            "offset_along_x": _reach(ellipsoid),
            "starts": starts,
            "linear": linear.numbers(),
            "plant": [stay.numbers() for stay in plant],
        },
        "anything outside of it, nor of the plant beyond these random starts; it belongs to hover at the "
        "origin, not to a reference that moves.",
    )


def _reach(ellipsoid: Ellipsoid) -> float:
    """Largest offset along x alone, all other states zero, m."""
    return float(np.sqrt(ellipsoid.level / ellipsoid.P[0, 0]))


def not_computed(key: str, title: str, reason: str) -> Certificate:
    """Where the policy lacks the structure, or a package is missing."""
    return Certificate(key, title, NOT_COMPUTED, reason + ".", {}, "anything.")
