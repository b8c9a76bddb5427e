"""Networks that were trained elsewhere: models of Stable-Baselines3 and torch modules."""

from __future__ import annotations

import io
import json
import pickle
import subprocess
import sys
import zipfile

import gymnasium as gym
import numpy as np
import pytest

from baselines import CheckpointError, PolicyError, check_policy, evaluate, export_policy, make_policy, sb3
from baselines.__main__ import main
from baselines.policies.normalisation import read_normalisation
from quad_envs import formation_v0

stable_baselines3 = pytest.importorskip("stable_baselines3")
import torch  # noqa: E402
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize  # noqa: E402

HELIX, CORRIDOR = "quad/HelixTracking-v0", "quad/CorridorTracking-v0"
CLOSE = 1e-5  # the promise; float32 sums of 226 products differ by a few 1e-7
MODELS = {
    "ppo": ("PPO", {"net_arch": [16, 8]}),
    "ppo-relu": ("PPO", {"net_arch": {"pi": [16], "vf": [8, 8]}, "activation_fn": torch.nn.ReLU}),
    "a2c": ("A2C", {"net_arch": [8]}),
    "sac": ("SAC", {"net_arch": [16, 8]}),
    "sac-tanh": ("SAC", {"net_arch": [16], "activation_fn": torch.nn.Tanh}),
    "td3": ("TD3", {"net_arch": [16, 8]}),
    "ddpg": ("DDPG", {"net_arch": [16]}),
    "linear": ("PPO", {"net_arch": []}),
}


def model_for(env=HELIX, algorithm="PPO", kwargs=None, **more):
    """An untrained model; its last layer is large, so that actions reach the edges of their box."""
    kwargs = {"net_arch": [8]} if kwargs is None else kwargs
    if algorithm in ("SAC", "TD3", "DDPG"):
        more |= {"buffer_size": 100}
    model = getattr(stable_baselines3, algorithm)(
        "MlpPolicy", env, seed=0, device="cpu", policy_kwargs=kwargs, **more
    )
    last = model.policy.action_net if hasattr(model.policy, "action_net") else model.actor.mu
    last = [*last.modules()][-1] if isinstance(last, torch.nn.Linear) else [*last.modules()][-2]
    with torch.no_grad():
        last.weight.mul_(60.0)
    return model


@pytest.fixture
def saved(tmp_path, monkeypatch):
    """A model in the current folder."""
    monkeypatch.chdir(tmp_path)
    model_for().save("model.zip")
    return tmp_path


def seen_in_flight(seeds=3):
    """Observations of a few flights."""
    env, rows = gym.make(HELIX), []
    env.action_space.seed(0)
    for seed in range(seeds):
        rows.append(env.reset(seed=seed)[0])
        rows += [env.step(env.action_space.sample())[0] for _ in range(5)]
    return np.stack(rows)


@pytest.mark.parametrize("name", MODELS)
def test_a_checkpoint_answers_as_the_model_does(name, tmp_path):
    model = model_for(HELIX, *MODELS[name])
    model.save(tmp_path / "model.zip")
    policy = make_policy(export_policy(tmp_path / "model.zip", tmp_path / "net"), HELIX)
    rows = seen_in_flight()
    expected, _ = model.predict(rows, deterministic=True)
    assert np.ptp(expected) > 0.5  # and does not sit on an edge
    assert np.abs(policy.predict(rows)[0] - expected).max() < CLOSE
    one_by_one = np.concatenate([policy.predict(row[None])[0] for row in rows])
    assert np.abs(one_by_one - expected).max() < CLOSE
    check_policy(policy, HELIX)


def test_the_statistics_of_vecnormalize_are_a_part_of_it(tmp_path, capsys):
    """Also where numbers do not vary, as a yaw reference, whose scale is 1e-4, and where they are cut."""
    env = VecNormalize(DummyVecEnv([lambda: gym.make(HELIX)]), clip_obs=1.0)
    model = model_for(env, kwargs={"net_arch": [16]}, n_steps=64, batch_size=64, n_epochs=1)
    model.learn(128)
    model.save(tmp_path / "model.zip")
    env.save(tmp_path / "stats.pkl")
    words = [str(tmp_path / name) for name in ("model.zip", "net")]
    assert main(["export", *words, "--vecnormalize", str(tmp_path / "stats.pkl"), "--env", HELIX]) == 0
    assert capsys.readouterr().out.strip() == "ppo, 226 -> 16 -> 4, tanh"
    rows = seen_in_flight()
    normal = env.normalize_obs(rows)
    assert (np.abs(normal) == 1.0).any() and env.obs_rms.var.min() < 1e-6
    expected, _ = model.predict(normal.astype(np.float32), deterministic=True)
    trusted = sb3(tmp_path / "model.zip", tmp_path / "stats.pkl")
    checkpoint = make_policy(tmp_path / "net", HELIX)
    for policy in (trusted, checkpoint):
        assert np.abs(policy.predict(rows)[0] - expected).max() < CLOSE
        check_policy(policy, HELIX)
    scores = [evaluate(policy, HELIX, episodes=2).summary()["score"].mean for policy in (trusted, checkpoint)]
    assert scores[0] == pytest.approx(scores[1], abs=1e-5)
    loud = main(["evaluate", HELIX, str(tmp_path / "net"), "--episodes", "1", "--json"])
    assert loud == 0 and json.loads(capsys.readouterr().out)["policy"] == "net"


def test_a_model_can_be_given_as_an_object(tmp_path):
    model = model_for()
    policy = make_policy(export_policy(model, tmp_path / "net"), HELIX)
    rows = seen_in_flight(1)
    assert np.abs(policy.predict(rows)[0] - model.predict(rows, deterministic=True)[0]).max() < CLOSE


@pytest.mark.parametrize("last", [True, False])
@pytest.mark.parametrize("kind", [torch.nn.Tanh, torch.nn.ReLU])
def test_torch_modules_become_checkpoints(tmp_path, kind, last):
    torch.manual_seed(0)
    inner = torch.nn.Sequential(torch.nn.Linear(226, 16), kind(), torch.nn.Dropout())
    more = [torch.nn.Tanh()] if last else []
    module = torch.nn.Sequential(
        torch.nn.Flatten(), inner, torch.nn.Linear(16, 8), kind(), torch.nn.Linear(8, 4, bias=False), *more
    ).eval()
    mean, scale, rows = np.linspace(-1.0, 1.0, 226), np.linspace(0.5, 2.0, 226), seen_in_flight(1)
    policy = make_policy(export_policy(module, tmp_path / "net", env=HELIX, mean=mean, scale=scale), HELIX)
    with torch.no_grad():
        expected = module(torch.from_numpy(((rows - mean) / scale).astype(np.float32))).numpy()
    assert np.abs(policy.predict(rows)[0] - np.clip(expected, -1.0, 1.0)).max() < CLOSE


@pytest.mark.parametrize(
    "module",
    [
        torch.nn.Sequential(torch.nn.Linear(226, 8), torch.nn.GELU(), torch.nn.Linear(8, 4)),
        torch.nn.Sequential(torch.nn.Linear(226, 8), torch.nn.Linear(8, 4)),
        torch.nn.Sequential(torch.nn.Tanh(), torch.nn.Linear(226, 4)),
        torch.nn.Sequential(torch.nn.Linear(226, 4), torch.nn.ReLU()),
        torch.nn.LSTM(226, 4),
        torch.nn.Sequential(),
        object(),
    ],
    ids=lambda module: type(module).__name__,
)
def test_other_modules_are_refused_with_what_they_are(module, tmp_path):
    with pytest.raises(CheckpointError, match=r"torch\.nn\.Sequential of Linear, Tanh.*this is \w+"):
        export_policy(module, tmp_path / "net")
    assert not (tmp_path / "net").exists()


def test_with_its_environment_the_network_flies_where_it_finds_its_parts(tmp_path):
    export_policy(model_for(), tmp_path / "named", env=HELIX)
    export_policy(model_for(), tmp_path / "places")
    longer = gym.make(HELIX, preview=30)
    assert evaluate(tmp_path / "named", longer, episodes=1).flights == 1
    with pytest.raises(CheckpointError, match="observations of 226 numbers, here they have 266"):
        make_policy(tmp_path / "places", longer)


@pytest.mark.parametrize(
    ("env", "said"),
    [
        (CORRIDOR, "it sees 226 numbers, an observation of quad/CorridorTracking-v0 has 229"),
        (lambda: formation_v0.parallel_env(), "it sees 226 numbers, an observation of quad/Formation-v0"),
    ],
)
def test_models_of_another_task_are_refused(saved, env, said):
    env = env if isinstance(env, str) else env()
    with pytest.raises(CheckpointError, match=said):
        export_policy("model.zip", "net", env=env)
    with pytest.raises(PolicyError, match=r"'model' was trained in another task: it sees 226 numbers"):
        evaluate(sb3("model.zip"), env, episodes=1)


@pytest.mark.parametrize(
    ("env", "said"),
    [
        ("CartPole-v1", "is of another task: its action_space is .*Discrete"),
        ("Pendulum-v1", "its actions are between .*-2.0.* here they are between -1 and 1"),
    ],
)
def test_models_of_other_suites_are_refused(tmp_path, env, said):
    stable_baselines3.PPO("MlpPolicy", env, device="cpu").save(tmp_path / "model.zip")
    for read in (lambda path: export_policy(path, tmp_path / "net"), sb3):
        with pytest.raises(CheckpointError, match=said):
            read(tmp_path / "model.zip")


def rewritten(path, **members):
    """A zip with other contents: a name with its text, or None for a member that is left out."""
    with zipfile.ZipFile(path) as file:
        parts = {name: file.read(name) for name in file.namelist()}
    for name, value in members.items():
        name = {"weights": "policy.pth", "version": "_stable_baselines3_version"}.get(name, name)
        parts.pop(name)
        if value is not None:
            parts[name] = value
    with zipfile.ZipFile(path, "w") as file:
        for name, value in parts.items():
            file.writestr(name, value)


def settings(path, **changes):
    """A zip with other settings."""
    with zipfile.ZipFile(path) as file:
        data = json.loads(file.read("data"))
    rewritten(path, data=json.dumps(data | changes))


class Trap:
    """Writes a file when it is unpickled."""

    def __reduce__(self):
        return (open, ("sprung", "w"))


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (
            lambda path: path.write_text("no zip"),
            "is no model of Stable-Baselines3, a zip that model.save wrote",
        ),
        (lambda path: path.write_bytes(path.read_bytes()[:900]), "is no model of Stable-Baselines3, a zip"),
        (lambda path: rewritten(path, data=None), "but no model of Stable-Baselines3: it has no data$"),
        (lambda path: rewritten(path, weights=None), "it has no policy.pth$"),
        (lambda path: rewritten(path, data="{"), "its data is not valid JSON"),
        (lambda path: rewritten(path, data="{}"), "its data name no spaces"),
        (
            lambda path: rewritten(path, version="99.1.0"),
            r"was written by Stable-Baselines3 '99.1.0', \d.* is",
        ),
        (
            lambda path: settings(path, policy_kwargs={"activation_fn": "<class 'torch.nn.GELU'>"}),
            "is .*GELU",
        ),
        (
            lambda path: settings(path, policy_kwargs={"features_extractor_class": "<class 'mine.Net'>"}),
            "it has a features extractor, .*mine.Net",
        ),
        (lambda path: settings(path, policy_class={"__module__": "mine"}), "its policy is one of mine"),
    ],
)
def test_what_is_no_usual_model_is_refused_by_name(saved, capsys, spoil, said):
    spoil(saved / "model.zip")
    with pytest.raises(CheckpointError, match=said):
        export_policy("model.zip", "net")
    assert main(["export", "model.zip", "net"]) == 2
    _, err = capsys.readouterr()
    assert err.count("\n") == 1 and not (saved / "net").exists()


def test_export_opens_no_pickle(saved):
    """Traps in every place that holds a pickle; none is sprung, and the reason is said."""
    trap = io.BytesIO()
    torch.save({"action_net.weight": Trap()}, trap)
    settings(saved / "model.zip", lr_schedule={":type:": "function", ":serialized:": "gASVAA=="})
    export_policy("model.zip", "net")
    rewritten(saved / "model.zip", weights=trap.getvalue())
    with pytest.raises(CheckpointError, match=r"policy\.pth is damaged, or holds more than weights"):
        export_policy("model.zip", "other")
    (saved / "stats.pkl").write_bytes(pickle.dumps(Trap()))
    with pytest.raises(CheckpointError, match=r"is no file of VecNormalize\.save: it holds open"):
        read_normalisation("stats.pkl")
    assert not (saved / "sprung").exists()


def test_statistics_of_another_task_are_refused(saved):
    VecNormalize(DummyVecEnv([lambda: gym.make(CORRIDOR)])).save("stats.pkl")
    for read in (
        lambda: export_policy("model.zip", "net", vecnormalize="stats.pkl"),
        lambda: sb3("model.zip", "stats.pkl"),
    ):
        with pytest.raises(CheckpointError, match=r"statistics of 229 numbers, the (network|model) sees 226"):
            read()
    with pytest.raises(CheckpointError, match="either vecnormalize, or mean and scale"):
        export_policy("model.zip", "net", vecnormalize="stats.pkl", mean=0.0)


def test_a_vecnormalize_of_rewards_alone_changes_nothing(saved):
    VecNormalize(DummyVecEnv([lambda: gym.make(HELIX)]), norm_obs=False).save("stats.pkl")
    assert read_normalisation("stats.pkl") is None
    rows = seen_in_flight(1)
    plain, same = sb3("model.zip"), sb3("model.zip", "stats.pkl")
    assert np.array_equal(plain.predict(rows)[0], same.predict(rows)[0])


def test_a_checkpoint_is_replaced_only_if_it_is_said(saved, capsys):
    export_policy("model", "net")  # without .zip, as Stable-Baselines3 itself allows
    with pytest.raises(CheckpointError, match="holds a checkpoint already"):
        export_policy("model.zip", "net")
    assert main(["export", "model.zip", "net", "--fresh"]) == 0
    assert main(["export", "model.zip", "other", "--set", "kappa=0.4"]) == 2
    assert "--set needs the environment that it is for" in capsys.readouterr().err


def test_an_exported_network_flies_without_torch(saved):
    export_policy("model.zip", "net")
    code = (
        "import sys; sys.modules['torch'] = sys.modules['stable_baselines3'] = None\n"
        f"from baselines import evaluate\nprint(evaluate('./net', {HELIX!r}, episodes=1).policy)"
    )
    found = subprocess.run([sys.executable, "-c", code], cwd=saved, capture_output=True, text=True)
    assert found.stdout == "net\n", found.stderr
