"""What the command `certify` does."""

from __future__ import annotations

import json

from ..certify import certify
from ..certify.figures import draw
from ..files import provenance, write_json
from ..report.figures import house_style
from .commands import plain_warnings, progress, say
from .options import CertifyOptions, read_assignments

_PARTS = 4  # terminal inequality, flight, two ellipsoids


def certify_one(options: CertifyOptions) -> int:
    """Certify one policy, print the verdicts, and leave figures where asked."""
    env_kwargs = read_assignments("--set", options.set)
    policy_kwargs = read_assignments("--policy-set", options.policy_set)
    if options.out is not None:
        with house_style():  # without matplotlib this fails now, and not after the flights
            options.out.mkdir(parents=True, exist_ok=True)
    with plain_warnings(), progress(_PARTS, "part") as bar:
        report = certify(
            options.env,
            options.policy,
            env_kwargs=env_kwargs,
            policy_kwargs=policy_kwargs,
            seed=options.seed,
            starts=options.starts,
            on_step=lambda: bar.update(1),
        )
    found = report.to_dict()
    if options.out is not None:
        write_json(options.out / "certify.json", {**found, "env_kwargs": env_kwargs, **provenance()})
        paths = draw(report, options.out)
        say(f"certify.json and {len(paths)} figures in {options.out}")
    print(json.dumps(found, indent=1, allow_nan=False) if options.json else report)
    return 0
