"""The analytic policy gradient under conditions, against differences of what the flights earn."""

from dataclasses import replace

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from baselines.training.algorithm_options import PolicyGradientOptions  # noqa: E402
from baselines.training.features import training_features  # noqa: E402
from baselines.training.flights import DifferentiableFlights  # noqa: E402
from baselines.training.held_out import training_options  # noqa: E402
from baselines.training.policy_gradient import Actor, _window_gradient, train  # noqa: E402
from quad_envs.wrappers.encoding import hover_actions  # noqa: E402

RANDOM = "quad/RandomTracking-v0"
OPTIONS, EPSILON = PolicyGradientOptions(net_arch=(16,)), 1e-3
FLIGHTS, WINDOW = 16, 12
FORCE = {"disturbance": (0.4, -0.3, 0.2)}  # N, 0.07 of the weight
VARIED = {
    "kappa": 0.6,
    "randomize": {"mass": 0.2, "inertia": 0.2, "arm": 0.2, "rotor_rate": 0.2, "kappa": 0.45},
}

TURNED = {"reference": {"kind": "heading", "yaw": 1.0, "rate": 0.8, "reference": "random"}}


def begin(conditions, seed=3):
    """Flights of which none ends within the window; where the heading turns, seen in its axes."""
    options = training_options(RANDOM, conditions)
    features = training_features(options, None, disturbance_estimate=True, heading_axes=True)
    flights = DifferentiableFlights(options, FLIGHTS, seed, features if "reference" in conditions else None)
    flights._cut[:] = 10_000
    return flights


def objective(actor, conditions):
    """The loss of a window, in float64 but for the network."""
    flights, total = begin(conditions), 0.0
    for t in range(WINDOW):
        outputs = actor(torch.from_numpy(flights.observe())).detach().numpy()
        record = flights.advance(hover_actions(outputs, flights.task))
        assert not record.done.any()
        total -= OPTIONS.gamma**t * np.log(record.rewards + EPSILON).sum()
    return total / (FLIGHTS * WINDOW)


def errors_along_directions(conditions):
    """Relative errors of the gradient along the gradient itself and along two random directions."""
    torch.manual_seed(0)
    actor = Actor(len(begin(conditions).features.names), OPTIONS.net_arch, 4)
    _window_gradient(actor, begin(conditions), OPTIONS, WINDOW, EPSILON)
    gradient = [parameter.grad.clone() for parameter in actor.parameters]
    size = float(torch.sqrt(sum((part**2).sum() for part in gradient)))
    directions = [[part / size for part in gradient]]
    directions += [[torch.randn_like(part) / part.numel() ** 0.5 for part in gradient] for _ in range(2)]
    errors = []
    for direction in directions:
        values = []
        for step in (1e-2, -2e-2):  # forth, and back past the middle
            with torch.no_grad():
                for parameter, part in zip(actor.parameters, direction, strict=True):
                    parameter.add_(step * part)
            values.append(objective(actor, conditions))
        with torch.no_grad():
            for parameter, part in zip(actor.parameters, direction, strict=True):
                parameter.add_(1e-2 * part)
        slope = sum(float((g * d).sum()) for g, d in zip(gradient, direction, strict=True))
        errors.append((slope - (values[0] - values[1]) / 2e-2) / size)
    return np.abs(errors)


@pytest.mark.parametrize(
    "conditions", [{}, {"sensor_noise": 0.01}, VARIED, TURNED], ids=["", "noise", "vehicles", "heading"]
)
def test_the_gradient_of_a_window_is_the_derivative_of_its_objective(conditions):
    # what is left is the second order of a step of 1e-2, and float32 in the network
    assert errors_along_directions(conditions).max() < 5e-3


@pytest.mark.parametrize(
    "conditions", [FORCE, {"disturbance": "gusts"}, {**FORCE, "reveal_disturbance": True}]
)
def test_what_the_gradient_neglects_of_a_disturbance_is_its_share_of_the_weight(conditions):
    found = errors_along_directions(conditions)
    assert found.max() < 0.07


def test_disturbances_and_noise_are_flown_in_training():
    calm, blown, noisy = (begin(one) for one in ({}, FORCE, {"sensor_noise": 0.01}))
    still = np.zeros((FLIGHTS, 4), dtype=np.float32)
    after = [flights.advance(still).record.after for flights in (calm, blown)]
    push = 0.05 * 0.4 / calm.task.params.mass  # of one control period, where the vehicle is level
    assert np.median(after[1][:, 3] - after[0][:, 3]) == pytest.approx(push, rel=0.1)
    assert np.abs(noisy.observe() - calm.observe()).max() > 1e-3


def test_training_integrates_with_the_substeps_of_its_hyperparameters(monkeypatch):
    seen = []

    class Watched(DifferentiableFlights):
        def __init__(self, options, *more):
            seen.append(options.substeps)
            super().__init__(options, *more)

    monkeypatch.setattr("baselines.training.policy_gradient.DifferentiableFlights", Watched)
    next(train(training_options(RANDOM, {}), replace(OPTIONS, n_envs=2, substeps=3), 0, lambda: 0.0))
    assert seen == [3]


def test_only_the_bounded_reward_has_this_gradient():
    with pytest.raises(ValueError, match="needs reward='bounded', got 'quadratic'"):
        DifferentiableFlights(training_options(RANDOM, {"reward": "quadratic"}), 2, 0)
