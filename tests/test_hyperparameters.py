"""Hyperparameters: Stable-Baselines3's names and meanings, refusals, records of earlier versions."""

import inspect
import json
import re
from dataclasses import dataclass, fields

import pytest
from stub_training import stubs  # noqa: F401

from baselines import ResultsError, train
from baselines.__main__ import main
from baselines.policies.checkpoints import load_checkpoint
from baselines.policies.trained import SHIPPED
from baselines.training.algorithm_options import PpoOptions, SacOptions, check_sizes
from baselines.training.algorithms import ALGORITHMS, options_of
from baselines.training.former_names import _TODAY, name_of_today
from baselines.training.hyperparameters import hyperparameters, recorded_hyperparameters
from quad_envs.arguments.field_comments import field_comments
from quad_envs.envs.tracking.options import TrackingOptions

HELIX = "quad/HelixTracking-v0"
LEARNERS = ["apg", "dagger", "ppo", "ppo-lagrangian", "sac"]


def names_of(algorithm):
    return [entry.name for entry in fields(options_of(algorithm))]


def refusal(algorithm, name, value=1):
    with pytest.raises(ValueError) as caught:
        hyperparameters(algorithm, HELIX, {name: value})
    return str(caught.value)


@pytest.fixture(scope="module")
def sb3():
    return pytest.importorskip("stable_baselines3")


@pytest.mark.parametrize("algorithm", LEARNERS)
def test_every_hyperparameter_says_what_it_is(algorithm):
    comments = field_comments(options_of(algorithm))
    assert list(comments) == names_of(algorithm) and all(comments.values())


@pytest.mark.parametrize("algorithm", LEARNERS)
def test_list_prints_hyperparameters_with_default_and_meaning(algorithm, capsys):
    assert main(["list", algorithm]) == 0
    lines = capsys.readouterr().out.splitlines()[1:]
    assert [line.split()[0] for line in lines] == names_of(algorithm)
    comments = field_comments(options_of(algorithm))
    assert all(line.endswith(text) for line, text in zip(lines, comments.values(), strict=True))
    assert main(["list", algorithm, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["n_envs"] == hyperparameters(algorithm, "").n_envs


@pytest.mark.parametrize("algorithm", LEARNERS)
def test_a_former_name_is_refused_with_the_one_of_today(algorithm):
    known = names_of(algorithm)
    assert not set(_TODAY) & set(known)
    for former in _TODAY:
        today = name_of_today(former, known)
        if today is not None:
            assert f"'{former}' of '{algorithm}' is called '{today}'" in refusal(algorithm, former)


def test_a_learners_own_name_is_never_answered_with_another_thing(sb3):
    # Names that Stable-Baselines3 has and a learner here has not: at most those that have them are named.
    elsewhere = {"n_timesteps", "total_timesteps", "activation_fn", "normalize"}
    asked = {*inspect.signature(sb3.PPO).parameters, *inspect.signature(sb3.SAC).parameters, *elsewhere}
    for algorithm in LEARNERS:
        for name in asked - {"policy_kwargs", *names_of(algorithm)}:
            said = refusal(algorithm, name)
            assert "did you mean" not in said and "is called" not in said, said
        assert "is called 'net_arch'" in refusal(algorithm, "policy_kwargs", {})


def test_a_name_of_another_learner_is_said_to_be_its():
    assert "'ppo' has no hyperparameter 'buffer_size', sac has one; known: n_envs" in refusal(
        "ppo", "buffer_size"
    )
    assert "ppo and ppo-lagrangian have one" in refusal("sac", "gae_lambda")


def test_a_slip_is_recognised():
    assert "did you mean 'gae_lambda'?" in refusal("ppo", "gae_lamda")
    assert "did you mean 'n_steps'?" in refusal("dagger", "nsteps")


def test_ppo_takes_what_its_options_say(sb3):
    from baselines.training.sb3 import make_flights, make_ppo, train_ppo

    options = PpoOptions(
        n_envs=4, n_steps=8, batch_size=16, n_epochs=3, gamma=0.9, gae_lambda=0.8, clip_range=0.1,
        ent_coef=0.01, vf_coef=0.7, max_grad_norm=0.4, net_arch=(8,), log_std_init=-1.0,
    )  # fmt: skip
    task = TrackingOptions.from_kwargs({})
    model = make_ppo(make_flights(task, options, 0, None), options, 0, lambda: 0.0)
    same = [name for name in names_of("ppo") if name in inspect.signature(sb3.PPO).parameters]
    assert len(same) == 10
    for name in set(same) - {"learning_rate", "clip_range"}:  # schedules
        assert getattr(model, name) == getattr(options, name), name
    assert model.clip_range(1.0) == 0.1 and model.lr_schedule(1.0) == options.learning_rate
    assert model.policy.net_arch == [8] and float(model.policy.log_std.detach().mean()) == -1.0
    # n_steps is that of each environment, as in Stable-Baselines3.
    assert next(train_ppo(task, options, 0, lambda: 0.0))[0].steps == 4 * 8


def test_sac_takes_what_its_options_say(sb3):
    from baselines.training.sb3 import make_flights, make_sac

    options = SacOptions(
        n_envs=4, train_freq=2, gradient_steps=3, batch_size=16, buffer_size=1000, learning_starts=20,
        gamma=0.9, tau=0.02, ent_coef=0.1, net_arch=(8,), n_critics=3, log_std_init=-1.5,
    )  # fmt: skip
    flights = make_flights(TrackingOptions.from_kwargs({}), options, 0, None)
    model = make_sac(flights, options, 0, lambda: 0.0)
    same = {name for name in names_of("sac") if name in inspect.signature(sb3.SAC).parameters}
    assert len(same) == 9
    for name in same - {"learning_rate", "train_freq"}:
        assert getattr(model, name) == getattr(options, name), name
    assert model.train_freq.frequency == 2 and model.policy.net_arch == [8]
    assert len(model.critic.q_networks) == 3
    observations = sb3.common.utils.obs_as_tensor(flights.reset(), "cpu")
    log_std = model.actor.get_action_dist_params(observations)[1]
    assert abs(log_std.detach().numpy() + 1.5).max() < 0.2


@pytest.mark.parametrize(
    ("algorithm", "name", "value", "message"),
    [
        ("ppo", "log_std_init", float("nan"), "must lie in -20 to 20, got nan"),
        ("mappo", "start_log_std", 20.5, "must lie in -20 to 20, got 20.5"),
        ("sac", "log_std_init", -float("inf"), "must lie in -20 to 20, got -inf"),
        ("sac", "n_critics", 0, "must be finite and > 0, got 0"),
        ("sac", "n_critics", 1.5, "must be a whole number, got 1.5"),
    ],
)
def test_a_number_that_no_learner_can_take_is_refused(algorithm, name, value, message):
    with pytest.raises(ValueError, match=f"{name}.* {re.escape(message)}"):
        hyperparameters(algorithm, "quad/Formation-v0" if algorithm == "mappo" else HELIX, {name: value})


@pytest.mark.parametrize(
    ("algorithm", "name", "said"),
    [("ppo", "n_epochs", "got 1000000000$"), ("ppo", "n_envs", "which would take about .* GiB of memory$")],
)
def test_of_what_takes_time_no_memory_is_told(algorithm, name, said):
    options = hyperparameters(algorithm, HELIX, {name: 10**9})
    with pytest.raises(ValueError, match=f"hyperparameter {name} must be a whole number from 1 to .*{said}"):
        check_sizes(options, 226)


@pytest.mark.parametrize("weight", [-0.1, float("nan"), "automatic", "auto_", "auto_0.0", "0.1"])
def test_a_weight_of_the_entropy_that_sac_cannot_take_is_refused(weight):
    with pytest.raises(ValueError, match=r"ent_coef must be finite and >= 0, or 'auto' or as 'auto_0\.01'"):
        hyperparameters("sac", HELIX, {"ent_coef": weight})
    with pytest.raises(ValueError, match="ent_coef of 'sac' must be a number or text"):
        hyperparameters("sac", HELIX, {"ent_coef": [weight]})


def test_records_of_shipped_policies_are_read_under_the_names_of_today():
    for folder in sorted(path.parent for path in SHIPPED.glob("*/policy.json")):
        _, said = load_checkpoint(folder)
        recorded, algorithm = said["hyperparameters"], said["algorithm"]
        found = recorded_hyperparameters(algorithm, recorded)
        assert set(found) == set(names_of(algorithm)), folder
        options = hyperparameters(algorithm, said["env_id"], found)
        # Every value that was recorded is still there, whatever it is called.
        values = [getattr(options, name_of_today(name, found) or name) for name in recorded]
        assert [list(v) if isinstance(v, tuple) else v for v in values] == list(recorded.values())


def test_a_run_of_an_earlier_version_goes_on(tmp_path):
    train(HELIX, "stub", steps=300, out=tmp_path, env_kwargs={"time_limit": 1.0})
    path = tmp_path / "config.json"
    config = json.loads(path.read_text())
    said = config["hyperparameters"]
    said["rows"], said["hidden"] = said.pop("n_envs"), said.pop("net_arch")
    del said["follows"]  # an option that came later
    path.write_text(json.dumps(config))
    more = {"steps": 500, "out": tmp_path, "env_kwargs": {"time_limit": 1.0}, "resume": True}
    with pytest.raises(ResultsError, match=r"its hyperparameters is .*n_envs.*asked for"):
        train(HELIX, "stub", hyper={"n_envs": 50}, **more)
    assert train(HELIX, "stub", **more).curve[-1].steps == 500
    assert "n_envs" in json.loads(path.read_text())["hyperparameters"]


def test_a_record_of_an_algorithm_that_is_not_there_stays_as_it_is():
    assert "evolution" not in ALGORITHMS
    assert recorded_hyperparameters("evolution", {"rows": 3}) == {"rows": 3}


@dataclass(frozen=True, slots=True)
class Above:
    """A dataclass with comments."""

    a: int = 1  # the first; # and a second sign
    b: str = "# no comment"
    # not behind a field
    c: tuple[int, ...] = (
        1,  # one
        2,
    )  # and two


@dataclass(frozen=True, slots=True)
class Below(Above):
    """Changes one, adds one."""

    d: float = (
        0.5  # the last
        # of four
    )
    a: int = 2  # changed


def test_comments_of_fields_are_read_from_the_source():
    first = {"a": "the first; # and a second sign", "b": "", "c": "one and two"}
    assert field_comments(Above) == first
    assert field_comments(Below) == first | {"a": "changed", "d": "the last of four"}
    assert list(field_comments(Below)) == ["a", "b", "c", "d"]


def test_comments_are_empty_where_there_is_no_source():
    found = {}
    exec("from dataclasses import dataclass\n@dataclass\nclass Made:\n    a: int = 1  # one\n", found)
    assert field_comments(found["Made"]) == {"a": ""}


@pytest.mark.parametrize(
    ("algorithm", "name", "value", "message"),
    [
        ("apg", "learning_rate", -1, r"must be finite and > 0, got -1\.0"),
        ("dagger", "learning_rate", -1, r"must be finite and > 0, got -1\.0"),
        ("apg", "gamma", 2, r"must be at most 1, got 2\.0"),
        ("apg", "final_rate", -1, r"must be finite and > 0, got -1\.0"),
        ("apg", "epsilon", 0, r"must be finite and > 0, got 0\.0"),
        ("apg", "penalty", -1, r"must be finite and >= 0, got -1\.0"),
        ("apg", "net_arch", [], "needs at least one layer"),
        ("apg", "separation", 0, "must be finite and > 0 m, got 0"),
        ("dagger", "expert_flies", 3, r"must be at most 1, got 3\.0"),
        ("dagger", "threshold", 0, r"must be finite and > 0, got 0\.0"),
        ("dagger", "net_arch", [], "needs at least one layer"),
    ],
)
def test_numbers_that_make_no_sense_are_refused_by_name(algorithm, name, value, message):
    with pytest.raises(ValueError, match=f"hyperparameter {name} {message}"):
        hyperparameters(algorithm, "", {name: value})
