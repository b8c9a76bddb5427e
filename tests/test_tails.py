"""How bad rare flights are: quantiles and shares with intervals, in every place where tables are."""

from __future__ import annotations

import csv
import json
import math

import gymnasium as gym
import numpy as np
import pytest
import scipy.stats

from baselines import evaluate, run_benchmark
from baselines.evaluation.amounts import TAILS_LEAST
from baselines.evaluation.columns import COLUMNS, read_record
from baselines.evaluation.tails import quantile_interval, share_interval, tails
from baselines.report import build_report
from baselines.sweeps.folder import read_run

HELIX = "quad/HelixTracking-v0"


@pytest.fixture(scope="module")
def flown():
    """A thousand short flights."""
    return evaluate("lqr", gym.make(HELIX, time_limit=0.5), episodes=TAILS_LEAST)


@pytest.mark.parametrize(("count", "n"), [(0, 1000), (0, 10_000), (1, 1000), (37, 1000), (1000, 1000)])
def test_a_share_has_the_interval_of_scipy_exact_test(count, n):
    value, low, high = share_interval(count, n)
    other = scipy.stats.binomtest(count, n).proportion_ci(0.95, "exact")
    assert value == count / n
    assert (low, high) == pytest.approx((other.low, other.high), abs=1e-12)


def test_no_crash_is_bounded_from_above():
    assert share_interval(0, 10_000) == pytest.approx((0.0, 0.0, 3.688e-4), rel=1e-3)


@pytest.mark.parametrize("n", [1000, 3687, 3688, 10_000])
def test_a_quantile_is_an_order_statistic_and_few_values_do_not_bound_it(n):
    value, low, high = quantile_interval(np.random.default_rng(0).permutation(n) + 1.0)
    assert value == math.ceil(0.999 * n)
    # Fewer values than that lie all below the quantile with more than 2.5 %.
    assert (high == math.inf) == (0.999**n > 0.025)
    assert scipy.stats.binom.cdf(low - 1, n, 0.999) <= 0.025 < scipy.stats.binom.cdf(low, n, 0.999)


def test_the_interval_of_a_quantile_covers_it_as_often_as_it_says():
    rng, true = np.random.default_rng(1), -math.log(0.001)
    found = [quantile_interval(rng.exponential(size=5000)) for _ in range(1000)]
    covered = np.mean([low <= true <= high for _, low, high in found])
    assert covered > 0.94  # at least 95 %, and its error here is 0.7 %


def test_a_crash_counts_as_larger_than_any_error(flown):
    records = list(flown.records)
    whole = tails(records)["position_rms_tail"]
    assert whole.value == sorted(record.position_rms for record in records)[998]
    records[3] = records[3]._replace(crashed=True, position_rms=math.nan)
    assert math.isfinite(tails(records)["position_rms_tail"].value)  # one in a thousand
    records[4] = records[4]._replace(crashed=True, position_rms=math.nan)
    assert tails(records)["position_rms_tail"].value == math.inf
    assert tails(records)["crash_probability"].value == 0.002


def test_an_error_that_has_no_number_in_a_flight_has_no_quantile(flown):
    records = list(flown.records)
    records[3] = records[3]._replace(position_rms=math.nan)
    assert list(tails(records)) == ["crash_probability"]


def test_of_few_flights_nothing_is_said_of_one_in_a_thousand(flown):
    assert tails(flown.records[:-1]) == {}
    assert list(tails(flown.records)) == ["position_rms_tail", "crash_probability"]


def test_an_evaluation_says_them_in_its_table_and_in_json(flown):
    assert "Position RMS, 99.9 %: " in str(flown) and "P(crash): 0 % [0, 0.368], 95 % interval" in str(flown)
    found = json.loads(json.dumps(flown.to_dict(), allow_nan=False))["tails"]
    assert found["crash_probability"]["high"] == pytest.approx(0.003682, rel=1e-3)
    assert found["position_rms_tail"]["high"] is None  # a thousand flights do not bound it
    plain = flown.to_plain()
    few = plain | {"records": plain["records"][:20]}
    assert "tails" not in type(flown).from_plain(few).to_dict()


def test_a_benchmark_says_them_in_tables_and_behind_more_on_the_page(tmp_path):
    env = {"id": HELIX, "kwargs": {"time_limit": 0.5}}
    suite = {"name": "tails", "envs": [env], "policies": ["hover", "lqr"], "episodes": TAILS_LEAST}
    results = run_benchmark(suite, tmp_path / "run")
    assert "RMS 99.9 % m" in str(results) and "P(crash) %" in str(results) and "0 [0, 0.368]" in str(results)
    with open(tmp_path / "run" / "summary.csv", newline="") as file:
        (row, _) = csv.DictReader(file)
    assert float(row["crash_probability"]) == 0.0 and float(row["crash_probability_high"]) > 0.003
    assert float(row["position_rms_tail"]) > float(row["position_rms"])
    (shown,) = build_report(read_run(tmp_path / "run")).environments
    found = {column.key: column for column in shown.columns}
    for key in ("position_rms_tail", "crash_probability"):
        assert found[key].kind == "interval" and not found[key].main
    assert found["crash_probability"].unit == "%"
    value, low, high = shown.rows[0].cells["crash_probability"]
    assert (value, low) == (0.0, 0.0) and high == pytest.approx(0.368, rel=1e-2)
    few = run_benchmark({**suite, "episodes": 2})
    assert "P(crash)" not in str(few) and "crash_probability" not in few.summary()[0]


def test_a_record_of_a_team_has_the_tail_of_its_own_error():
    assert {name for name in COLUMNS if name.endswith("_tail")} == {
        *("position_rms_tail", "formation_rms_tail", "estimate_rmse_tail"),
    }
    base = dict.fromkeys(read_record.__globals__["Record"]._fields, 0.1)
    team = [
        read_record(
            {**base, "seed": seed, "agent": name, "crashed": False, "crash_cause": "", "worst_violation": {}}
        )
        for seed in range(TAILS_LEAST)
        for name in ("drone_0", "drone_1")
    ]
    assert tails(team)["formation_rms_tail"].value == 0.1
