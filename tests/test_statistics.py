"""Statistics of learned policies: interquartile means, paired differences, probabilities of improvement."""

import numpy as np
import pytest
from scipy.stats import mannwhitneyu, trim_mean

from baselines.evaluation.statistics import compare, difference, interquartile_mean, mean_interval


def test_the_interquartile_mean_is_scipys_trimmed_mean():
    values = np.random.default_rng(0).normal(size=(3, 37))
    assert np.allclose(interquartile_mean(values), trim_mean(values, 0.25, axis=1), rtol=1e-14)


def test_the_probability_of_improvement_on_one_start_is_mann_and_whitneys():
    rng = np.random.default_rng(1)
    x, y = rng.integers(5, size=(6, 1)).astype(float), rng.integers(5, size=(4, 1)).astype(float)
    u = mannwhitneyu(x[:, 0], y[:, 0]).statistic  # counts equal pairs half
    assert compare([x], [y], resamples=10).improvement.value == pytest.approx(u / (6 * 4))


def test_differences_are_taken_on_the_same_start():
    starts = 100.0 * np.random.default_rng(2).normal(size=(1, 20))
    found = compare([starts + 1.0], [starts])
    assert found.difference == pytest.approx((1.0, 1.0, 1.0))
    assert found.improvement == (1.0, 1.0, 1.0)


def test_the_interval_covers_the_truth_about_95_times_in_100():
    rng, covered = np.random.default_rng(3), 0
    for k in range(300):
        # The spread between training seeds rules, and only 8 of them are known: a percentile bootstrap is
        # known to be too narrow by the factor sqrt(7/8), which gives 92 %, less a Student's tail.
        x = rng.normal(size=(8, 1)) + 0.1 * rng.normal(size=(8, 20))
        low, high = compare([x], [np.zeros((1, 20))], resamples=300, seed=k).difference[1:]
        covered += low <= 0.0 <= high
    assert 0.84 < covered / 300 < 0.97


def test_tasks_count_the_same_however_many_starts_they_have():
    found = compare([np.ones((2, 3)), np.zeros((5, 30))], [np.zeros((1, 3)), np.zeros((1, 30))])
    assert found.difference.value == 0.5 and found.improvement.value == 0.75


@pytest.mark.parametrize(
    ("ours", "theirs", "message"),
    [
        ([], [], "same tasks on both sides, got 0 and 0"),
        ([np.ones((2, 3))], [np.ones((1, 4))], r"same starts, got shapes \(2, 3\) and \(1, 4\)"),
        ([np.full((1, 3), np.nan)], [np.ones((1, 3))], "needs finite values"),
    ],
)
def test_what_cannot_be_compared_is_refused(ours, theirs, message):
    with pytest.raises(ValueError, match=message):
        compare(ours, theirs)


def test_what_is_drawn_in_portions_is_no_other_statistic(monkeypatch):
    rng = np.random.default_rng(5)
    ours, theirs = ([rng.normal(size=(1, 200))] for _ in range(2))
    whole = compare(ours, theirs), difference(ours, theirs), mean_interval(ours[0])
    monkeypatch.setattr("baselines.evaluation.statistics._AT_ONCE", 3_333)  # 16 resamples at a time
    assert (compare(ours, theirs), difference(ours, theirs), mean_interval(ours[0])) == whole
