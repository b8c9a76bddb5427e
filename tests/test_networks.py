"""Networks in flight: what they compute, and that a row has the same bits whatever rows are beside it."""

import json
from dataclasses import replace
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from processes import printed_compiled_and_plain

from baselines import evaluate, export_policy, make_policy, run_benchmark, shipped_policies
from baselines.policies.checkpoints import load_checkpoint
from baselines.policies.environments import task_of
from baselines.policies.network import Network, NetworkPolicy
from baselines.policies.network_kernels import BLOCK
from baselines.policies.trained import SHIPPED
from quad_envs.compilation import tiles
from quad_envs.compilation.decorators import kernel
from quad_envs.observations.features import default_features
from quad_envs.wrappers.encoding import hover_actions

HELIX = "quad/HelixTracking-v0"
COUNTS = (1, 2, 7, 64, 1000)
LARGEST = np.finfo(np.float32).max
HIDDEN = [(), (1,), (5,), (16,), (64, 64), (30, 20), (128, 128), (70, 3, 33), (400, 300)]


def random_network(rng, hidden, **changes):
    """Weights as networks begin with, and biases that are not zero."""
    features = default_features(task_of(HELIX).layout)
    pairs = list(pairwise((len(features.names), *hidden, 4)))
    weights = tuple((rng.normal(size=pair) / np.sqrt(pair[0])).astype(np.float32) for pair in pairs)
    biases = tuple(rng.normal(size=m).astype(np.float32) for _, m in pairs)
    return Network(features, weights, biases, **changes)


def drawn_network(rng, hidden):
    network = random_network(
        rng,
        hidden,
        squash=str(rng.choice(["tanh", "clip"])),
        commands=str(rng.choice(["hover", "action"])),
        activation=str(rng.choice(["tanh", "relu"])),
        command_range=float(rng.choice([1.0, 0.4])),
    )
    clip = [None, 1.5][int(rng.integers(2))]
    return replace(network, features=replace(network.features, clip=clip))


def twin(network, task, observations):
    """Actions in numpy, in doubles."""
    seen = network.features
    x = (observations[:, seen.columns(task.layout)].astype(np.float64) - seen.mean) / seen.scale
    if seen.clip is not None:
        x = np.clip(x, -seen.clip, seen.clip)
    last = len(network.weights) - 1
    for k, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        x = x @ W + b
        if k < last:
            x = np.tanh(x) if network.activation == "tanh" else np.maximum(x, 0.0)
    x = np.clip(np.tanh(x) if network.squash == "tanh" else x, -1.0, 1.0)
    return hover_actions(x, task, network.command_range) if network.commands == "hover" else x


def assert_rows_alone_are_rows_together(policy, observations):
    """Of every number of rows, from several places, to the last bit."""
    together = policy.predict(observations)[0]
    for count in COUNTS:
        for begin in {0, len(observations) // 3, len(observations) - count}:
            few = policy.predict(observations[begin : begin + count])[0]
            assert few.tobytes() == together[begin : begin + count].tobytes(), (count, begin)
    for row in (0, 5, len(observations) - 1):
        assert policy.predict(observations[row])[0].tobytes() == together[row].tobytes()


@pytest.mark.parametrize("hidden", HIDDEN)
def test_a_network_computes_its_layers_and_a_row_has_the_same_bits_beside_others(hidden):
    rng, task = np.random.default_rng(len(hidden) + sum(hidden)), task_of(HELIX)
    for _ in range(6):
        network = drawn_network(rng, hidden)
        policy = NetworkPolicy(network, task, "drawn")
        seen = rng.normal(size=(1000, task.layout.size)).astype(np.float32)
        # A layer rounds numbers of order one to 6e-8, up to 400 of them, and tanh errs by 4e-7.
        assert np.abs(policy.predict(seen)[0] - twin(network, task, seen)).max() < 1e-5
        assert_rows_alone_are_rows_together(policy, seen)


@pytest.mark.parametrize("name", sorted(shipped_policies()))
def test_a_shipped_network_gives_a_row_the_same_bits_beside_any_number_of_others(name):
    said = json.loads((SHIPPED / name / "policy.json").read_text())
    task = task_of(said["env_id"])
    policy = make_policy(name, said["env_id"])
    rng = np.random.default_rng(0)
    assert_rows_alone_are_rows_together(policy, rng.normal(size=(1000, task.layout.size)).astype(np.float32))


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_an_exported_network_gives_a_row_the_same_bits_beside_any_number_of_others(tmp_path, activation):
    torch = pytest.importorskip("torch")
    size = task_of(HELIX).layout.size
    layer = torch.nn.Tanh if activation == "tanh" else torch.nn.ReLU
    torch.manual_seed(0)
    module = torch.nn.Sequential(
        torch.nn.Linear(size, 33), layer(), torch.nn.Linear(33, 20), layer(), torch.nn.Linear(20, 4)
    )
    folder = export_policy(module, tmp_path / "net", env=HELIX, mean=0.1, scale=np.full(size, 1.3))
    seen = np.random.default_rng(1).normal(size=(1000, size)).astype(np.float32)
    policy = make_policy(folder, HELIX)
    assert_rows_alone_are_rows_together(policy, seen)
    expected = module(torch.from_numpy(((seen - 0.1) / 1.3).astype(np.float32))).detach().numpy()
    assert np.abs(policy.predict(seen)[0] - np.clip(expected, -1.0, 1.0)).max() < 1e-5


@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_at_the_ends_of_float32_a_row_has_its_bits_or_its_refusal_alone_and_beside_others(activation):
    rng, task = np.random.default_rng(3), task_of(HELIX)
    policy = NetworkPolicy(random_network(rng, (64, 64), activation=activation), task, "wild")
    sizes = [0.0, 1e-45, 1e-38, 1.0, 1e6, 1e18, 1e38, LARGEST]
    seen = rng.choice(sizes, size=(300, task.layout.size)) * rng.choice([-1.0, 1.0], size=(300, 1))
    seen = np.concatenate([seen, [np.full(task.layout.size, size) for size in sizes]]).astype(np.float32)
    answers = []
    for row in seen:
        try:
            answers.append(policy.predict(row)[0])
        except ValueError as error:
            assert "no action follows from observation 0" in str(error)
            answers.append(None)
    whole = np.flatnonzero([answer is not None for answer in answers])
    assert len(whole) > 5 and np.abs(np.array([answers[i] for i in whole])).max() <= 1.0
    together = policy.predict(seen[whole])[0]
    assert together.tobytes() == np.array([answers[i] for i in whole]).tobytes()
    for i in (i for i, answer in enumerate(answers) if answer is None):
        among = np.tile(seen[whole[0]], (BLOCK + 9, 1))
        among[BLOCK + 3] = seen[i]
        with pytest.raises(ValueError, match=f"no action follows from observation {BLOCK + 3}"):
            policy.predict(among)


@pytest.mark.parametrize("rows", [1, 5, 70])
def test_what_is_not_finite_is_named_before_what_is_too_large(rows):
    rng, task = np.random.default_rng(0), task_of(HELIX)
    policy = NetworkPolicy(random_network(rng, (16,), activation="relu"), task, "x")
    seen = rng.normal(size=(rows, task.layout.size)).astype(np.float32)
    seen[0] = LARGEST
    seen[-1, 4] = np.nan
    with pytest.raises(ValueError, match=f"observation {rows - 1} is not finite"):
        policy.predict(seen)


def test_no_rows_get_no_actions():
    task = task_of(HELIX)
    for policy in (make_policy("apg-helix", HELIX), make_policy("apg-generalist", HELIX)):
        assert policy.predict(np.zeros((0, task.layout.size), np.float32))[0].shape == (0, 4)


@kernel
def _in_tiles(x, width, n, weights, out):
    """Four strips of four rows: in tiles of four rows, and twice in tiles of one."""
    for strip in range(4):
        at = strip * (n + 1) * tiles.STRIP
        tiles.multiply_rows(x, 0, width, n, weights, at, out[0], strip * tiles.STRIP)
        for r in range(4):
            tiles.multiply_row(x, r * width, width, n, weights, at, out[1], r * width + strip * tiles.STRIP)
    for r in range(4):
        tiles.multiply_row_wide(x, r * width, width, n, weights, 0, out[2], r * width)


@pytest.mark.parametrize("n", [0, 1, 7, 98])
def test_every_tile_sums_in_the_order_of_the_inputs_and_rounds_once_a_term(n):
    rng, width, m = np.random.default_rng(n), 112, 60
    W, b = rng.normal(size=(n, m)).astype(np.float32), rng.normal(size=m).astype(np.float32)
    x = rng.normal(size=(4, width)).astype(np.float32)
    out = np.full((3, 4 * width), np.nan, dtype=np.float32)
    _in_tiles(x.ravel(), width, n, tiles.packed(W, b), out)
    total = np.tile(b, (4, 1))
    for i in range(n):  # the product of two floats is exact in doubles
        total = (x[:, i : i + 1].astype(np.float64) * W[i] + total).astype(np.float32)
    for found in out.reshape(3, 4, width):
        assert found[:, :m].tobytes() == total.tobytes()
        assert np.array_equal(found[:, m:64], np.zeros((4, 4)))  # of the padding
        assert np.isnan(found[:, 64:]).all()
    readable = np.zeros(4 * width, np.float32)
    tiles._plain(4, 4)(x.ravel(), 0, width, n, tiles.packed(W, b), 0, readable, 0)
    assert readable.reshape(4, width)[:, :64].tobytes() == out[0].reshape(4, width)[:, :64].tobytes()


def test_a_network_runs_as_plain_python_for_debugging():
    code = (
        "import numpy as np\n"
        "from baselines import make_policy\n"
        "policy = make_policy('apg-helix', 'quad/HelixTracking-v0')\n"
        "seen = np.random.default_rng(0).normal(size=(5, policy.task.layout.size)).astype('f4')\n"
        "print(policy.predict(seen)[0].tobytes().hex())"
    )
    compiled, plain = printed_compiled_and_plain(code)
    assert compiled == plain


def without_times(records):
    kept = [name for name in records[0]._fields if not name.startswith("decision")]
    return [repr([getattr(record, name) for name in kept]) for record in records]


def test_flights_of_a_network_have_the_same_digits_among_more_and_among_fewer():
    env = gym.make(HELIX, time_limit=2.0)
    for name in ("apg-helix", "apg-generalist"):
        policy = make_policy(name, env)
        many = without_times(evaluate(policy, env, 70).records)
        assert without_times(evaluate(policy, env, 7).records) == many[:7]
        assert without_times(evaluate(policy, env, 1, seed=3).records) == many[3:4]


def test_flights_of_networks_have_the_same_digits_in_two_processes():
    suite = {
        "envs": [{"id": HELIX, "kwargs": {"time_limit": 1.0}}],
        "policies": ["apg-helix", "ppo-helix"],
        "episodes": 5,
    }
    one, two = (run_benchmark(suite, jobs=jobs).evaluations for jobs in (1, 2))
    for a, b in zip(one, two, strict=True):
        assert without_times(a.records) == without_times(b.records)


def test_a_shipped_network_computes_its_layers():
    rng = np.random.default_rng(2)
    for name in ("apg-helix", "ppo-helix", "dagger-helix"):
        network, task = load_checkpoint(SHIPPED / name)[0], task_of(HELIX)
        seen = rng.normal(size=(100, task.layout.size)).astype(np.float32)
        found = NetworkPolicy(network, task, name).predict(seen)[0]
        assert np.abs(found - twin(network, task, seen)).max() < 1e-5
