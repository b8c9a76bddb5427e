"""Training algorithms that learn nothing, quickly: `stubs` puts them into the registry of a test."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pytest

from baselines import TrainingError
from baselines.policies.network import Network
from baselines.training.algorithms import ALGORITHMS, Algorithm
from quad_envs.observations.features import default_features


@dataclass(frozen=True, slots=True)
class StubOptions:
    """Of the stub."""

    gain: float = 1.0
    net_arch: tuple[int, ...] = (4,)
    n_envs: int = 100
    fails_at: int = 0
    how: str = ""
    follows: bool = False  # hands out the network that it begins with


class Progress(NamedTuple):
    update: int
    steps: int
    reward: float


def stub(task_options, options, seed, spent, start=None):
    """Each update draws another network around hover; after `fails_at` of them something happens."""
    task, rng, update = task_options.task, np.random.default_rng(seed), 0
    features = default_features(task.layout)
    while spent() < 1.0:
        update += 1
        if update == options.fails_at:
            if options.how == "interrupt":
                raise KeyboardInterrupt
            if options.how == "training":
                raise TrainingError("the loss is nan")
        bias = np.full(4, np.nan if options.how == "nan" and update == options.fails_at else 0.0)
        bias += options.gain * rng.normal(size=4) / (1 + update)
        weights = np.zeros((len(features.names), 4), np.float32)
        reward = np.inf if options.how == "infinite" and update == options.fails_at else 0.5
        drawn = Network(features, (weights,), (bias.astype(np.float32),))
        yield Progress(update, options.n_envs * update, reward), start if options.follows else drawn
        if start is not None:
            assert len(start.weights) == 1


def once_only(task_options, options, seed, spent):
    """The same, and it cannot go on."""
    return stub(task_options, options, seed, spent)


@pytest.fixture(autouse=True)
def stubs(monkeypatch):
    entry = Algorithm(
        __name__, "stub", StubOptions, "imitation", ("tracking", "formation"), "a stub", 2.0, ()
    )
    monkeypatch.setitem(ALGORITHMS, "stub", entry)
    monkeypatch.setitem(ALGORITHMS, "once", entry._replace(generator="once_only"))
