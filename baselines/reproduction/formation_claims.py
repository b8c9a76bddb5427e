"""The claims of chapter 5: consensus of references, spanning trees, collision avoidance."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from quad_envs.formations import make_formation
from quad_envs.graphs import Switching, adjacency, has_spanning_tree, make_graph
from quad_envs.parameters import Array

from .meetings import literal_consensus, meet, smallest_gap
from .results import NOT_REPRODUCED, Claim, Numbers, Value, verdict
from .team_flights import EQUAL, FREE, FROZEN, NO_ROWS, TEXT_ROWS, TeamFlight, TeamOutcome, fly_teams

SEPARATION = 0.4  # m, d_s
KEPT = 0.399  # m: soft rows give way by less than 1 mm
CONVERGED = 0.1  # m, error at the end below which a formation counts as closed
SHAPES = ("triangle", "hexagon")
LEADERS = {"static": "setpoint", "line": "line"}
_DIGRAPHS = 40
# Three graphs of which none has a tree, and whose union is the weak one; and the same without 1>3.
UNION = (((0, 1), (2, 4)), ((0, 2), (1, 3)), ((2, 5),))
LACKING = (((0, 1), (2, 4)), ((1, 3),), ((2, 5),))
Edges = tuple[tuple[tuple[int, int], ...], ...]


def formation(shape: str, graph: Any, leader: str, policy: dict[str, Any], **env: Any) -> TeamFlight:
    """A flight from a straight line, as in 5.5; weights are 1 unless said otherwise."""
    settings = {"formation": shape, "graph": graph, "reference": LEADERS.get(leader, leader)}
    return TeamFlight({**settings, "start": "line", **EQUAL, **env}, policy)


def metres(values: list[float]) -> str:
    """Numbers of a claim in one line; what crashed or never came is told."""
    return ", ".join(f"{value:.3f}" if np.isfinite(value) else "lost" for value in values)


def printed_consensus_claim(jobs: int = 1) -> Claim:
    """Eqs. (5.4), (5.9) to the letter."""
    numbers: Numbers = {}
    right = []
    for graph in ("weak", "strong"):
        slots = make_formation("triangle", 6)
        p = literal_consensus(slots, make_graph(graph, "triangle", 6))
        error = float(np.linalg.norm(p[-1] - p[-1, 0] - slots, axis=-1).max())
        numbers[f"triangle, {graph}: error after 20 s, m"] = error
        numbers[f"triangle, {graph}: smallest distance, m"] = float(smallest_gap(p[:, None])[0])
        right.append(error < CONVERGED)
    text = "(5.4) as printed, a sum over those who hear i, brings each reference to its slot"
    return Claim("5-printed", text, verdict(float(np.mean(right))), numbers, "FALSE")


def consensus_claim(jobs: int = 1) -> Claim:
    """Eq. (5.9) for the corrected sum: the four scenarios of 5.5 with a static leader."""
    modes: dict[str, dict[str, Any]] = {"frozen neighbours": {**FROZEN, **NO_ROWS}, "default": {}}
    cases = [(shape, graph) for shape in SHAPES for graph in ("weak", "strong")]
    numbers: Numbers = {}
    right = []
    for mode, policy in modes.items():
        weights: dict[str, Any] = {"leader_weight": 10.0} if mode == "default" else {}
        flown = fly_teams([formation(*case, "static", policy, **weights) for case in cases], jobs)
        for case, outcome in zip(cases, flown, strict=True):
            numbers[f"{mode}, {case[0]}, {case[1]}"] = {
                "error after 20 s, m": metres([outcome.final]),
                "settling, s": f"{outcome.settling:.2f}",
            }
            right.append(outcome.final < CONVERGED)
    text = "(5.4) with the sum over those who are heard brings each vehicle to its slot, static leader"
    return Claim("5-consensus", text, verdict(float(np.mean(right))), numbers, "HOLDS")


def moving_claim(jobs: int = 1) -> Claim:
    """Eq. (5.9) says the same of a leader that moves."""
    frozen = {**FROZEN, **NO_ROWS}
    cases = [(shape, leader) for shape in SHAPES for leader in ("line", "slow-helix")]
    numbers: Numbers = {}
    right = []
    printed = fly_teams([formation(s, "weak", leader, frozen) for s, leader in cases], jobs)
    ours = fly_teams([formation(s, "weak", leader, {}) for s, leader in cases], jobs)
    for (shape, leader), old, new in zip(cases, printed, ours, strict=True):
        numbers[f"{shape}, weak, {leader}: error after 20 s, m"] = {
            "neighbours frozen": metres([old.final]),
            "default": metres([new.final]),
        }
        right.append(old.final < CONVERGED)
    text = "(5.4) with neighbours frozen over the horizon brings each vehicle to its slot, moving leader"
    return Claim("5-moving", text, verdict(float(np.mean(right))), numbers, "FALSE")


def random_digraphs() -> list[Array]:
    """Digraphs on six vehicles, with and without a tree; the leader hears nobody."""
    rng, found = np.random.default_rng(2), []  # of the first seeds the one with most trees: 7
    for trial in range(_DIGRAPHS):
        links = rng.random((6, 6)) < (0.12, 0.2, 0.3)[trial % 3]
        G = np.where(np.eye(6, dtype=bool), 1.0, links.astype(np.float64))
        G[0, 1:] = 0.0
        found.append(G)
    return found


def tree_claim(jobs: int = 1) -> Claim:
    """Section 5.4: a spanning tree rooted at the leader is enough; is it needed?"""
    graphs = random_digraphs()
    policy = {**FROZEN, **NO_ROWS}
    flights = [formation("triangle", G.tolist(), "static", policy, start="sorted") for G in graphs]
    return tree_verdict([has_spanning_tree(G) for G in graphs], fly_teams(flights, jobs))


def tree_verdict(trees: list[bool], flown: list[TeamOutcome]) -> Claim:
    """What convergence of each flight says."""
    closed = [outcome.final < CONVERGED for outcome in flown]
    with_tree = [c for c, tree in zip(closed, trees, strict=True) if tree]
    without = [c for c, tree in zip(closed, trees, strict=True) if not tree]
    numbers: Numbers = {
        "random digraphs with a tree: closed": f"{sum(with_tree)} of {len(with_tree)}",
        "without: closed": f"{sum(without)} of {len(without)}",
    }
    text = "a spanning tree rooted at the leader suffices (and is needed), static leader"
    share = float(np.mean([c == tree for c, tree in zip(closed, trees, strict=True)]))
    return Claim("5-tree", text, verdict(share), numbers, "HOLDS")


def switching(edges: Edges, dwell: int) -> Switching:
    """Graphs in turn, for so many steps each."""
    return Switching([adjacency(6, part).tolist() for part in edges], dwell)


def switched(edges: Edges, dwell: int, leader: str, lifetime: float, policy: dict[str, Any]) -> TeamFlight:
    """A triangle whose graph switches, 30 s."""
    return formation(
        "triangle", switching(edges, dwell), leader, policy, start="sorted", message_lifetime=lifetime,
        time_limit=30.0,
    )  # fmt: skip


def union_claim(jobs: int = 1) -> Claim:
    """Section 5.4: only the union over windows needs a tree."""
    printed, dwells = {**FROZEN, **NO_ROWS}, (1, 5, 20)
    cases = [(leader, dwell) for leader in LEADERS for dwell in dwells]
    old = fly_teams([switched(UNION, d, leader, 0.0, printed) for leader, d in cases], jobs)
    new = fly_teams([switched(UNION, d, leader, 2.0, {}) for leader, d in cases], jobs)
    lacking = fly_teams([switched(LACKING, 1, leader, 2.0, {}) for leader in LEADERS], jobs)
    numbers: Numbers = {}
    for i, leader in enumerate(LEADERS):
        part = slice(3 * i, 3 * i + 3)
        where, columns = f"{leader} leader, error after 30 s, m", [f"dwell {d}" for d in dwells]
        frozen = f"{where}, frozen, this step's messages only"
        numbers[frozen] = dict(zip(columns, [metres([o.final]) for o in old[part]], strict=True))
        ours = f"{where}, default (messages stay valid for 2 s)"
        numbers[ours] = dict(zip(columns, [metres([o.final]) for o in new[part]], strict=True))
        numbers[f"{leader} leader, union lacks 1>3: error, m"] = lacking[i].final
    right = [outcome.final < CONVERGED for outcome in old]
    text = "only the union of the graphs over a window needs a tree (as printed: frozen neighbours)"
    return Claim("5-union", text, verdict(float(np.mean(right))), numbers, "PARTLY")


def weight_claim(jobs: int = 1) -> Claim:
    """Section 5.4: consensus and a stable tracking controller together converge; Q_f is not printed."""
    weights = {"hover": "of the Riccati equation", "stage": "= Q"}
    flights = [formation("triangle", "weak", "static", {**FROZEN, **NO_ROWS, "terminal_weight": name})
               for name in weights]  # fmt: skip
    flown = fly_teams(flights, jobs)
    numbers: Numbers = {
        f"Q_f {what}: error after 20 s, m": outcome.final
        for what, outcome in zip(weights.values(), flown, strict=True)
    }
    numbers["Q_f = Q closes the formation"] = "yes" if flown[1].final < CONVERGED else "no"
    text = "consensus and the MPC together converge (with Q_f of the Riccati equation)"
    return Claim("5-mpc", text, "HOLDS" if flown[0].final < CONVERGED else "FALSE", numbers, "HOLDS")


_TEXT = "rows of the text"
MODES: dict[str, dict[str, Any]] = {
    _TEXT: {**FROZEN, **TEXT_ROWS},
    "no avoidance": {**FROZEN, **NO_ROWS},
    "reciprocal rows": {**FROZEN, "moving_centre": False, "braking_time": 0.0, "swirl": 0.0},
}


def height_claim(shape: str, jobs: int = 1) -> Claim:
    """Section 5.5: strong followers significantly reduce z divergence without loss in x and y.

    Judged in the text's setting alone, and with either leader: how its leader moves, and its weights, are not
    printed. Where nothing of it shows, that may be why: it is not reproduced, and not false.
    """
    cases = [(mode, leader) for mode in MODES for leader in LEADERS]
    flown = {graph: fly_teams([formation(shape, graph, leader, MODES[mode]) for mode, leader in cases], jobs)
             for graph in ("weak", "strong")}  # fmt: skip
    numbers: Numbers = {}
    right = []
    for (mode, leader), weak, strong in zip(cases, flown["weak"], flown["strong"], strict=True):
        where = f"{mode}, {leader} leader" if mode == _TEXT else f"ours: {mode}, {leader} leader"
        numbers[f"{where}, weak"] = _divergence(weak)
        numbers[f"{where}, strong"] = _divergence(strong)
        right += reduced(weak, strong) if mode == _TEXT else []
    ours = fly_teams([formation(shape, "weak", leader, {}) for leader in LEADERS], jobs)
    for leader, outcome in zip(LEADERS, ours, strict=True):
        numbers[f"ours: default, {leader} leader, weak"] = _divergence(outcome)
    text = (
        f"{shape}: strong followers significantly reduce z divergence (by 30 %) without loss in x and y (5 %)"
    )
    word = verdict(float(np.mean(right)))
    return Claim(f"5-height-{shape}", text, NOT_REPRODUCED if word == "FALSE" else word, numbers)


def reduced(weak: TeamOutcome, strong: TeamOutcome) -> list[bool]:
    """Whether z divergence is significantly less, and whether nothing is lost in x and y."""
    if weak.crashed or strong.crashed:
        return [False, False]
    return [strong.height[0] < 0.7 * weak.height[0], strong.level < 1.05 * weak.level]


def _divergence(outcome: TeamOutcome) -> dict[str, Value]:
    largest, rms = (np.inf, np.inf) if outcome.crashed else outcome.height
    return {
        "largest z, m": metres([largest]),
        "rms z, m": metres([rms]),
        "rms xy, m": metres([np.inf if outcome.crashed else outcome.level]),
        "settling, s": f"{outcome.settling:.2f}" if np.isfinite(outcome.settling) else "never",
    }


RULES: dict[str, dict[str, Any]] = {
    "none": {"avoidance": "none"},
    "text, sign fixed": {"avoidance": "frozen"},
    "frozen centre, no braking row": {"moving_centre": False, "braking_time": 0.0, "swirl": 0.0},
    "moving centre, no braking row": {"braking_time": 0.0, "swirl": 0.0},
    "default": {},
}
# Speed of each, m/s, vehicles, runs.
MEETINGS = ((0.5, 2, 20), (1.0, 2, 20), (2.0, 2, 20), (1.0, 6, 8))


@cache
def head_on(rule: str, case: tuple[float, int, int]) -> Array:
    """Smallest distance of each run of one of MEETINGS under one of RULES, m."""
    return meet(RULES[rule], *case).gap


def separation_claims(jobs: int = 1) -> list[Claim]:
    """Eqs. (5.7), (5.8): no two vehicles are ever nearer than d_s; head-on, and from a dense line."""
    rules = ("none", "text, sign fixed", "default")
    gaps = {rule: [head_on(rule, case) for case in MEETINGS] for rule in rules}
    dense = [[0.0, 0.7 * y, 0.0] for y in range(6)]
    flights = [
        formation("triangle", "weak", "static", policy, start=dense)
        for policy in ({"avoidance_set": "edges"}, {})
    ]
    crowd = {"formation": "lattice", "vehicles": 20, "graph": "weak", "reference": "setpoint"}
    crowd |= {"time_limit": 15.0, "start": "random"}
    flights += [TeamFlight(crowd, {}, seed=seed) for seed in (0, 1)]
    others = [outcome.gap for outcome in fly_teams(flights, jobs)]
    return [printed_separation(gaps, others[0]), corrected_separation(gaps["default"], others[1:])]


def printed_separation(gaps: dict[str, list[Array]], edges: float) -> Claim:
    """From the smallest distances, m: of every head-on run, and of graph neighbours' rows in a dense line."""
    head_on = f"runs that keep {KEPT:g} m (least distance, m)"
    rules = {"no rule": "none", "text, sign fixed": "text, sign fixed"}
    numbers: Numbers = {f"{what}: {head_on}": _kept(gaps[rule]) for what, rule in rules.items()}
    numbers["only graph neighbours, from a line 0.7 m apart: smallest distance, m"] = edges
    kept = [*(np.concatenate(gaps["text, sign fixed"]) >= KEPT), edges >= KEPT]
    text = "two vehicles are never nearer than d_s with (5.7), its sign corrected"
    return Claim("5-separation-printed", text, verdict(float(np.mean(kept))), numbers, "FALSE")


def corrected_separation(gaps: list[Array], others: list[float]) -> Claim:
    """From the smallest distances, m: of every head-on run; in a dense line, and of 20 vehicles twice."""
    numbers: Numbers = {
        f"runs that keep {KEPT:g} m (least distance, m)": _kept(gaps),
        "from a line 0.7 m apart: smallest distance, m": others[0],
        "20 vehicles from random places: smallest distance, m": {
            f"seed {seed}": gap for seed, gap in enumerate(others[1:])
        },
    }
    held = [*(np.concatenate(gaps) >= KEPT), *(gap >= KEPT for gap in others)]
    text = "two vehicles are never nearer than d_s with the corrected rows"
    return Claim("5-separation", text, verdict(float(np.mean(held))), numbers, "HOLDS")


def _kept(gaps: list[Array]) -> dict[str, Value]:
    return {
        f"{'head-on' if n == 2 else f'{n} meet'} at {speed:g} m/s": (
            f"{int((gap >= KEPT).sum())} of {len(gap)} ({gap.min():.3f})"
        )
        for (speed, n, _), gap in zip(MEETINGS, gaps, strict=False)
    }


def centre_claim(jobs: int = 1) -> Claim:
    """Our own: why the common centre of a pair moves, on a convoy at 3 m/s."""
    convoy = {"formation": "triangle", "graph": "weak", "start": "sorted"}
    env = {**convoy, "reference": "fast-line"}
    flights = [TeamFlight(env, {**FREE, "moving_centre": moving}) for moving in (True, False)]
    flown = fly_teams(flights, jobs)
    numbers: Numbers = {
        "moving centre, error after 20 s, m": flown[0].final,
        "frozen centre, error after 20 s, m": flown[1].final,
    }
    right = [flown[0].final < 0.01, flown[1].final > 10.0 * flown[0].final]
    text = "ours: a fast convoy (1.58 m/s) is braked by its own avoidance unless the centre of a pair moves"
    return Claim("5-centre", text, verdict(float(np.mean(right))), numbers, "HOLDS", own=True)


def claims(jobs: int = 1) -> list[Claim]:
    """All of them."""
    return [
        printed_consensus_claim(jobs),
        consensus_claim(jobs),
        moving_claim(jobs),
        tree_claim(jobs),
        union_claim(jobs),
        weight_claim(jobs),
        *(height_claim(shape, jobs) for shape in SHAPES),
        *separation_claims(jobs),
        centre_claim(jobs),
    ]
