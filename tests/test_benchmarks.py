"""What benchmarks time still runs."""

import pytest

from benchmarks import agents, step


@pytest.mark.parametrize(
    "candidate",
    [
        pytest.param(lambda: agents._parallel(6), id="PettingZoo"),
        pytest.param(lambda: agents._bare(6), id="bare team"),
        pytest.param(lambda: agents._batched(6, 2), id="batch of teams"),
    ],
)
def test_a_candidate_of_teams_steps(candidate):
    call, steps = candidate()
    call()
    assert steps >= 12


@pytest.mark.parametrize("candidate", [step._single, step._bare], ids=["single", "bare"])
def test_a_candidate_of_one_vehicle_steps(candidate):
    candidate(1)()
