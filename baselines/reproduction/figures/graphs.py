"""Figures 5.1 to 5.5, 6.1 and 7.3: who hears whom, drawn from the graphs and formations that are flown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from quad_envs.envs.team.options import CHAPTER_6_RAILS, CHAPTER_7_SLOTS
from quad_envs.formations import make_formation
from quad_envs.graphs import adjacency, has_spanning_tree, hops, make_graph, make_graph_table
from quad_envs.parameters import Array
from quad_envs.targets import make_target

from ..results import Numbers
from .model import Drawing, Sketch, judge
from .svg import Point, arrow, bent_arrow, disc, document, loop, star, words

_VEHICLES = 6
_ORIGIN = Point(0.0, 0.0)
_RADIUS = 17.0  # of a vehicle, pixels
_GAP = 2.0  # between an arrow and what it points to
_EDGE = 46.0  # around the places of a panel
_HEAD_ROOM = 30.0  # for the name of a panel
_EXAMPLE = ((0, 1), (2, 1), (3, 1))  # section 6.1: vehicle 2 hears 1, 3 and 4, and vehicle 1 hears nobody
_FLAT = 8.0  # ratio of spreads above which a formation is nearly flat


def scaled(places: Array, width: float, height: float, corner: Point = _ORIGIN) -> list[Point]:
    """Places (n, 2), right and up, in a panel of so many pixels."""
    low, high = places.min(axis=0), places.max(axis=0)
    room = np.array([width, height]) - 2.0 * _EDGE
    scale = float(np.min(room / np.maximum(high - low, 1e-9)))
    middle = 0.5 * (low + high)
    return [
        Point(
            corner.x + 0.5 * width + scale * float(right - middle[0]),
            corner.y + 0.5 * height - scale * float(up - middle[1]),
        )
        for right, up in places
    ]


def graph_marks(G: Array, at: Sequence[Point], loops: Sequence[int] = ()) -> Iterator[str]:
    """Vehicles as discs, the leader full, and an arrow from each to those who hear it."""
    n = len(G)
    for sender in range(n):
        for receiver in range(n):
            both = G[sender, receiver] > 0.0
            if sender == receiver or not G[receiver, sender] > 0.0 or (both and sender > receiver):
                continue
            yield _link(at, sender, receiver, bool(both))
    for vehicle in loops:
        yield loop(at[vehicle], _RADIUS)
    for i, place in enumerate(at[:n]):
        yield disc(place, _RADIUS, "ink" if i == 0 else "blue", full=i == 0)
        yield words(place, f"{i + 1}", 14.0, "paper" if i == 0 else "ink", bold=True)


def _link(at: Sequence[Point], sender: int, receiver: int, both: bool) -> str:
    """From disc to disc, around those that are in the way."""
    a, b = at[sender], at[receiver]
    others = [p for k, p in enumerate(at) if k not in (sender, receiver)]
    ends = a.toward(b, _RADIUS + _GAP), b.toward(a, _RADIUS + _GAP)
    if any(_distance(p, a, b) < 1.2 * _RADIUS for p in others):
        return bent_arrow(*ends, 2.3 * _RADIUS, "slate", both)
    return arrow(list(ends), "slate", both)


def _distance(p: Point, a: Point, b: Point) -> float:
    """Of a point to the way from a to b."""
    way, to = np.subtract(b, a), np.subtract(p, a)
    share = float(np.clip(way @ to / max(float(way @ way), 1e-9), 0.0, 1.0))
    return float(np.linalg.norm(to - share * way))


def _from_above(slots: Array) -> Array:
    """North is up, east is right."""
    return np.asarray(slots)[:, [1, 0]]


def example_figure(jobs: int = 1) -> Drawing:
    """A graph by hops from the leader, with a vehicle that hears itself."""
    G = make_graph("weak", "triangle", _VEHICLES)
    rank = hops(G)
    row = np.array([float(np.flatnonzero(rank == rank[i]).tolist().index(i)) for i in range(_VEHICLES)])
    middle = np.array([0.5 * (np.sum(rank == r) - 1) for r in rank])
    at = scaled(np.stack([1.4 * rank, middle - row], axis=1), 460.0, 280.0, Point(0.0, 12.0))
    loops = [i for i in (1,) if G[i, i] > 0.0]
    title = "A directed graph: an arrow leads from a vehicle to one that hears it"
    drawing = document(460.0, 300.0, title, graph_marks(G, at, loops))
    numbers: Numbers = {"links": f"{_links(G)}", "links from the leader to the farthest": f"{rank.max()}"}
    return Drawing(drawing, judge(bool(G[4, 2] > 0.0), bool(loops), has_spanning_tree(G)), numbers)


def _links(G: Array) -> int:
    return int((G > 0.0).sum() - len(G))


def formation_figure(shape: str, graph: str, jobs: int = 1) -> Drawing:
    """The slots of a formation from above, and its graph."""
    G = make_graph(graph, shape, _VEHICLES)
    at = scaled(_from_above(make_formation(shape, _VEHICLES)), 440.0, 360.0)
    title = f"The formation {shape} from above, its leader heading up, and its {graph} graph"
    drawing = document(440.0, 360.0, title, graph_marks(G, at))
    followers = bool((G[1:, 1:] > 0.0).all())
    numbers: Numbers = {
        "links": f"{_links(G)}",
        "links from the leader to the farthest": f"{hops(G).max()}",
        "every follower hears every other one": "yes" if followers else "no",
    }
    return Drawing(drawing, judge(has_spanning_tree(G), followers == (graph == "strong")), numbers)


def _held(G: Array, vehicle: int) -> str:
    """The list of section 6.1: whose measurements a vehicle holds, t for the target first."""
    return "{t, " + ", ".join(str(j + 1) for j in np.flatnonzero(G[vehicle] > 0.0)) + "}"


def scene_figure(jobs: int = 1) -> Drawing:
    """Vehicles and target from above: the example of the text, then our communication of chapter 6."""
    table = make_graph_table("chapter-6", None, 4, 200, 0.05)
    graphs = {"the text's example": adjacency(4, _EXAMPLE)}
    for G, start in zip(table.graphs, ("from 0 s", "from 2.5 s", "from 5 s"), strict=True):
        graphs[f"flown, {start}"] = G
    target = make_target("chapter-6").rows(np.array([0.0, 0.05]), np.random.default_rng(0))[0, :3]
    places = _from_above(np.array([*CHAPTER_6_RAILS, target]))
    marks: list[str] = []
    numbers: Numbers = {}
    for k, (name, G) in enumerate(graphs.items()):
        corner = Point(270.0 * (k % 2), (250.0 + _HEAD_ROOM) * (k // 2))
        *at, goal = scaled(places, 270.0, 250.0, Point(corner.x, corner.y + _HEAD_ROOM))
        marks.append(words(Point(corner.x + 135.0, corner.y + 18.0), name, bold=True))
        for p in at:
            seen = [goal.toward(p, 16.0), p.toward(goal, _RADIUS + _GAP)]
            marks.append(arrow(seen, "faint", dashed=True))
        marks += [star(goal, 14.0, "orange"), *_plain_vehicles(G, at)]
        told = range(2 if k == 0 else 4)
        numbers[f"{name}: measurements held"] = {
            f"vehicle {i + 1}": _held(G, i) if i in told else "not told" for i in range(4)
        }
    title = "Four vehicles and a target from above: dashed who measures it, full who hears whom"
    G = graphs["the text's example"]
    right = (_held(G, 0) == "{t, 1}", _held(G, 1) == "{t, 1, 2, 3, 4}")
    return Drawing(document(540.0, 2.0 * (250.0 + _HEAD_ROOM), title, marks), judge(*right), numbers)


def _plain_vehicles(G: Array, at: Sequence[Point]) -> Iterator[str]:
    """A graph of vehicles of which none leads."""
    (*links,) = graph_marks(G, at)
    n = 2 * len(G)
    yield from links[:-n]
    for i, place in enumerate(at):
        yield disc(place, _RADIUS, "blue", full=False)
        yield words(place, f"{i + 1}", 14.0, bold=True)


def beside_target_figure(jobs: int = 1) -> Drawing:
    """The formation of chapter 7 from above with both graphs, and from behind."""
    slots = np.array([*CHAPTER_7_SLOTS, (0.0, 0.0, 0.0)])
    panels = {
        "case 1, from above": (_from_above(slots), make_graph("case-1", None, _VEHICLES)),
        "case 2, from above": (_from_above(slots), make_graph("case-2", None, _VEHICLES)),
        "from behind: right and up": (slots[:, [1, 2]] * [1.0, -1.0], np.eye(_VEHICLES)),
    }
    marks: list[str] = []
    for k, (name, (places, G)) in enumerate(panels.items()):
        corner = Point(290.0 * k, _HEAD_ROOM)
        *at, goal = scaled(places, 290.0, 260.0, corner)
        marks.append(words(Point(corner.x + 145.0, 18.0), name, bold=True))
        marks += [star(goal, 14.0, "orange"), *_plain_vehicles(G, at)]
    spread = np.linalg.svd(slots[:-1] - slots[:-1].mean(axis=0), compute_uv=False)
    ratio = float(spread[0] / spread[2])
    numbers: Numbers = {
        f"largest spread / smallest (above {_FLAT:g} is nearly flat)": ratio,
        **{
            f"slot of vehicle {i + 1} from the target, m": dict(
                zip(("north", "east", "up"), (f"{x:g}", f"{y:g}", f"{-z:g}"), strict=True)
            )
            for i, (x, y, z) in enumerate(CHAPTER_7_SLOTS)
        },
    }
    title = "The formation of chapter 7 beside its target (star), and the graphs of both cases"
    return Drawing(document(870.0, 260.0 + _HEAD_ROOM, title, marks), judge(ratio < _FLAT), numbers)


_SCENARIOS = (("triangle", "weak"), ("triangle", "strong"), ("hexagon", "weak"), ("hexagon", "strong"))
_READ = (
    "The graph that is flown, seen from above, the leader (full) heading up; an arrow leads from one to "
    "another that hears it. Which links the picture of the source has is not in its text."
)
FORMATIONS = [
    Sketch(
        "5.1", "a directed graph",
        "Vehicle 1 leads; vehicle 5 can access vehicle 3, and vehicle 2 itself.",
        "Our graph of the triangle by links from the leader. It has both links that the text names.",
        example_figure, flown=False,
    ),
    *(
        Sketch(
            f"5.{2 + i}",
            f"scenario {i + 1}, {shape}, "
            + ("followers strongly connected" if graph == "strong" else "weakly connected"),
            "Vehicle 1 is the root of a spanning tree"
            + ("; each follower can access any other follower." if graph == "strong" else "."),
            _READ, partial(formation_figure, shape, graph), (f"5-height-{shape}",), False,
        )
        for i, (shape, graph) in enumerate(_SCENARIOS)
    ),
]  # fmt: skip
SCENES = [
    Sketch(
        "6.1", "vehicles and a target",
        "Vehicle 1 holds {t, 1}: its own measurement; vehicle 2 holds {t, 1, 2, 3, 4}.",
        "The rails and the target of our flights at the start, from above. First the example of the text, of "
        "which the links of vehicles 3 and 4 are not told, then the three graphs of figures 6.2 to 6.5.",
        scene_figure, ("6-covariance",), False,
    ),
]  # fmt: skip
BESIDE = [
    Sketch(
        "7.3", "the formation beside the target",
        "This formation is not flat, to help to estimate the height of the target.",
        "The slots that are flown, beside the target (star), with our reading of the graphs of both cases.",
        beside_target_figure, ("7-height",), False,
    ),
]  # fmt: skip
