"""How the trajectories of tables 4.1 and 4.2 were found, and what that leaves to predict.

The text shows them as pictures. Members of a family are drawn at random and flown at N = 25; those whose two
RMS are within 3 % of the printed ones could be the text's. Several are, so that radii, rates and speeds are
not identified one by one, and the agreement of the tables is chosen. The order of the two controllers is not:
it is counted over all that were drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from quad_envs.references import Helix, OutAndBack, Reference, SphericalSpiral

from .flights import HORIZON, Flight, fly_all
from .published import TABLE_4_1
from .results import Claim, Numbers, Section, verdict

SAMPLES = 63  # of each family
NEAR = 0.03  # relative misfit of both cells


class Family(NamedTuple):
    """Trajectories of one kind: ranges of its numbers, in the order of their fields."""

    kind: Callable[..., Reference]
    ranges: tuple[tuple[float, float], ...]
    said: str

    def draw(self, rng: np.random.Generator) -> Reference:
        """A member, each number uniform in its range."""
        return self.kind(*(float(rng.uniform(*between)) for between in self.ranges))


FAMILIES = {
    "helix": Family(
        Helix, ((4.0, 8.0), (0.3, 0.5), (2.0, 4.0)), "R 4 to 8 m, w .3 to .5 rad/s, v_z 2 to 4 m/s"
    ),
    "spiral": Family(
        SphericalSpiral, ((4.0, 6.0), (0.15, 0.4), (0.2, 0.4)), "R 4 to 6 m, w .15 to .4, c .2 to .4 rad/s"
    ),
    "lines": Family(
        OutAndBack, ((0.8, 1.7), (0.5, 1.5), (3.0, 7.0)), "v .8 to 1.7, v_z .5 to 1.5 m/s, turn at 3 to 7 s"
    ),
}


class Drawn(NamedTuple):
    """A member of a family as LMPC and the text's NMPC fly it."""

    rms: tuple[float, float]  # m
    effort: tuple[float, float]  # N^2

    def fits(self, printed: tuple[float, float]) -> bool:
        """Whether both RMS are within NEAR of the printed ones."""
        return all(abs(ours / theirs - 1.0) <= NEAR for ours, theirs in zip(self.rms, printed, strict=True))


def printed_rms(task: str) -> tuple[float, float]:
    """The cells of table 4.1 at N = 25, of LMPC and NMPC, m."""
    row = next(row for row in TABLE_4_1 if (row.task, row.horizon) == (task, HORIZON))
    return row.lmpc, row.nmpc


def draw_family(task: str, samples: int = SAMPLES, jobs: int = 1) -> list[Drawn]:
    """Members of a family, flown."""
    rng = np.random.default_rng(0)
    members = [FAMILIES[task].draw(rng) for _ in range(samples)]
    flown = fly_all([Flight(name, member) for member in members for name in ("LMPC", "SDC 1/2")], jobs)
    records = [outcome.record for outcome in flown]
    return [
        Drawn((linear.position_rms, ours.position_rms), (linear.effort, ours.effort))
        for linear, ours in zip(records[::2], records[1::2], strict=True)
    ]


def family_claim(families: Mapping[str, Sequence[Drawn]]) -> Claim:
    """What the members of the families that were drawn say: how many fit, and who is better."""
    numbers: Numbers = {}
    lower: list[bool] = []
    for task, members in families.items():
        better = [each.rms[1] < each.rms[0] for each in members]
        n = len(members)
        numbers[f"{task}: {FAMILIES[task].said}"] = {
            f"both RMS within {NEAR:.0%} of the table": f"{_count(members, task)} of {n}",
            "NMPC has the lower RMS": f"{sum(better)} of {n}",
            "NMPC needs less effort": f"{sum(each.effort[1] < each.effort[0] for each in members)} of {n}",
        }
        lower += better
    text = "ours, and no fit: NMPC has the lower RMS than LMPC on every member of each family, descending"
    return Claim("4-family", text, verdict(float(np.mean(lower))), numbers, own=True)


def _count(members: Sequence[Drawn], task: str) -> int:
    return sum(each.fits(printed_rms(task)) for each in members)


def identification(jobs: int = 1) -> Section:
    """The families of all three trajectories."""
    families = {task: draw_family(task, jobs=jobs) for task in FAMILIES}
    title = f"How the trajectories of the tables were identified: {SAMPLES} random ones of each kind, N = 25"
    return Section("identification", title, [], [family_claim(families)])
