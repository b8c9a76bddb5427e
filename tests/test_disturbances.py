"""Disturbance tables at the integrator's stage times."""

import numpy as np
import pytest

from quad_envs.disturbances import Gusts, Impulse, Steady, TorquePulse, make_disturbance

DT, NODES = 0.05, 11
TIMES = DT * (np.arange(240)[:, None] + np.linspace(0, 1, NODES))


def values_of(disturbance, seed=0):
    return disturbance.values(TIMES, np.random.default_rng(seed))


def test_torque_pulse_acts_from_5_to_10_seconds_only():
    torque = values_of(TorquePulse())[..., :3]
    acting = np.abs(torque).sum(axis=2) > 0
    assert not acting[:100].any() and acting[100:200].all() and not acting[200:].any()


def test_torque_pulse_decays_from_061_to_037_in_absolute_time_and_from_1_in_relative():
    size = np.linalg.norm(values_of(TorquePulse())[100:200, :, :3], axis=2)
    assert size[0, 0] == pytest.approx(np.exp(-0.5)) and size[-1, -1] == pytest.approx(np.exp(-1.0))
    relative = np.linalg.norm(values_of(TorquePulse(clock="relative"))[100, 0, :3])
    assert relative == pytest.approx(1.0)


def test_gusts_are_continuous_over_control_steps_and_have_their_deviations():
    gusts = Gusts(force=0.5, torque=0.02, correlation_time=0.1)
    values = values_of(gusts)
    assert np.array_equal(values[:-1, -1], values[1:, 0])
    samples = np.concatenate([values_of(gusts, seed)[::20, 0] for seed in range(300)])
    # 300 x 12 nearly independent samples: the deviation is known to 1.2 %; five of those
    np.testing.assert_allclose(samples.std(axis=0), np.repeat([0.02, 0.5], 3), rtol=0.06)
    lag = np.mean([np.mean(v[:-1, 0, 3] * v[1:, 0, 3]) for v in (values_of(gusts, s) for s in range(300))])
    assert lag / 0.25 == pytest.approx(np.exp(-DT / 0.1), abs=0.05)


def test_impulse_gives_its_momentum_within_one_control_period():
    values = values_of(Impulse(time=1.23, momentum=(0.8, 0.0, -0.2)))
    hit = np.abs(values).sum(axis=(1, 2)) > 0
    assert np.flatnonzero(hit).tolist() == [24]
    np.testing.assert_allclose(values[24, 0, 3:] * DT, [0.8, 0.0, -0.2])


def test_steady_is_constant():
    values = values_of(Steady(force=(0.1, 0.2, 0.3), torque=(0.0, 0.01, 0.0)))
    assert np.array_equal(values, np.broadcast_to([0.0, 0.01, 0.0, 0.1, 0.2, 0.3], values.shape))


@pytest.mark.parametrize("name", [None, "none", "torque-pulse", "steady", "gusts", "impulse"])
def test_every_name_makes_a_disturbance(name):
    assert (make_disturbance(name) is None) == (name in (None, "none"))


@pytest.mark.parametrize(
    "make",
    [
        lambda: make_disturbance("gust"),
        lambda: TorquePulse(clock="x"),
        lambda: TorquePulse(start=3, stop=2),
        lambda: Gusts(force=-1.0),
        lambda: Gusts(correlation_time=0.0),
    ],
)
def test_a_bad_disturbance_is_refused(make):
    with pytest.raises(ValueError, match=r"disturbance|clock|start|deviations|correlation"):
        make()
