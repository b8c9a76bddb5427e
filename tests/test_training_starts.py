"""From which networks a training can go on, and what is said of the others before anything is written."""

import pytest

pytest.importorskip("stable_baselines3")

from baselines import CheckpointError, make_policy, train

HELIX = "quad/HelixTracking-v0"


@pytest.mark.parametrize(
    ("algorithm", "given", "message"),
    [
        ("ppo", {"start_from": "apg-helix"}, r"squash.*'tanh'.*and \('clip'.*go on with the algorithm"),
        ("sac", {"start_from": "ppo-helix"}, r"squash.*'clip'.*and \('tanh'.*go on with the algorithm"),
        ("ppo", {"start_from": "ppo-helix", "hyper": {"net_arch": [8]}}, "go on with the algorithm"),
        ("ppo-lagrangian", {"start_from": "ppo-corridor"}, r"sees position\[0\] \(and 2 more\)"),
        ("ppo", {"start_from": "ppo-helix", "env_kwargs": {"preview": 5}}, "pass preview=25, or more"),
        ("ppo", {"start_from": "ppo-helix", "hyper": {"stages": [0]}}, "not other stages or heading_axes"),
        (
            "ppo",
            {"start_from": "ppo-helix", "hyper": {"heading_axes": True}},
            "not other stages or heading_axes",
        ),
        (
            "ppo",
            {"start_from": "apg-formation"},
            "trained on 'quad/Formation-v0'.*begin with a network of the same",
        ),
        ("ppo", {"hyper": {"stages": [0, 30]}}, "the preview has stages 0 to 25"),
    ],
)
def test_a_start_that_does_not_fit_is_refused_before_anything_is_written(tmp_path, algorithm, given, message):
    with pytest.raises(ValueError, match=message):
        train(HELIX, algorithm, steps=1, out=tmp_path / "run", **given)
    assert not (tmp_path / "run" / "config.json").exists()


def test_a_tuned_folder_is_no_network_to_begin_with(tmp_path):
    (tmp_path / "tuned").mkdir()
    (tmp_path / "tuned" / "tuned.json").write_text("{}")
    with pytest.raises(CheckpointError, match="is a tuned policy, which has no network to begin with"):
        train(HELIX, "apg", steps=1, out=tmp_path / "run", start_from=tmp_path / "tuned")
    assert not (tmp_path / "run").exists()


def test_a_folder_whose_training_has_saved_nothing_says_so(tmp_path):
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(CheckpointError, match=r"cannot read policy\.json.*has not saved a policy yet"):
        make_policy(tmp_path, HELIX)
    with pytest.raises(CheckpointError, match="has not saved a policy yet"):
        train(HELIX, "apg", steps=1, out=tmp_path / "run", start_from=tmp_path)
