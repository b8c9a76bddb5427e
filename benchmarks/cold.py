"""Cold starts: `python -m benchmarks.cold [POLICY ...] [--env ID] [--runs 5] [--compile] [--json]`.

CPU-seconds from a new process to the first step, and to the first decision of each policy named; each process
does one. Kernels are found where they are, in a folder of an earlier run or in the wheel: one run goes
before, uncounted. With `--compile` a new folder is empty at first, and that run is what is shown.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile

from quad_envs.registration import TEAMS

from .timing import machine

_FIRST = """
import json, sys, time
laps = {}
def lap(what):
    laps[what] = time.process_time() - sum(laps.values())
import numpy as np, gymnasium
lap("numpy, gymnasium")
import quad_envs
lap("import")
policy, name, module = sys.argv[1:]
if module:
    import importlib
    env = importlib.import_module(module).parallel_env()
else:
    env = gymnasium.make(name)
lap("make")
seen, _ = env.reset(seed=0)
lap("reset")
if module:
    env.step({agent: np.zeros(env.action_space(agent).shape, np.float32) for agent in env.agents})
else:
    env.step(np.zeros(4, dtype=np.float32))
lap("step")
if policy:
    from baselines import make_policy
    decides = make_policy(policy, env)
    if getattr(decides, "privileged", False):
        seen = env.state()[None]
    else:
        seen = np.stack(list(seen.values())) if module else seen[None]
    decides.predict(seen)
    lap("decision")
print(json.dumps(laps))
"""


def first(policy: str, env_id: str, runs: int, compile_anew: bool) -> dict[str, float]:
    """CPU-seconds of each part in the quickest run of several.

    Args:
        policy: Its name; "" for none.
        env_id: Of the environment.
        runs: New processes.
        compile_anew: Whether the only run begins with an empty folder of kernels.
    """
    with tempfile.TemporaryDirectory() as empty:
        changes = {"NUMBA_CACHE_DIR": empty} if compile_anew else {}
        laps = []
        for _ in range(1 if compile_anew else runs + 1):
            command = [sys.executable, "-c", _FIRST, policy, env_id, TEAMS.get(env_id, "")]
            done = subprocess.run(
                command, env=os.environ | changes, stdout=subprocess.PIPE, text=True, check=True
            )
            laps.append(json.loads(done.stdout))
    found: dict[str, float] = min(laps, key=lambda parts: sum(parts.values()))
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("policies", nargs="*")
    parser.add_argument("--env", default="quad/HelixTracking-v0")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--compile", action="store_true")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    asked = ["", *options.policies]
    found = {policy: first(policy, options.env, options.runs, options.compile) for policy in asked}
    if options.json:
        print(json.dumps({"machine": machine(), "found": found}))
        return
    print(machine())
    for policy, laps in found.items():
        parts = "  ".join(f"{what} {seconds:.3f}" for what, seconds in laps.items())
        print(f"{policy or 'first step':14} {sum(laps.values()):.2f} CPU-s:  {parts}")


if __name__ == "__main__":
    main()
