"""`quad-envs doctor`: is the installation sound?"""

from __future__ import annotations

import importlib
import json
import platform
import warnings
from collections.abc import Callable
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

EXTRAS = {
    "rl": ("stable_baselines3", "torch", "safetensors"),
    "report": ("matplotlib",),
    "human": ("pygame",),
    "video": ("moviepy",),
    "exact": ("casadi",),
    "lmi": ("cvxpy", "clarabel"),
    "minari": ("minari", "h5py"),
    "ray": ("ray",),
    "dask": ("distributed",),
}
_NEEDED = ("numpy", "scipy", "numba", "gymnasium", "pettingzoo", "osqp", "joblib", "tqdm")
_GENERIC = ("controllers", "baselines")  # names that another distribution may bring, too


class Finding(NamedTuple):
    """Result of one check."""

    check: str
    ok: bool
    detail: str


def examine(as_json: bool) -> int:
    """Run all checks and print them; 0 if all is well, else 1."""
    checks = (_versions, _shadowing, _cache, _self_test, _team_test, _extras)
    findings = [_run(check) for check in checks]
    if as_json:
        print(json.dumps([finding._asdict() for finding in findings], indent=1))
    else:
        for finding in findings:
            print(f"{'ok ' if finding.ok else 'BAD'}  {finding.check:12} {finding.detail}")
    return 0 if all(finding.ok for finding in findings) else 1


def _run(check: Callable[[], Finding]) -> Finding:
    try:
        return check()
    except Exception as error:  # a check that breaks is a finding
        return Finding(check.__name__.strip("_").replace("_", "-"), False, f"{type(error).__name__}: {error}")


def _versions() -> Finding:
    found, missing = [f"python {platform.python_version()}"], []
    for name in _NEEDED:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            missing.append(name)
    lacking = f"; missing: {', '.join(missing)}: pip install -e . in the clone again" if missing else ""
    return Finding("versions", not missing, ", ".join(found) + lacking)


def _shadowing() -> Finding:
    """Whether `controllers` and `baselines` are ours, and ours alone."""
    home = Path(str(importlib.import_module("quad_envs").__file__)).resolve().parents[1]
    troubles = []
    owners = metadata.packages_distributions()
    for name in _GENERIC:
        spec = find_spec(name)
        folder = Path(spec.origin).resolve().parent if spec is not None and spec.origin else None
        if folder is None:
            troubles.append(f"{name} is not installed beside quad_envs in {home}")
        elif folder != home / name:
            troubles.append(f"{name} comes from {folder}, not from {home}: remove it or change the folder")
        others = sorted(set(owners.get(name, [])) - {"quad-envs", "quad_envs"})
        if others:
            troubles.append(f"{', '.join(others)} also installs a package {name}: uninstall one of the two")
    return Finding(
        "packages", not troubles, "; ".join(troubles) or f"quad_envs, controllers, baselines in {home}"
    )


def _cache() -> Finding:
    """Whether compiled kernels can be kept."""
    from numba.core import config

    from quad_envs.compilation.cache import folder, runs_shipped
    from quad_envs.compilation.portable import SHIPPED

    if getattr(config, "DISABLE_JIT", False):
        return Finding("cache", False, "kernels are not compiled: unset NUMBA_DISABLE_JIT")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the finding says it
        place = folder()
    if place is None:
        remedy = "no folder can be written, every process compiles anew; set NUMBA_CACHE_DIR to one that can"
        return Finding("cache", False, remedy)
    kept, shipped = (len(list(files.glob("*.nbc"))) for files in (place, SHIPPED))
    said = f"{kept} compiled kernels in {place}"
    if shipped:
        said += f", {shipped} of the wheel" + ", which do not run on this processor" * (not runs_shipped())
    elif not kept:
        said += "; quad-envs warm compiles all of them now"
    return Finding("cache", True, said)


def _self_test() -> Finding:
    """One step of an environment and one decision of the linear MPC, made with a warm cache."""
    import gymnasium

    from ..policies.registry import make_policy

    begin = perf_counter()
    env = gymnasium.make("quad/HelixTracking-v0")
    observation, _ = env.reset(seed=0)
    policy = make_policy("lmpc", env)
    action, state = policy.predict(observation[None])
    _, reward, *_ = env.step(action[0])
    first = perf_counter() - begin
    begin = perf_counter()
    policy.predict(observation[None], state)
    decision = 1e3 * (perf_counter() - begin)
    ok = 0.0 < float(reward) <= 1.0
    times = f"first step and LMPC decision {first:.2f} s, second decision {decision:.3f} ms"
    return Finding("self-test", ok, f"{times}, reward {float(reward):.3f}")


def _team_test() -> Finding:
    """The same of a formation: one step and one decision of the whole team."""
    import numpy as np

    from ..policies.environments import make_env
    from ..policies.registry import make_policy

    begin = perf_counter()
    env = make_env("quad/Formation-v0")
    seen, _ = env.reset(seed=0)
    policy = make_policy("consensus-mpc", env)
    observations = np.stack([seen[name] for name in env.agents])
    actions, state = policy.predict(observations)
    rewards = env.step(dict(zip(env.agents, actions, strict=True)))[1].values()
    first = perf_counter() - begin
    begin = perf_counter()
    policy.predict(observations, state)
    decision = 1e3 * (perf_counter() - begin)
    ok = all(0.0 < float(reward) <= 1.0 for reward in rewards)
    times = f"first step and decision of {len(observations)} vehicles {first:.2f} s, second {decision:.3f} ms"
    return Finding("team-test", ok, f"{times}, least reward {min(rewards):.3f}")


def _extras() -> Finding:
    """Optional parts; that one is absent is no fault."""
    parts = []
    for extra, modules in EXTRAS.items():
        missing = [module for module in modules if find_spec(module) is None]
        parts.append(f"{extra} {'yes' if not missing else 'no (lacks ' + ', '.join(missing) + ')'}")
    return Finding("extras", True, ", ".join(parts))
