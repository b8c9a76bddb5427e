"""PPO of this checkout beside that of another one: its speed update by update, and its learning curves.

Each checkout trains in processes of its own, with the hyperparameters that it has for itself.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from .turns import HERE, at_work

ENV_ID = "quad/HelixTracking-v0"
SHARES = (0.1, 0.2, 0.3, 0.5, 0.75, 1.0)  # of the budget, at which curves are compared
_UPDATES = """
import sys
from time import process_time
from benchmarks.train import PpoOptions, _flights, _learner
import torch
torch.set_num_threads(1)
options = PpoOptions(n_envs=int(sys.argv[1]))
update = _learner(_flights(options), options, True)
update()
for line in sys.stdin:
    begin = process_time()
    update()
    print(options.n_envs * options.n_steps / (process_time() - begin), flush=True)
"""
_CURVE = """
import json, sys
from baselines import train
env_id, seed, steps, out = sys.argv[1:]
curve = train(env_id, "ppo", seed=int(seed), steps=int(steps), out=out, fresh=True).curve
print(json.dumps([[point.steps, point.score, point.cpu_seconds] for point in curve]))
"""


def update_rates(other: Path, rows: int, repetitions: int) -> tuple[float, float]:
    """Steps per CPU-second of PPO here and there, best of the repetitions, which take turns."""
    best = [0.0, 0.0]
    with at_work(HERE, _UPDATES, str(rows)) as ours, at_work(other, _UPDATES, str(rows)) as theirs:
        for _ in range(repetitions):
            for k, process in enumerate((ours, theirs)):
                best[k] = max(best[k], float(process.ask()))
    return best[0], best[1]


def curve(checkout: Path, seed: int, steps: int) -> list[float]:
    """Scores of one training at `SHARES` of its budget, from the held-out starts that choose policies."""
    with tempfile.TemporaryDirectory() as out:
        said = subprocess.run(
            [sys.executable, "-c", _CURVE, ENV_ID, str(seed), str(steps), out],
            cwd=checkout,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        ).stdout
    points = np.array(json.loads(said.splitlines()[-1]))
    return [float(np.interp(share * steps, points[:, 0], points[:, 1])) for share in SHARES]
