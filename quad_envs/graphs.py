"""Who hears whom, section 2.4: communication graphs, their schedules, and spanning trees.

`G[i, j] > 0` iff vehicle i HEARS vehicle j, with that weight; `G[i, i] = 1`. Row i is what i hears. The
leader is row 0: it may hear others and ignores them. A schedule becomes, at construction, a table of graphs
and the number of the one that holds at each step.

Names of graphs: `weak` (a tree from the leader through the rows of the formation) and `strong` (the leader's
links of the weak graph, followers complete) belong to a named formation; `chain` (each hears the one before),
`ring` (two-way), `star` (all hear the leader) and `complete` fit any team; `case-1` and `case-2` are the two
graphs of chapter 7. Names of schedules: `chapter-6` (4 vehicles), `switching` (6 vehicles).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arguments.checks import Bound, array_bytes, require_memory, require_number, require_whole
from .arguments.kinds import is_number, make_kind, refuse_class, require_kinds
from .arguments.names import shown, unknown_name
from .formations import FORMATIONS, lattice_cells
from .parameters import Array

# (sender, receiver), rows counted from 0, or (sender, receiver, weight)
Edges: TypeAlias = "Iterable[tuple[int, int] | tuple[int, int, float]]"
GraphLike: TypeAlias = "str | ArrayLike | Edges"

_HEXAGON_WEAK = ((0, 1), (0, 5), (1, 2), (5, 4), (2, 3))
# Chapter 7: a two-way ring 1-2-4-6-5-3-1 where all measure; a graph where only 1 and 2 measure.
_CASES = {
    "case-1": tuple(
        link for a, b in ((0, 1), (1, 3), (3, 5), (5, 4), (4, 2), (2, 0)) for link in ((a, b), (b, a))
    ),
    "case-2": ((0, 1), (1, 0), (0, 2), (2, 0), (1, 3), (2, 4), (3, 5), (4, 5)),
}
GRAPHS = ("weak", "strong", "chain", "ring", "star", "complete", *_CASES)
SCHEDULES = ("chapter-6", "switching")


def adjacency(n: int, edges: Edges) -> Array:
    """G (n, n) of (sender, receiver) pairs, or (sender, receiver, weight): the receiver hears the sender.

    Raises:
        ValueError: If an edge names a vehicle outside 0 .. n-1 or joins one to itself, or weighs nothing.
    """
    require_whole("vehicles of a graph", n, 1)
    require_memory(f"a graph of {n} vehicles", array_bytes((n, n)), "take fewer")
    G = np.eye(n)
    for sender, receiver, *weight in edges:
        if sender not in range(n) or receiver not in range(n) or sender == receiver:
            raise ValueError(
                f"an edge is (sender, receiver), two different vehicles of 0 .. {n - 1}, "
                f"got ({shown(sender)}, {shown(receiver)})"
            )
        w = weight[0] if weight else 1.0
        if not (is_number(w) and w > 0.0):
            raise ValueError(
                f"the weight of an edge must be a finite number > 0, got {shown(w)} of ({sender}, {receiver})"
            )
        G[int(receiver), int(sender)] = w
    return G


def edges_of(graph: Any) -> tuple[tuple[Any, ...], ...]:
    """Edges (sender, receiver, weight) of a graph of networkx: u -> v is heard by v, undirected both ways.

    Raises:
        ValueError: If its nodes are not numbered from 0.
    """
    edges = [(u, v, 1.0 if w is None else w) for u, v, w in graph.edges(data="weight")]
    if not graph.is_directed():
        edges += [(v, u, w) for u, v, w in edges]
    if set(graph.nodes) - set(range(len(graph.nodes))):
        raise ValueError(
            f"nodes of a graph must be 0 .. {len(graph.nodes) - 1}, the vehicles, got "
            f"{shown(list(graph.nodes))}: networkx.convert_node_labels_to_integers numbers them"
        )
    return tuple(edges)


def is_networkx(what: Any) -> bool:
    """Whether it is a graph of networkx, or one that looks like it."""
    return all(hasattr(what, name) for name in ("nodes", "edges", "is_directed"))


def make_graph(what: GraphLike, formation: str | None, n: int) -> Array:
    """A graph from its name, its matrix, its edges, or one of networkx.

    Args:
        what: One of `GRAPHS`; or weights G (n, n), row i what i hears, >= 0, the diagonal is not read; or
            edges (sender, receiver) or (sender, receiver, weight), if these are not n rows of n; or a
            graph of networkx.
        formation: Name of the formation, which `weak` and `strong` need; None for slots of your own.
        n: Number of vehicles.

    Returns:
        G, (n, n), with ones on the diagonal.

    Raises:
        ValueError: If the name is unknown or does not fit the team, or the matrix is not one of weights.
    """
    require_whole("vehicles of a graph", n, 1)
    if isinstance(what, str):
        return adjacency(n, _named_edges(what, formation, n))
    if is_networkx(what):
        return adjacency(n, edges_of(what))
    if _are_edges(what, n):
        return adjacency(n, what)  # type: ignore[arg-type]
    try:
        G = np.array(what, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f"a graph is a name, an ({n}, {n}) matrix of weights or edges (sender, receiver), "
            f"got {shown(what)}"
        ) from None
    if G.shape != (n, n):
        raise ValueError(
            f"the graph of {n} vehicles is a name, edges or an ({n}, {n}) matrix, got shape {G.shape}"
        )
    np.fill_diagonal(G, 1.0)
    if not (np.isfinite(G) & (G >= 0.0)).all():
        i, j = np.argwhere(~(np.isfinite(G) & (G >= 0.0)))[0]
        raise ValueError(
            f"weights of a graph must be finite and >= 0 (0: does not hear), got {G[i, j]} at [{i}, {j}]"
        )
    return G


def _are_edges(what: Any, n: int) -> bool:
    """Whether it is a list of edges; n rows of n are a matrix."""
    if isinstance(what, np.ndarray):
        return what.ndim == 2 and what.shape[1] in (2, 3) and what.shape not in ((n, n), (3, 3))
    if not isinstance(what, list | tuple | set | frozenset):
        return False
    lengths = {len(edge) if isinstance(edge, list | tuple) else 0 for edge in what}
    return lengths <= {2, 3} and not (len(what) == n and lengths == {n})


def _named_edges(name: str, formation: str | None, n: int) -> Edges:
    everybody = range(n)
    if name in ("weak", "strong"):
        if formation not in FORMATIONS:
            raise ValueError(
                f"the graph {name!r} belongs to the formations {', '.join(FORMATIONS)}; for other slots take "
                f"{', '.join(GRAPHS[2:6])} or an ({n}, {n}) matrix"
            )
        if formation == "hexagon" and n != 6:
            raise ValueError(f"the graph {name!r} of a hexagon has 6 vehicles, got {n}: take 6 or 'lattice'")
        tree = _HEXAGON_WEAK if formation == "hexagon" else _lattice_tree(n)
        if name == "weak":
            return tree
        followers = [(a, b) for a in everybody[1:] for b in everybody[1:] if a != b]
        return [(a, b) for a, b in tree if a == 0] + followers
    if name == "chain":
        return [(a, a + 1) for a in everybody[:-1]]
    if name == "ring":
        return [(a, (a + step) % n) for a in everybody for step in (1, -1) if n > 1]
    if name == "star":
        return [(0, b) for b in everybody[1:]]
    if name == "complete":
        return [(a, b) for a in everybody for b in everybody if a != b]
    if name not in _CASES:
        raise ValueError(f"{unknown_name('graph', name, GRAPHS)}, or an ({n}, {n}) matrix of weights")
    if n != 6:
        raise ValueError(f"the graph {name!r} of chapter 7 has 6 vehicles, got {n}: take 6 or another graph")
    return _CASES[name]


def _lattice_tree(n: int) -> list[tuple[int, int]]:
    """Slot (r, j) hears slot (r - 1, min(j, r - 1))."""
    cells = lattice_cells(n)
    number = {cell: i for i, cell in enumerate(cells)}
    return [(number[r - 1, min(j, r - 1)], number[r, j]) for r, j in cells if r > 0]


def hops(G: Array, root: int = 0) -> NDArray[np.int64]:
    """Links from the root to each vehicle along the flow of information, breadth first: (n,), -1: none."""
    out = np.full(len(G), -1, dtype=np.int64)
    out[root] = 0
    reached = [root]
    for sender in reached:  # grows while it is read
        for receiver in np.flatnonzero((G[:, sender] > 0.0) & (out < 0)):
            out[receiver] = out[sender] + 1
            reached.append(int(receiver))
    return out


def has_spanning_tree(G: Array, root: int = 0) -> bool:
    """Whether what the root says can reach every vehicle."""
    return bool((hops(G, root) >= 0).all())


def union_has_tree(Gs: Array, root: int = 0) -> bool:
    """Whether the union of the graphs Gs (m, n, n) has a spanning tree: the condition on a window of 5.4."""
    return has_spanning_tree(np.max(Gs, axis=0), root)


def toward_leader(G: Array, weight: float = 10.0, root: int = 0) -> Array:
    """G with this weight where the one heard is nearer to the leader, in links, than the one who hears.

    Args:
        G: Weights, (n, n).
        weight: Of such links.
        root: Number of the leader.

    Raises:
        ValueError: If one is not allowed.
    """
    try:
        given = np.asarray(G, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        given = np.empty(0)
    if given.ndim != 2 or given.shape[0] != given.shape[1]:
        raise ValueError(f"G must be a square matrix of weights, got {shown(G)}")
    G = given
    require_whole("root", root, 0, len(G) - 1)
    require_number("weight", weight, Bound())
    distance = hops(G, root)
    distance[distance < 0] = len(G)
    return np.where((G > 0.0) & (distance[None, :] < distance[:, None]), weight, G)


def in_neighbours(Gs: Array) -> NDArray[np.int64]:
    """Whom each vehicle ever hears in the graphs Gs (m, n, n) or (n, n): (n, K), ascending, then -1."""
    n = Gs.shape[-1]
    heard = (Gs.reshape(-1, n, n) > 0.0).any(axis=0) & ~np.eye(n, dtype=bool)
    out = np.full((n, int(heard.sum(axis=1).max(initial=0))), -1, dtype=np.int64)
    for i in range(n):
        senders = np.flatnonzero(heard[i])
        out[i, : senders.size] = senders
    return out


def _frozen(graphs: Sequence[GraphLike]) -> tuple[Any, ...]:
    """Names and nested tuples, so that a schedule is a value."""
    if isinstance(graphs, str):
        raise ValueError(f"a schedule needs a sequence of graphs, got the single name {graphs!r}")

    def nested(entry: Any) -> Any:
        entry = entry.tolist() if isinstance(entry, np.ndarray) else entry
        return tuple(map(nested, entry)) if isinstance(entry, list | tuple) else entry

    def plain(entry: Any) -> Any:
        if isinstance(entry, str) or is_networkx(entry):
            return entry if isinstance(entry, str) else edges_of(entry)
        return nested(entry if isinstance(entry, list | tuple) else np.asarray(entry).tolist())

    frozen = tuple(map(plain, graphs))
    if not frozen:
        raise ValueError("a schedule needs at least one graph, got none")
    return frozen


# Three graphs of the triangle without a tree, whose union is its weak graph: 1>2, 3>5; 1>3, 2>4; 3>6.
TRIANGLE_SUBGRAPHS = _frozen(
    [adjacency(6, edges) for edges in (((0, 1), (2, 4)), ((0, 2), (1, 3)), ((2, 5),))]
)


@dataclass(frozen=True, slots=True)
class Switching:
    """Graphs in turn, each for `dwell_steps` control periods, again and again.

    Raises:
        ValueError: If there is no graph or the dwell is not an integer >= 1.
    """

    graphs: Sequence[GraphLike] = TRIANGLE_SUBGRAPHS
    dwell_steps: int = 5

    def __post_init__(self) -> None:
        require_kinds(self)
        object.__setattr__(self, "graphs", _frozen(self.graphs))
        dwell = self.dwell_steps
        if isinstance(dwell, bool) or not isinstance(dwell, int | np.integer) or dwell < 1:
            raise ValueError(f"dwell_steps must be an integer >= 1, got {shown(dwell)}")

    def which(self, steps: int, dt: float) -> NDArray[np.int64]:
        """Number of the graph at steps 0 .. steps, (steps + 1,)."""
        return (np.arange(steps + 1) // self.dwell_steps) % len(self.graphs)


@dataclass(frozen=True, slots=True)
class Timed:
    """Graph m from times[m] on, until the next begins.

    Raises:
        ValueError: If there is no graph, or the times do not start at 0, increase, and match the graphs.
    """

    graphs: Sequence[GraphLike]
    times: tuple[float, ...]  # s

    def __post_init__(self) -> None:
        require_kinds(self)
        object.__setattr__(self, "graphs", _frozen(self.graphs))
        object.__setattr__(self, "times", tuple(float(time) for time in self.times))
        if len(self.times) != len(self.graphs):
            raise ValueError(
                f"give one time per graph, got {len(self.times)} times and {len(self.graphs)} graphs"
            )
        steps = np.diff(self.times)
        if self.times[0] != 0.0 or not (np.isfinite(self.times).all() and (steps > 0.0).all()):
            raise ValueError(f"times of a schedule must start at 0 s and increase, got {self.times}")

    def which(self, steps: int, dt: float) -> NDArray[np.int64]:
        """Number of the graph at steps 0 .. steps, (steps + 1,)."""
        now = np.arange(steps + 1) * dt + 1e-9  # a switch at a multiple of dt must not be late by rounding
        return np.searchsorted(self.times, now, side="right").astype(np.int64) - 1


def _chapter_6() -> Timed:
    """Figures 6.2 to 6.5: whose measurements each vehicle holds, from 0, 2.5 and 5 s on."""
    held = (
        ((1, 2, 3, 4), (2, 3), (1, 3, 4), (3, 4)),
        ((1, 2, 3), (2, 3, 4), (3, 4), (3, 4)),
        ((1, 2), (1, 2, 3, 4), (3, 4), (2, 3, 4)),
    )
    graphs = [
        adjacency(4, [(j - 1, i) for i, row in enumerate(rows) for j in row if j - 1 != i]) for rows in held
    ]
    return Timed(graphs, (0.0, 2.5, 5.0))


class GraphTable(NamedTuple):
    """The graphs of an episode and which of them holds when."""

    graphs: Array  # (M, N, N), each of which holds at some step
    which: NDArray[np.int64]  # (steps + 1,), row of `graphs` at each step


GraphSchedule: TypeAlias = "Switching | Timed | Mapping[str, Any] | Callable[[int], GraphLike]"
KINDS: dict[str, Any] = {"switching": Switching(), "timed": Timed}


def make_graph_table(
    what: GraphLike | GraphSchedule, formation: str | None, n: int, steps: int, dt: float
) -> GraphTable:
    """The graphs of an episode from a graph, a schedule, or a function of the step.

    Args:
        what: What `make_graph` takes, one of `SCHEDULES`, a `Switching`, a `Timed`, a mapping {"kind":
            "switching", "dwell_steps": 10, ...} of one of these, or a function of the step number
            k = 0 .. steps that returns what `make_graph` takes.
        formation: Name of the formation, or None.
        n: Number of vehicles.
        steps: Control periods of an episode.
        dt: Control period, s.

    Returns:
        The table; graphs that never hold within the episode are not in it.

    Raises:
        ValueError: If a graph or the schedule does not fit the team.
    """
    refuse_class("graph", what)
    if isinstance(what, Mapping):
        what = make_kind("graph", what, KINDS)
    if isinstance(what, str) and what in SCHEDULES:
        team = 4 if what == "chapter-6" else 6
        if n != team:
            raise ValueError(f"the schedule {what!r} has {team} vehicles, got {n}: take {team} or Switching")
        what = _chapter_6() if what == "chapter-6" else Switching()
    if isinstance(what, str) and what not in GRAPHS:
        raise ValueError(f"{unknown_name('graph', what, GRAPHS + SCHEDULES)}, a matrix or a schedule")
    if isinstance(what, Switching | Timed):
        graphs = np.stack([make_graph(graph, formation, n) for graph in what.graphs])
        which = what.which(steps, dt)
    elif callable(what):
        graphs, which = _sampled(what, formation, n, steps)
    else:
        G = make_graph(what, formation, n)  # type: ignore[arg-type]
        graphs, which = G[None], np.zeros(steps + 1, dtype=np.int64)
    used, which = np.unique(which, return_inverse=True)
    return GraphTable(np.ascontiguousarray(graphs[used]), which.astype(np.int64))


def _sampled(
    function: Callable[[int], GraphLike], formation: str | None, n: int, steps: int
) -> tuple[Array, NDArray[np.int64]]:
    """The different graphs of a function of the step, in the order of their appearance, and which holds."""
    graphs: list[Array] = []
    number: dict[bytes, int] = {}
    which = np.empty(steps + 1, dtype=np.int64)
    for k in range(steps + 1):
        G = make_graph(function(k), formation, n)
        which[k] = number.setdefault(G.tobytes(), len(graphs))
        if which[k] == len(graphs):
            graphs.append(G)
    return np.stack(graphs), which
