"""What the page is given, as data. It is stored in the page as JSON, field by field under these names.

Report
  run, notes, environments           words and numbers
  blobs                              quantised series, base64; a channel names its own by number
Environment                          one leaderboard and its flights
  columns, rows                      cells are [mean, half width of the 95 % interval], null where none
  flights                            Flight, each with its channels

A channel is a table (vehicles, rows, components) of one quantity of a flight. Its numbers are mapped from
[low, high] to whole numbers -32767..32767 (-32768 is nan), written series after series (vehicle, then
component) as differences modulo 2^16, 16 bit little-endian, and deflated. `log` says that the logarithm to
base 10 was quantised. `quantise.decode` is the readable twin of what the page does.

| channel | components | content |
|---|---|---|
| p, reference | 3 | m, NED, positions flown and wanted; rows 0..T |
| attitude | 3 | rad, roll, pitch, yaw; rows 0..T |
| forces | 4 | N, rotor forces; rows 0..T |
| constraints | one per limit | SI, value minus limit; rows 0..T-1, as all below |
| decision | 1, log | ms, wall time of the decision per vehicle |
| slot_error, separation | 1 | m, of a team's vehicle: to its slot, to the nearest other |
| target | 3 | m, NED, one for all vehicles; rows 0..T |
| estimate | 3 | m, NED, where the vehicle believes the target to be |
| root | 6 | m, lower Cholesky factor of that position's covariance: xx, yx, yy, zx, zy, zz |
| nees | 1, log | -, e' P^-1 e of the position, chi-square with 3 degrees of freedom for an honest filter |
"""

from __future__ import annotations

from typing import Any, NamedTuple

PAGE_FORMAT = 2  # of this data, for those who read it out of a page


class Channel(NamedTuple):
    """One quantity of a flight."""

    name: str
    vehicles: int
    rows: int
    components: int
    low: float
    high: float
    log: bool
    blob: int  # number in Report.blobs


class Flight(NamedTuple):
    """One flight of a vehicle or a team."""

    policy: str  # title
    seed: int
    dt: float  # s, between rows: the control period times the stride
    lengths: tuple[int, ...]  # rows that each vehicle flew, 0..T-1
    crashed: tuple[bool, ...]
    score: float | None  # -, mean over the vehicles
    channels: tuple[Channel, ...]
    graphs: tuple[tuple[tuple[int, int], ...], ...] = ()  # links (hearer, sender) of each graph
    schedule: tuple[tuple[int, int], ...] = ()  # (row from which it holds, graph)


class Column(NamedTuple):
    """A column of the leaderboard."""

    key: str
    title: str
    unit: str
    about: str
    better: int  # 1: more is better, -1: less is better, 0: neither
    kind: str = "number"  # or "score", "difference", "interval", "percent", "count"
    main: bool = False  # whether it stands in the first table, and not behind "more" alone


class Row(NamedTuple):
    """A policy in the leaderboard."""

    policy: str
    privileged: bool
    cells: dict[str, tuple[float | None, ...]]  # column -> mean, half width; or value, low, high


class Frontier(NamedTuple):
    """A picture of score against quadratic cost, and who has no place in it; empty where there is none."""

    svg: str = ""
    note: str = ""


class Answer(NamedTuple):
    """Who wins, by how much, and who is as good."""

    sentence: str = ""
    pair: tuple[str, ...] = ()  # the winner, and the best of those that are told apart from it


class Board(NamedTuple):
    """A table of contenders: controllers, and networks and tuned controllers with all their seeds."""

    title: str  # of the suite's table, "" where there is one only
    about: str
    base: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    names: dict[str, str]  # contender -> its row; afterwards policy whose flights are shown -> row
    frontier: Frontier = Frontier()
    answer: Answer = Answer()


class Environment(NamedTuple):
    """An environment of the suite: how the policies did, and their flights."""

    title: str
    place: str  # title without the condition
    condition: str
    id: str
    kwargs: dict[str, Any]
    task: dict[str, Any]  # parameters as flown, see `folder.task_facts`
    base: str  # policy from which differences are taken
    note: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    answer: Answer = Answer()
    boards: tuple[Board, ...] = ()  # where policies have seeds, or the suite has tables
    flights: tuple[Flight, ...] = ()


class Report(NamedTuple):
    """All of it."""

    format: int
    title: str
    run: dict[str, Any]  # command, versions, revision, platform, seeds, counts
    notes: tuple[str, ...]  # what is missing or was left out, and why
    answers: tuple[str, ...]  # sentences over all environments, one per table; none where there is one
    environments: tuple[Environment, ...]
    blobs: tuple[str, ...]
    open: dict[str, Any] | None = None  # flight with which the page begins: env, seed, policy


def to_plain(value: Any) -> Any:
    """A report as JSON knows it; NamedTuples become mappings, nan and infinity None."""
    if isinstance(value, tuple) and hasattr(value, "_asdict"):
        return {key: to_plain(entry) for key, entry in value._asdict().items()}
    if isinstance(value, dict):
        return {str(key): to_plain(entry) for key, entry in value.items()}
    if isinstance(value, tuple | list):
        return [to_plain(entry) for entry in value]
    if isinstance(value, float) and not abs(value) < float("inf"):
        return None
    return value
