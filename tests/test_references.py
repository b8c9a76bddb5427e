"""Reference trajectories: velocities are derivatives of positions, and bad tables are refused."""

import pickle
from dataclasses import fields

import gymnasium as gym
import numpy as np
import pytest

from quad_envs.references import (
    Heading,
    Helix,
    Lemniscate,
    Line,
    Mixture,
    OutAndBack,
    Racetrack,
    RandomSmooth,
    SetPoint,
    SphericalSpiral,
    from_csv,
    from_function,
    make_reference,
)

ALL = [
    SetPoint((1.0, 2.0, 3.0)),
    Helix(),
    SphericalSpiral(),
    OutAndBack(),
    Lemniscate(),
    Line(),
    Racetrack(),
    RandomSmooth(),
    Mixture(lines=0.0),  # lines turn at one time
]


def circle(t):
    return [2 * np.cos(t), 2 * np.sin(t), -0.1 * t]


def rows_of(reference, t, seed=0):
    return reference.rows(np.asarray(t, dtype=float), np.random.default_rng(seed))


@pytest.mark.parametrize("reference", [*ALL, from_function(circle)], ids=lambda r: type(r).__name__)
def test_velocity_is_the_derivative_of_position(reference):
    t, h = np.array([0.3, 2.1, 4.4, 7.3]), 1e-5
    slope = (rows_of(reference, t + h)[:, :3] - rows_of(reference, t - h)[:, :3]) / (2 * h)
    np.testing.assert_allclose(rows_of(reference, t)[:, 3:6], slope, atol=1e-5)


@pytest.mark.parametrize("reference", ALL, ids=lambda r: type(r).__name__)
def test_heading_is_stored_as_sine_and_cosine(reference):
    rows = rows_of(reference, np.linspace(0, 10, 50))
    np.testing.assert_allclose(rows[:, 6] ** 2 + rows[:, 7] ** 2, 1.0)


def test_lines_turn_at_the_sample_of_the_turn_time():
    rows = rows_of(OutAndBack(), 0.05 * np.arange(200))
    assert (rows[99, 3:6] > 0).all() and (rows[100, 3:6] < 0).all()
    np.testing.assert_allclose(rows[100, :3], [6.25, 6.25, 5.0])


def test_random_reference_starts_at_the_origin_differs_by_seed_and_repeats_by_seed():
    t = np.linspace(0, 10, 40)
    first, again, other = (
        rows_of(RandomSmooth(), t, 1),
        rows_of(RandomSmooth(), t, 1),
        rows_of(RandomSmooth(), t, 2),
    )
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    np.testing.assert_allclose(first[0, :3], 0.0, atol=1e-12)


def mixed(n=400, **weights):
    mixture, t = Mixture(**weights), 0.05 * np.arange(226)
    return np.stack([rows_of(mixture, t, seed) for seed in range(n)])


def test_a_mixture_is_within_reach_of_the_vehicle():
    rows = mixed(lines=0.0, turning=0.0)
    speed = np.linalg.norm(rows[..., 3:6], axis=2)
    acceleration = np.linalg.norm(np.diff(rows[..., 3:6], axis=1), axis=2) / 0.05
    assert 2.0 < speed.max() < 4.5
    assert acceleration.max() < 6.5  # m/s^2; the rotors give 9.8
    assert np.linalg.norm(rows[:, 0, :3], axis=1).max() < 4.95 + 2.0 * 3**0.5  # a spiral, displaced
    np.testing.assert_array_equal(rows[..., 6:], np.broadcast_to([0.0, 1.0], rows[..., 6:].shape))


def test_the_heading_of_a_mixture_turns_in_a_share_of_the_episodes():
    rows = mixed(1000)
    psi = np.unwrap(np.arctan2(rows[..., 6], rows[..., 7]), axis=1)
    turns = psi[:, -1] != 0.0
    assert turns.mean() == pytest.approx(0.25, abs=0.055)  # four deviations of 1000 draws
    rates = np.diff(psi, axis=1) / 0.05
    np.testing.assert_allclose(rates, rates[:, :1] * np.ones(225), atol=1e-9)
    assert 0.3 < np.abs(rates).max() < 0.4 and (psi[:, 0] == 0.0).all()


def test_the_weights_of_a_mixture_are_the_shares_of_its_families():
    found = [
        type(Mixture(helix=3.0, smooth=0.0).drawn(np.random.default_rng(s))).__name__ for s in range(2000)
    ]
    shares = {name: found.count(name) / 2000 for name in set(found)}
    assert set(shares) == {"SetPoint", "Helix", "SphericalSpiral", "OutAndBack", "Lemniscate"}
    assert shares["Helix"] == pytest.approx(3 / 7, abs=0.045)  # four deviations of 2000 draws
    assert shares["SetPoint"] == pytest.approx(1 / 7, abs=0.032)


def test_a_mixture_of_one_family_and_no_offset_starts_at_the_origin_in_any_direction():
    rows = mixed(100, offset=0.0, setpoint=0.0, spiral=0.0, lines=0.0, helix=0.0, smooth=0.0)
    np.testing.assert_allclose(rows[:, 0, :3], 0.0, atol=1e-12)
    angles = np.arctan2(rows[:, 0, 4], rows[:, 0, 3])
    assert angles.min() < -2.5 and angles.max() > 2.5


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"helix": -1.0}, "the weight 'helix' of a mixture must be a number from 0 to 1e"),
        (dict.fromkeys([one.name for one in fields(Mixture)], 0.0), "needs a family with a weight > 0"),
        ({"offset": -1.0}, "the offset of a mixture must be a number from 0 to 1000 m, got -1"),
        ({"hleix": 1.0}, "did you mean 'helix'"),
    ],
)
def test_a_mixture_of_nothing_or_of_unknown_families_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        make_reference({"kind": "mixture", **given})


def test_a_mixture_in_a_vector_is_that_of_single_environments():
    kwargs = {"reference": {"kind": "mixture", "smooth": 0.5}}
    many = gym.make_vec("quad/RandomTracking-v0", num_envs=5, **kwargs)
    many.reset(seed=7)
    for i in range(5):
        one = gym.make("quad/RandomTracking-v0", **kwargs)
        one.reset(seed=7 + i)
        np.testing.assert_array_equal(one.unwrapped.reference, many.unwrapped.reference[i])


def test_tangent_heading_points_along_the_path():
    rows = rows_of(Heading(from_function(circle), tangent=True), [0.5, 2.0])
    np.testing.assert_allclose(rows[:, 6], rows[:, 4] / np.hypot(rows[:, 3], rows[:, 4]), atol=1e-9)


def test_function_with_velocity_and_heading_is_taken_as_it_is():
    rows = rows_of(from_function(lambda t: [t, 0, 0, 1, 0, 0, 0.5]), [0.0, 1.0])
    np.testing.assert_allclose(rows[:, 3:6], [[1, 0, 0], [1, 0, 0]])
    np.testing.assert_allclose(rows[:, 6], np.sin(0.5))


@pytest.mark.parametrize("bad", [lambda t: [1, 2], lambda t: [np.nan, 0, 0], lambda t: 3.0])
def test_function_with_a_bad_result_is_refused(bad):
    with pytest.raises(ValueError, match="reference function"):
        rows_of(from_function(bad), [0.0, 1.0])


def write(tmp_path, text):
    path = tmp_path / "a path with spaces.csv"
    path.write_text(text)
    return path


def test_csv_is_reproduced_at_its_lines_and_rests_after_its_end(tmp_path):
    t = np.linspace(0, 2, 21)
    lines = "\n".join(f"{a:.3f},{np.sin(a):.9f},{np.cos(a):.9f},0" for a in t)
    reference = from_csv(write(tmp_path, "t,x,y,z\n" + lines + "\n"))
    np.testing.assert_allclose(rows_of(reference, t)[:, 0], np.sin(t), atol=1e-8)
    between = rows_of(reference, t[:-1] + 0.05)
    np.testing.assert_allclose(between[:, 0], np.sin(t[:-1] + 0.05), atol=2e-3)
    after = rows_of(reference, [2.5, 9.0])
    np.testing.assert_allclose(after[:, 3:6], 0.0)
    np.testing.assert_allclose(after[:, 0], np.sin(2.0), atol=1e-8)
    assert pickle.loads(pickle.dumps(reference)).rows(t, None).shape == (21, 8)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,x,y\n0,0,0\n1,0,0\n", "missing \\['z'\\]"),
        ("t,x,y,w\n0,0,0,0\n1,0,0,0\n", "unknown: 'w'"),
        ("t,x,y,z\n0,0,0,0\n0.1,nan,0,0\n", "line 3: x must be a finite number, got 'nan'"),
        ("t,x,y,z\n0,0,0,0\n0.1,,0,0\n", "line 3: x must be a finite number, got ''"),
        ("t,x,y,z\n0,0,0,0\n0.1,0,0\n", "line 3: 3 cells"),
        ("t,x,y,z\n0,0,0,0\n0,0,0,0\n", "line 3: time must increase"),
        ("t,x,y,z\n0,0,0,0\n5,0,0,0\n", "line 3: a gap of 5 s"),
        ("t,x,y,z\n0,0,0,0\n", "at least two lines"),
        ("t,x,y,z,vx\n0,0,0,0,0\n1,0,0,0,0\n", "all of vx, vy, vz"),
        ("", "header"),
        ("t,x,y,z,x\n0,0,0,0,0\n1,0,0,0,0\n", "twice"),
    ],
)
def test_a_broken_csv_is_refused_with_its_line(tmp_path, text, message):
    with pytest.raises(ValueError, match=message):
        from_csv(write(tmp_path, text))


def test_unknown_reference_name_lists_the_known_ones():
    with pytest.raises(ValueError, match="did you mean 'helix'"):
        make_reference("hleix")


def test_leaders_of_teams_fly_at_the_speeds_of_the_text():
    speed = {
        name: np.linalg.norm(rows_of(make_reference(name), [0.0, 3.0])[:, 3:6], axis=1)
        for name in ("line", "fast-line", "slow-helix")
    }
    np.testing.assert_allclose(speed["line"], 0.539, atol=5e-4)
    np.testing.assert_allclose(speed["fast-line"], 1.58, atol=2e-3)
    np.testing.assert_allclose(speed["slow-helix"], 0.61, atol=3e-3)
