"""What the command `export` does."""

from __future__ import annotations

import shlex

from .commands import say
from .options import ExportOptions, read_assignments


def export_one(options: ExportOptions) -> int:
    """Make the checkpoint and say how to fly it."""
    from ..policies.checkpoints import load_checkpoint
    from ..policies.environments import make_env
    from ..policies.export import export_policy

    kwargs = read_assignments("--set", options.set)
    if kwargs and not options.env:
        raise ValueError("--set needs the environment that it is for: --env ID")
    export_policy(
        options.model,
        options.folder,
        env=make_env(options.env, **kwargs) if options.env else None,
        vecnormalize=options.vecnormalize,
        fresh=options.fresh,
    )
    network, said = load_checkpoint(options.folder)
    sizes = " -> ".join(map(str, (len(network.features.names), *(len(b) for b in network.biases))))
    print(f"{said['algorithm']}, {sizes}, {network.activation}")
    where = options.env or "ENV"
    folder = shlex.quote(str(options.folder))
    say(f"policy in {options.folder}; fly it with: quad-envs evaluate {where} {folder}")
    return 0
