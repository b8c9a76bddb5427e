"""The adjoint of a team against central differences of a readable twin, which flies as the environment."""

import numpy as np
import pytest
from team_twin import TeamTwin, motions_of
from test_adjoint import STEP

from baselines.training.team_flights import DifferentiableTeams
from quad_envs.envs.team.options import FormationOptions, TargetTrackingOptions
from quad_envs.graphs import Switching

BAR_COST = 0.3
KEPT = 0.7  # m, so that the distance to keep counts in many steps
CLOSE = ((0.0, 0.0, 0.0), (0.45, 0.0, 0.1), (0.0, 0.5, 0.0), (0.5, 0.5, -0.2), (2.0, 2.0, 0.0))
LIMITS = {
    "tilt_limit": 0.5,
    "rate_limit": 8.0,
    "velocity_limit": 1.0,
    "position_limit": ((-1.0, -1.0, -1.0), (3.0, 3.0, 1.0)),
}
RANDOM_TEAMS = {
    "hexagon": FormationOptions(formation="hexagon", substeps=2, terminate="agent"),
    "lossy": FormationOptions(
        vehicles=5, graph="strong", start=CLOSE, delay=2, drop_out=0.4, message_lifetime=0.4, substeps=2,
        terminate="agent", Q=tuple(np.linspace(0.5, 2.0, 12)), **LIMITS,
    ),
    "switching": FormationOptions(
        vehicles=4, graph=Switching(("chain", "star"), dwell_steps=4), start=CLOSE[:4], drop_out=0.2,
        substeps=3,
    ),
    "gusts": FormationOptions(
        vehicles=3, formation="triangle", start=CLOSE[:3], disturbance="varied-gusts", substeps=2,
    ),
    "target": TargetTrackingOptions(start=(*CLOSE, (3.0, 0.0, 0.0)), delay=1, substeps=2, drop_out=0.2),
}  # fmt: skip


def flown(options, seed=0, n_steps=40, scale=0.5):
    """Flights with random actions: their steps, what was seen before each, and the twin."""
    flights = DifferentiableTeams(options, 2 * options.vehicles, seed, separation=KEPT)
    rng = np.random.default_rng(seed)
    flights.begin_window(n_steps)
    steps, seen, bias = [], [], rng.uniform(-0.1, 0.1, (flights.n, 4))
    for _ in range(n_steps):
        seen.append(flights._out.copy())
        actions = np.clip(bias + scale * rng.normal(size=(flights.n, 4)), -1.0, 1.0)
        steps.append(flights.advance(actions.astype(np.float32)))
    return flights, steps, TeamTwin(flights, steps, seen, KEPT)


@pytest.fixture(scope="module", params=RANDOM_TEAMS)
def flight(request):
    return flown(RANDOM_TEAMS[request.param])


def test_the_twin_flies_as_the_environment_does(flight):
    _, steps, twin = flight
    motions = [motions_of(step.record.plants) for step in steps]
    for t, step in enumerate(steps):
        record, judged = step.record, step.record.flew & ~step.crashed
        after, rewards, _ = twin.advance(t, record.plants, record.commands, record.previous)
        assert np.allclose(rewards[judged], step.rewards[judged], rtol=1e-9, atol=1e-12)
        found = twin.observe(t, record.plants, record.previous, motions)
        assert np.allclose(found[record.flew], twin.seen[t][record.flew], atol=2e-6)
        if t + 1 < len(steps):
            on = ~step.done & steps[t + 1].record.flew
            assert np.allclose(after[on], steps[t + 1].record.plants[on], atol=1e-9)


def test_random_teams_have_crashes_losses_and_vehicles_too_close():
    steps = [step for options in RANDOM_TEAMS.values() for step in flown(options)[1]]
    assert any((step.crashed & step.record.flew).any() for step in steps)
    assert any((~step.record.flew).any() for step in steps)  # some fly on without those that crashed
    assert {-1, 1, 2, 3} <= set(np.concatenate([step.record.ages.ravel() for step in steps]).tolist())
    assert any(step.done.any() for step in steps)


def test_the_adjoint_of_a_step_and_its_rewards_is_their_derivative(flight):
    flights, steps, twin = flight
    rng = np.random.default_rng(1)
    for t in range(0, len(steps), 4):
        record = steps[t].record
        bars, bar_rewards = rng.normal(size=(flights.n, 16)), rng.normal(size=flights.n)
        bars[~record.flew] = 0.0
        judged = record.flew & ~record.crashed

        def value(x, u, p, t=t, bars=bars, bar_rewards=bar_rewards, judged=judged):
            after, rewards, costs = twin.advance(t, x, u, p)
            return (after * bars).sum() + (bar_rewards * rewards + BAR_COST * costs)[judged].sum()

        found = flights.advance_vjp(
            steps[t]._replace(done=np.zeros(flights.n, np.bool_), slopes=np.ones((flights.n, 4))),
            bars, np.zeros((flights.n, 4)), bar_rewards, BAR_COST,
        )  # fmt: skip
        given = record.plants, record.commands, record.previous
        for place, bar in ((0, found[1]), (1, found[0]), (2, found[2])):
            for _ in range(6):
                along = rng.normal(size=given[place].shape) * record.flew[:, None]
                if place == 1:  # a command at the edge of the box has a slope on one side only
                    inside = (given[1] > 0.01) & (given[1] < twin.task.force_max - 0.01)
                    along *= inside
                ahead, behind = list(given), list(given)
                ahead[place], behind[place] = given[place] + STEP * along, given[place] - STEP * along
                slope = (value(*ahead) - value(*behind)) / (2.0 * STEP)
                assert slope == pytest.approx((bar * along).sum(), abs=1e-6 * max(1.0, abs(slope)))


def replay(twin, steps, plants, commands, bars, bar_rewards):
    """A scalar of all observations and rewards of a window from its first plants and all commands."""
    previous, motions, total = steps[0].record.previous, [], 0.0
    for t, step in enumerate(steps):
        record = step.record
        if t > 0:
            # Teams that began anew, and who lies where it crashed, are where they were.
            given = steps[t - 1].done | ~record.flew
            plants = np.where(given[:, None], record.plants, plants)
            previous = np.where(given[:, None], record.previous, commands[t - 1])
        motions.append(motions_of(plants))
        total += (bars[t] * twin.observe(t, plants, previous, motions)).sum()
        plants, rewards, _ = twin.advance(t, plants, commands[t], previous)
        total += (bar_rewards[t] * rewards)[record.flew & ~step.crashed].sum()
    return total


def test_the_adjoint_of_a_window_with_its_messages_is_its_derivative(flight):
    flights, all_steps, twin = flight
    steps, rng, n = all_steps[:16], np.random.default_rng(2), flights.n
    size = flights.task.layout.size
    bars = rng.normal(size=(16, n, size))
    seen = flights._columns[flights._columns < size]  # of what filters believe another test speaks
    kept = np.zeros(size)
    kept[seen] = 1.0  # what networks do not see leads nowhere
    bar_rewards = rng.normal(size=(16, n))
    for t, step in enumerate(steps):
        bars[t] *= kept * step.record.flew[:, None]
    flights.begin_window(16)
    plants, previous, slopes = np.zeros((n, 16)), np.zeros((n, 4)), []
    for t in range(15, -1, -1):
        step = steps[t]._replace(slopes=np.ones((n, 4)))
        commands, plants, previous = flights.advance_vjp(step, plants, previous, bar_rewards[t])
        slopes.insert(0, commands)
        scaled = np.zeros((n, len(flights._columns)))
        scaled[:, : len(seen)] = bars[t][:, seen] * flights._scale[: len(seen)]
        own, last = flights.observe_vjp(step, scaled)
        plants, previous = plants + own, previous + last
    slopes, first = np.array(slopes), steps[0].record.plants
    commands = np.array([step.record.commands for step in steps])
    flew = np.array([step.record.flew for step in steps])[..., None]
    inside = (commands > 0.01) & (commands < twin.task.force_max - 0.01) & flew
    for _ in range(4):
        u, x = rng.normal(size=commands.shape) * inside, 0.1 * rng.normal(size=first.shape)
        ahead = replay(twin, steps, first + STEP * x, commands + STEP * u, bars, bar_rewards)
        behind = replay(twin, steps, first - STEP * x, commands - STEP * u, bars, bar_rewards)
        slope = (ahead - behind) / (2.0 * STEP)
        # of many hundred terms of order one, whose differences are each exact to 1e-9
        assert (slopes * u).sum() + (plants * x).sum() == pytest.approx(slope, rel=1e-6, abs=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"comm": "plan"}, "does not pass through plans that vehicles send: choose comm='state'"),
        ({"reward": "quadratic"}, "reward='bounded'"),
    ],
)
def test_a_team_that_cannot_be_differentiated_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        DifferentiableTeams(FormationOptions(**options), 6, 0)


def test_a_graph_that_is_drawn_at_random_is_refused():
    rng = np.random.default_rng(0)

    def drawn(k):
        return np.eye(6) + (rng.random((6, 6)) < 0.5)

    options = FormationOptions(formation="hexagon", graph=drawn)
    with pytest.raises(ValueError, match=r"is drawn at random.*Give edges, a matrix or a schedule"):
        DifferentiableTeams(options, 6, 0)


def test_a_separation_below_that_of_the_task_is_refused():
    with pytest.raises(ValueError, match=r"at least the task's own, 0.4 m, got 0.3 m"):
        DifferentiableTeams(FormationOptions(), 6, 0, separation=0.3)
