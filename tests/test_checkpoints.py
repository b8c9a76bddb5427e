"""Checkpoints of networks: what is written, what is refused, and how a policy comes out of one."""

import json
import os
import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from baselines import CheckpointError, check_policy, evaluate, load_policy, make_policy, shipped_policies
from baselines.policies.checkpoints import load_checkpoint, save_checkpoint
from baselines.policies.environments import make_env, task_of
from baselines.policies.network import Network, NetworkPolicy
from baselines.policies.trained import SHIPPED
from quad_envs.observations.features import Features, default_features
from quad_envs.wrappers.encoding import hover_actions, hover_outputs, hover_slopes

HELIX, FORMATION = "quad/HelixTracking-v0", "quad/Formation-v0"
ABOUT = {"env_id": HELIX, "mission": "tracking", "algorithm": "apg", "kind": "model-based", "score": 0.5}


def network_for(env_id=HELIX, seed=0, outputs=4, **changes):
    features, rng = default_features(task_of(env_id).layout), np.random.default_rng(seed)
    sizes = (len(features.names), 16, 8, outputs)
    pairs = list(pairwise(sizes))
    weights = [(rng.normal(size=pair) / np.sqrt(pair[0])).astype(np.float32) for pair in pairs]
    biases = [0.1 * rng.normal(size=m).astype(np.float32) for _, m in pairs]
    return Network(features, tuple(weights), tuple(biases), **changes)


@pytest.fixture
def saved(tmp_path):
    save_checkpoint(tmp_path / "run", network_for(), ABOUT)
    return tmp_path / "run"


def observations(rows=3):
    env = make_env(HELIX)
    return np.stack([env.reset(seed=seed)[0] for seed in range(rows)])


def test_a_network_comes_back_as_it_was(saved):
    network, said = load_checkpoint(saved)
    for found, written in zip(
        (*network.weights, *network.biases), (*network_for().weights, *network_for().biases), strict=True
    ):
        assert np.array_equal(found, written) and found.dtype == np.float32
    assert network.features == network_for().features and said["env_id"] == HELIX
    assert said["versions"]["python"] and said["layers"][-1] == [8, 4]


def test_a_folder_is_a_policy_like_any_other(saved):
    policy = make_policy(str(saved), HELIX)
    check_policy(policy, HELIX)
    assert policy.name == "run" and policy.kind == "model-based"
    assert evaluate(make_policy(saved, HELIX), HELIX, 1).policy == "run"
    assert pickle.loads(pickle.dumps(policy)).predict(observations())[0].shape == (3, 4)


def test_what_a_network_computes_is_its_layers_on_scaled_features():
    network, task, seen = network_for(), task_of(HELIX), observations()
    features, x = network.features, seen[:, network_for().features.columns(task.layout)].astype(np.float64)
    x = (x - features.mean) / features.scale
    for W, b in zip(network.weights, network.biases, strict=True):
        x = np.tanh(x @ W + b)
    expected = hover_actions(x.astype(np.float32), task)
    # Products of float32 are rounded: 1e-6 of numbers of order one, a few times over.
    assert np.allclose(NetworkPolicy(network, task, "x").predict(seen)[0], expected, atol=2e-5)


def relu_network(clip=2.0):
    """With relu layers, on features that are cut where `clip` says."""
    plain = network_for(commands="action")
    seen = replace(plain.features, clip=clip)
    return replace(plain, features=seen, activation="relu", squash="clip")


@pytest.mark.parametrize("clip", [None, 2.0])
def test_relu_layers_and_cut_features_come_back_and_are_what_they_say(tmp_path, clip):
    network, task = relu_network(clip), task_of(HELIX)
    save_checkpoint(tmp_path / "net", network, {"env_id": HELIX})
    policy, seen = load_policy(tmp_path / "net", HELIX), 3.0 * observations(50)
    assert policy.network.activation == "relu" and policy.network.features == network.features
    x = (seen[:, network.features.columns(task.layout)] - network.features.mean) / network.features.scale
    x = x if clip is None else np.clip(x, -clip, clip)
    for k, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        x = x @ W + b
        x = np.maximum(x, 0.0) if k + 1 < len(network.weights) else np.clip(x, -1.0, 1.0)
    # Products of float32 are rounded: 1e-6 of numbers of order one, a few times over.
    assert np.abs(policy.predict(seen)[0] - x).max() < 2e-5


def test_what_an_older_version_cannot_read_has_another_format(tmp_path):
    for name, network, expected in (("old", network_for(), 1), ("new", relu_network(None), 2)):
        save_checkpoint(tmp_path / name, network, {"env_id": HELIX})
        assert json.loads((tmp_path / name / "policy.json").read_text())["format"] == expected


def test_names_of_places_are_for_observations_of_one_size():
    size = task_of(HELIX).layout.size
    places = Features(tuple(f"observation[{k}]" for k in range(size)), (0.0,) * size, (1.0,) * size)
    assert places.columns(task_of(HELIX).layout).tolist() == list(range(size))
    with pytest.raises(ValueError, match=f"observations of {size} numbers, here they have {size + 3}"):
        places.columns(task_of("quad/CorridorTracking-v0").layout)


@pytest.mark.parametrize("rows", [1, 50])
@pytest.mark.parametrize(("at", "part"), [(2, "entry 2 of 'V_B'"), (18 + 8 * 4, "entry 32 of 'preview'")])
def test_a_network_refuses_what_an_mpc_refuses_in_its_words(rows, at, part):
    """Also in stages of the preview that it does not look at: what made them made the others, too."""
    task = task_of(HELIX)
    policies = NetworkPolicy(network_for(), task, "x"), make_policy("lqr", task)
    good = np.tile(observations(1), (rows, 1))
    bad = good.copy()
    bad[-1, at] = np.nan
    mistakes = [
        ((bad,), rf"observation {rows - 1} is not finite: {part} \(index {at}\) is nan; check the sensors"),
        ((good[:, :-1],), r"observation must have shape \(n, 226\) or \(226,\), got"),
        ((good.astype(object),), "observation must be an array of real numbers, got dtype object"),
        ((good.astype(complex),), "observation must be an array of real numbers, got dtype complex128"),
        ((good, None, np.ones(rows + 1, bool)), rf"episode_start must have shape \({rows},\)"),
        ((good, policies[1].predict(np.tile(good, (2, 1)))[1]), f"state has {2 * rows} rows"),
    ]
    for policy in policies:
        for arguments, message in mistakes:
            with pytest.raises(ValueError, match=message):
                policy.predict(*arguments)


def test_outputs_and_actions_turn_into_each_other():
    outputs, task = np.linspace(-1.0, 1.0, 12, dtype=np.float32).reshape(3, 4), task_of(HELIX)
    # A third and three times a third in float32.
    assert np.allclose(hover_outputs(hover_actions(outputs, task), task), outputs, atol=1e-6)
    assert hover_outputs(np.ones((1, 4), np.float32), task).max() == 1.0


def test_the_slopes_of_the_hover_map_are_its_differences():
    task, step = task_of(make_env(HELIX, kappa=0.4)), 1e-6  # at kappa 0.4 the box cuts from output 0.6 on
    outputs = np.array([[-0.9, -0.1, 0.1, 0.5], [0.55, 0.65, 0.9, 1.0]])
    ahead, behind = hover_actions(outputs + step, task), hover_actions(outputs - step, task)
    # Piecewise linear: off by rounding alone.
    assert np.allclose(hover_slopes(outputs, task), (ahead - behind) / (2.0 * step), atol=1e-8)


def test_a_network_flies_where_the_layout_has_what_it_sees(saved):
    env = make_env("quad/RandomTracking-v0", preview=30)
    assert make_policy(saved, env).predict(env.reset(seed=0)[0])[0].shape == (4,)


def test_loading_and_flying_need_no_torch(saved):
    code = (
        "import sys; sys.modules['torch'] = sys.modules['stable_baselines3'] = None\n"
        "from baselines.__main__ import main\n"
        f"sys.exit(main(['evaluate', '{HELIX}', {str(saved)!r}, '--episodes', '1']))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert found.returncode == 0 and found.stdout.startswith("run on quad/HelixTracking-v0"), found.stderr


def describe(folder, **changes):
    path = folder / "policy.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def truncate(folder):
    path = folder / "network.safetensors"
    path.write_bytes(path.read_bytes()[:-100])


class Trap:
    """Pickled, it would make a file when it is opened."""

    def __reduce__(self):
        return os.mkdir, ("opened",)


def pickle_in_disguise(folder):
    (folder / "network.safetensors").write_bytes(pickle.dumps({"weights": Trap()}))


def not_finite(folder):
    from safetensors.numpy import load_file, save_file

    from baselines.policies.checkpoints import _digest

    tensors = load_file(folder / "network.safetensors")
    tensors["1.weight"][0, 0] = np.nan
    save_file(tensors, folder / "network.safetensors")
    describe(folder, digest=_digest((folder / "network.safetensors").read_bytes()))


def wrong_shapes(folder):
    from safetensors.numpy import load_file, save_file

    from baselines.policies.checkpoints import _digest

    tensors = load_file(folder / "network.safetensors")
    tensors["1.weight"] = tensors["1.weight"][:5].copy()
    save_file(tensors, folder / "network.safetensors")
    describe(folder, digest=_digest((folder / "network.safetensors").read_bytes()))


def scaled(name, value):
    """Another mean or scale of one feature."""

    def spoil(folder):
        features = json.loads((folder / "policy.json").read_text())["features"]
        features[name][1] = value
        describe(folder, features=features)

    return spoil


def not_regular(name, make):
    """Something else in place of a file."""

    def spoil(folder):
        (folder / name).unlink()
        make(folder / name)

    return spoil


def endless(path):
    with path.open("wb") as file:
        file.truncate(2**40)  # sparse: a terabyte that takes no place


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda folder: describe(folder, format=5), "has format 5, this version reads 1 to 4"),
        (
            lambda folder: describe(folder, mission="formation", env_id=FORMATION),
            "trained on 'quad/Formation",
        ),
        (lambda folder: (folder / "policy.json").write_text("[1"), "is not valid JSON"),
        (lambda folder: (folder / "network.safetensors").unlink(), "cannot read network.safetensors"),
        (truncate, "not a safetensors file, or truncated"),
        (pickle_in_disguise, "pickles are never opened"),
        (not_finite, "layer 1 of a network is not finite"),
        (wrong_shapes, "layer 1 of a network must take 16 inputs"),
        (
            scaled("mean", np.nan),
            r"mean and scale of a network's feature 'V_B\[1\]' must be finite.* got nan",
        ),
        (scaled("mean", np.inf), "must be finite"),
        (scaled("mean", 10**400), "is not a valid network"),
        (scaled("mean", 1e300), r"float32 cannot hold .* layer 0 .* 'V_B\[1\]' has mean 1e\+300"),
        (scaled("scale", 1e-300), r"float32 cannot hold .* 'V_B\[1\]' has mean 0.0, scale 1e-300"),
        (scaled("scale", 1e-40), r"'V_B\[1\]' has mean 0.0, scale 1e-40"),
        (scaled("scale", 0.0), "the scale > 0, got 0.0 and 0.0"),
        (scaled("scale", np.inf), "must be finite"),
        (scaled("scale", np.nan), "must be finite"),
        (lambda folder: (folder / "policy.json").write_text("[" * 100_000), "is not valid JSON"),
        (not_regular("policy.json", os.mkfifo), r"policy\.json is no regular file"),
        (not_regular("network.safetensors", os.mkfifo), r"network\.safetensors is no regular file"),
        (not_regular("policy.json", lambda path: os.symlink("/dev/zero", path)), "is no regular file"),
        (not_regular("network.safetensors", os.mkdir), r"cannot read network\.safetensors: Is a directory"),
        (not_regular("policy.json", lambda path: os.symlink(path, path)), r"cannot read policy\.json"),
        (not_regular("network.safetensors", endless), "has more than 50000000 bytes"),
    ],
)
def test_anything_else_is_refused(saved, monkeypatch, tmp_path, spoil, message):
    monkeypatch.chdir(tmp_path)
    spoil(saved)
    with pytest.raises(CheckpointError, match=message):
        make_policy(saved, HELIX)
    assert not (tmp_path / "opened").exists()


@pytest.mark.parametrize("name", ["format", "squash", "commands", "mission", "features"])
@pytest.mark.parametrize("value", ["x" * 100_000, [["y"] * 1000] * 1000, {"z" * 100_000: 1}, None, 10**400])
def test_odd_descriptions_are_refused_in_a_short_message(saved, name, value):
    describe(saved, **{name: value})
    if (name, value) == ("mission", None):
        return  # of a checkpoint that does not say
    with pytest.raises(CheckpointError) as said:
        make_policy(saved, HELIX)
    assert len(str(said.value).replace(str(saved), "")) < 400


@pytest.mark.parametrize("layer", [1, 2])
def test_layers_behind_the_first_may_not_overflow_either(layer):
    network = network_for()
    weights = list(network.weights)
    weights[layer] = np.full_like(weights[layer], 1e38)
    with pytest.raises(ValueError, match=f"float32 cannot hold the sums of layer {layer} of a network"):
        replace(network, weights=tuple(weights))


def test_what_is_accepted_answers_finite_numbers_to_the_largest_observations():
    network, task = network_for(), task_of(HELIX)
    scale = np.array(network.features.scale)
    scale[3] = 1e-30
    policy = NetworkPolicy(
        replace(network, features=replace(network.features, scale=tuple(scale))), task, "x"
    )
    for sign in (-1.0, 1.0):
        for rows in (1, 9):
            seen = np.full((rows, task.layout.size), sign * 1e6, np.float32)
            assert np.isfinite(policy.predict(seen)[0]).all()


def test_a_network_that_sees_what_is_not_there_is_refused(saved):
    with pytest.raises(CheckpointError, match=r"does not fit .* the network sees preview\[14\]"):
        make_policy(saved, make_env(HELIX, preview=10))


def test_a_shipped_network_that_does_not_fit_says_where_it_was_trained():
    with pytest.raises(CheckpointError, match=r"trained on 'quad/CorridorTracking-v0', does not fit"):
        make_policy("ppo-corridor", HELIX)


def test_a_network_with_other_actions_is_refused(tmp_path):
    save_checkpoint(tmp_path / "wide", network_for(outputs=6), ABOUT)
    with pytest.raises(CheckpointError, match="gives 6 numbers, an action of this task has 4"):
        load_policy(tmp_path / "wide", HELIX)


def test_a_file_of_another_library_is_not_opened(tmp_path):
    path = tmp_path / "model.zip"
    path.write_bytes(pickle.dumps(Trap()))
    with pytest.raises(CheckpointError, match="are pickles, which are never opened"):
        make_policy(str(path), HELIX)


def test_a_folder_that_is_not_there_is_said_to_be_so():
    with pytest.raises(CheckpointError, match="there is no folder 'runs/nowhere'"):
        make_policy("runs/nowhere", HELIX)
    with pytest.raises(ValueError, match="the folder of a trained one"):
        make_policy("nowhere", HELIX)


def test_a_trained_policy_has_no_options(saved):
    with pytest.raises(ValueError, match="a trained policy has no options, got horizon"):
        make_policy(saved, HELIX, horizon=3)


def test_a_full_disk_leaves_the_checkpoint_before_whole(saved, monkeypatch):
    def full(path, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("baselines.policies.checkpoints.write_atomic", full)
    with pytest.raises(CheckpointError, match=r"No space left on device.*the one before it"):
        save_checkpoint(saved, network_for(seed=1), ABOUT)
    assert np.array_equal(load_checkpoint(saved)[0].weights[0], network_for().weights[0])
    assert sorted(path.name for path in saved.iterdir()) == ["network.safetensors", "policy.json"]


@pytest.mark.parametrize("files", [0, 1])
def test_a_writer_that_dies_between_two_files_leaves_a_checkpoint(tmp_path, monkeypatch, files):
    """Its first one, and one in place of another: the weights bring their own description."""
    folder, better = tmp_path / "run", network_for(squash="tanh")
    if files:
        save_checkpoint(folder, network_for(), ABOUT)
    real = os.replace

    def die(source, target):
        if str(target).endswith(os.path.join("run", "policy.json")):
            raise KeyboardInterrupt
        real(source, target)

    monkeypatch.setattr(os, "replace", die)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(folder, better, ABOUT | {"score": 0.75})
    network, said = load_checkpoint(folder)
    assert network.squash == "tanh" and said["score"] == 0.75 and len(said["digest"]) == 64


def test_weights_of_before_whose_description_is_another_are_refused(tmp_path):
    """They bring no description of their own."""
    from safetensors.numpy import load_file, save_file

    folder = tmp_path / "net"
    shutil.copytree(SHIPPED / "apg-helix", folder)
    save_file(load_file(folder / "network.safetensors"), folder / "network.safetensors")
    describe(folder, digest="0")
    with pytest.raises(CheckpointError, match="describes other weights"):
        load_checkpoint(folder)
    (folder / "policy.json").unlink()
    with pytest.raises(CheckpointError, match=r"there is no policy\.json"):
        load_checkpoint(folder)


def test_shipped_policies_go_by_name(saved, monkeypatch):
    monkeypatch.setattr("baselines.policies.trained.SHIPPED", saved.parent)
    assert shipped_policies() == {"run": "apg (model-based) on quad/HelixTracking-v0, score 0.500"}
    assert make_policy("run", HELIX).name == "run"


def test_the_range_of_commands_is_a_part_of_a_checkpoint(tmp_path):
    network = replace(network_for(), squash="clip", command_range=0.25)
    save_checkpoint(tmp_path, network, {"env_id": HELIX})
    policy, task = make_policy(tmp_path, HELIX), task_of(HELIX)
    seen = np.concatenate([observations(), 50.0 * observations()])  # outputs reach the edges of their box
    full = NetworkPolicy(replace(network, command_range=1.0), task, "full")
    wanted = hover_actions(0.25 * hover_outputs(full.predict(seen)[0], task), task)
    for found in (policy.predict(seen)[0], np.concatenate([policy.predict(row[None])[0] for row in seen])):
        np.testing.assert_allclose(found, wanted, atol=2e-6)  # summed in another order
    described = json.loads((tmp_path / "policy.json").read_text())
    assert described["format"] == 3 and described["command_range"] == 0.25
    with pytest.raises(
        ValueError, match="command_range is a share of the hover force, above 0 and at most 1"
    ):
        replace(network, command_range=1.5)
