"""What the command `record` does."""

from __future__ import annotations

import json

from .commands import plain_warnings, progress, say
from .options import RecordOptions, read_assignments
from .values import read_value


def record_flights(options: RecordOptions) -> int:
    """Fly, leave the dataset, and say how to load it."""
    from ..policies.environments import make_env
    from ..policies.registry import make_policy
    from ..training.recording import record

    if not options.policy:
        raise ValueError("name a policy that flies, as: quad-envs record ENV nmpc --minari NAME")
    if not options.minari:
        raise ValueError("name the dataset, as: --minari quad/corridor/expert-v0")
    chosen = read_assignments("--policy-set", options.policy_set)
    if chosen and len(options.policy) > 1:
        raise ValueError("--policy-set is for one policy, and several are named: tune one, or record each")
    noise = [read_value(text) for text in options.noise]
    with plain_warnings():
        env = make_env(options.env, **read_assignments("--set", options.set))
        policies = [make_policy(name, env, **chosen) for name in options.policy]
        with progress(options.episodes * len(options.policy), "flight") as bar:
            found = record(
                env,
                policies,
                options.minari,
                episodes=options.episodes,
                seed=options.seed,
                noise=noise or 0.0,
                on_episode=lambda count: bar.update(count - bar.n),
            )
    if options.json:
        print(json.dumps({**found._asdict(), "folder": str(found.folder)}, indent=1, allow_nan=False))
    else:
        print(
            f"{found.episodes} episodes, {found.steps} steps; means: score {found.score:.3f}, "
            f"constraint cost {found.cost:.3g}"
        )
    say(f"dataset in {found.folder}; load it with: minari.load_dataset({found.dataset!r})")
    return 0
