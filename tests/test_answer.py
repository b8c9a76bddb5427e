"""The answer in a sentence: who wins, by how much, under which limits, and who cannot be told apart."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from baselines import evaluate
from baselines.evaluation.amounts import INTERVAL_LEAST
from baselines.evaluation.metrics import estimate
from baselines.evaluation.statistics import compare, difference, mean_interval
from baselines.report.answer import answer, percent, rounded
from baselines.sweeps.contenders import Contender


@pytest.fixture(scope="module")
def flown():
    return evaluate("hover", "quad/HelixTracking-v0", 1, 0)


@pytest.fixture
def contender(flown):
    """Makes a contender from the scores of its starts, or of its seeds and starts."""

    def made(name, scores, violating=0.0, crashed=0, limits=(), first=0):
        evaluations = tuple(
            replace(
                flown,
                decision_ms=(0.2, 0.3, 0.4),
                records=tuple(
                    flown.records[0]._replace(
                        seed=first + k,
                        score=float(score),
                        violation_share=violating,
                        crashed=k < crashed,
                        worst_violation=dict.fromkeys(limits, 0.0),
                    )
                    for k, score in enumerate(seed)
                ),
            )
            for seed in np.atleast_2d(scores)
        )
        return Contender("e", "", name, "controller", True, "", (), evaluations, ())

    return made


SCORES = np.linspace(0.5, 0.8, 20)
WIGGLE = 0.01 * (-1.0) ** np.arange(20)


def test_the_winner_the_difference_the_limits_and_the_time_are_said(contender):
    found = answer([[contender("lmpc", SCORES), contender("nmpc", SCORES + 0.04 + 0.1 * WIGGLE)]])
    assert re.fullmatch(
        r"nmpc wins with a score of 0\.690, 0\.0400 ± 0\.000\d more than lmpc from the same 20 starts, "
        r"without a crash, deciding in 0\.20 ms\.",
        found.sentence,
    )
    assert found.pair == ("nmpc", "lmpc")


def test_who_cannot_be_told_apart_is_named_and_does_not_lose(contender):
    group = [
        contender("a", SCORES),
        contender("b", SCORES + WIGGLE),
        contender("far", SCORES - 0.2),
        contender("c", SCORES - 0.05 * WIGGLE),
    ]
    found = answer([group])
    assert " leads with a score of 0.650, 0.20" in found.sentence
    assert "more than far from the same 20 starts" in found.sentence
    assert "cannot be told apart from it." in found.sentence and found.pair[1] == "far"


def test_who_scores_more_by_breaking_limits_or_crashing_does_not_win(contender):
    group = [
        contender("nmpc", SCORES, limits=("tilt",)),
        contender("ppo", SCORES + 0.02, violating=0.203, limits=("tilt",)),
        contender("reckless", SCORES + 0.1, crashed=3, limits=("tilt",)),
    ]
    found = answer([group])
    assert found.sentence.startswith("nmpc wins with a score of 0.650, without a violation or a crash")
    assert (
        "ppo scores 0.020 more, violating a limit in 20 % of its steps and without a crash" in found.sentence
    )
    assert "reckless scores 0.100 more, crashing in 3 of 20 flights" in found.sentence


def test_below_five_starts_nobody_wins_and_there_is_no_interval(contender):
    few = SCORES[: INTERVAL_LEAST - 1]
    found = answer([[contender("a", few), contender("b", few + 0.1)]])
    assert "b leads with a score of" in found.sentence and "±" not in found.sentence
    assert "4 starts tell nobody apart from it" in found.sentence


def test_one_policy_is_told_without_a_winner(contender):
    assert answer([[contender("a", SCORES)]]).sentence.startswith(
        "a scores 0.650 in 20 flights, without a crash"
    )
    assert answer([]).sentence == "" == answer([[]]).sentence


def test_over_several_environments_only_who_flew_in_all_is_compared(contender):
    one = [contender("a", SCORES), contender("b", SCORES + 0.1), contender("only here", SCORES + 0.2)]
    other = [contender("b", SCORES + 0.1), contender("a", SCORES)]
    found = answer([one, other]).sentence
    assert found.startswith("Over 2 environments, b wins with a score of 0.750, 0.100")
    assert "only here" not in found


def test_differences_are_of_starts_that_both_have_flown(contender):
    group = [contender("a", SCORES), contender("b", SCORES[:8] + 0.1)]
    assert "0.100" in answer([group]).sentence
    assert "wins" not in answer([[contender("a", SCORES), contender("b", SCORES + 9.0, first=50)]]).sentence


@pytest.mark.parametrize(
    ("mean", "half", "text"),
    [
        (0.81312, 0.0042, "0.813 ± 0.004"),
        (0.81312, 0.0142, "0.813 ± 0.014"),
        (0.81312, 0.0999, "0.81 ± 0.10"),
        (266.4, 3.6, "266 ± 4"),
        (1046.0, 160.0, "1050 ± 160"),
        (1046.0, 260.0, "1000 ± 300"),
        (0.5, math.nan, "0.500"),
        (0.0, 0.0, "0"),
    ],
)
def test_a_number_is_rounded_to_its_interval(mean, half, text):
    assert rounded(mean, half) == text


@pytest.mark.parametrize("n", [2, INTERVAL_LEAST - 1])
def test_no_interval_is_said_below_five_flights(n):
    values = SCORES[:n]
    assert math.isnan(estimate(values).half_width) and estimate(values).mean == values.mean()
    for interval in (
        difference([values[None]], [values[None] + 1.0]),
        mean_interval(values[None]),
        *compare([values[None]], [values[None]]),
    ):
        assert math.isfinite(interval.value) and math.isnan(interval.low) and math.isnan(interval.high)
    assert estimate(SCORES[:INTERVAL_LEAST]).half_width > 0.0


def test_the_difference_alone_is_the_one_of_the_comparison():
    rng = np.random.default_rng(0)
    x, y = rng.random((3, 30)), rng.random((1, 30))
    one, other = difference([x], [y]), compare([x], [y]).difference
    assert one.value == pytest.approx(other.value, abs=1e-12)
    assert (one.low, one.high) == pytest.approx((other.low, other.high), abs=0.02)
    own = mean_interval(x)
    assert own.low < own.value < own.high and math.isnan(mean_interval(np.full((1, 9), np.nan)).low)


def test_a_share_next_to_nothing_is_said_in_words():
    assert [percent(share) for share in (0.0, 4e-5, 0.0123)] == ["0 %", "less than 0.01 %", "1.2 %"]
