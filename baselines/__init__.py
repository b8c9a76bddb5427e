"""What a user runs: policies, their evaluation, benchmarks. Names load at first use."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .benchmark import run_benchmark
    from .comparison import Results
    from .conformance import check_policy
    from .errors import PolicyCheckError, ResultsError
    from .estimate_wrapper import EstimateWrapper
    from .evaluation import Evaluation, evaluate
    from .metrics import Estimate, Record, estimate, measure, paired_difference
    from .policy import Policy, PolicyState, make_policy, policy_options
    from .rollout import Episode, run_episodes
    from .suite import Suite, load_suite

# Public name -> module; loaded at first use, so that importing the package stays cheap.
_PUBLIC = {
    "Episode": "rollout",
    "Estimate": "metrics",
    "EstimateWrapper": "estimate_wrapper",
    "Evaluation": "evaluation",
    "Policy": "policy",
    "PolicyCheckError": "errors",
    "PolicyState": "policy",
    "Record": "metrics",
    "Results": "comparison",
    "ResultsError": "errors",
    "Suite": "suite",
    "check_policy": "conformance",
    "estimate": "metrics",
    "evaluate": "evaluation",
    "load_suite": "suite",
    "make_policy": "policy",
    "measure": "metrics",
    "paired_difference": "metrics",
    "policy_options": "policy",
    "run_benchmark": "benchmark",
    "run_episodes": "rollout",
}

__all__ = [
    "Episode",
    "Estimate",
    "EstimateWrapper",
    "Evaluation",
    "Policy",
    "PolicyCheckError",
    "PolicyState",
    "Record",
    "Results",
    "ResultsError",
    "Suite",
    "check_policy",
    "estimate",
    "evaluate",
    "load_suite",
    "make_policy",
    "measure",
    "paired_difference",
    "policy_options",
    "run_benchmark",
    "run_episodes",
]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(import_module(f".{_PUBLIC[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
