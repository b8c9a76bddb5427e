"""What a user runs: policies, their evaluation, benchmarks. Names load at first use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from quad_envs.lazy import load_public, public_names

if TYPE_CHECKING:
    from .benchmark import run_benchmark
    from .comparison import Results
    from .conformance import check_policy
    from .errors import CheckpointError, PolicyCheckError, PolicyError, ResultsError, TrainingError
    from .estimate_wrapper import EstimateWrapper
    from .evaluation import Evaluation
    from .export import export_policy
    from .figures.episodes import plot_episode
    from .metrics import Estimate, Record, estimate, measure, paired_difference
    from .policy import Policy, PolicyState, make_policy, policy_options
    from .rollout import Episode, run_episodes
    from .sb3_policy import sb3
    from .single import evaluate
    from .suite import Suite
    from .suite_files import load_suite
    from .trained import load_policy, shipped_policies
    from .training.runs import TrainingResult, train

# Public name -> module; loaded at first use, so that importing the package stays cheap.
_PUBLIC = {
    "CheckpointError": "errors",
    "Episode": "rollout",
    "Estimate": "metrics",
    "EstimateWrapper": "estimate_wrapper",
    "Evaluation": "evaluation",
    "Policy": "policy",
    "PolicyCheckError": "errors",
    "PolicyError": "errors",
    "PolicyState": "policy",
    "Record": "metrics",
    "Results": "comparison",
    "ResultsError": "errors",
    "Suite": "suite",
    "TrainingError": "errors",
    "TrainingResult": "training.runs",
    "check_policy": "conformance",
    "estimate": "metrics",
    "evaluate": "single",
    "export_policy": "export",
    "load_policy": "trained",
    "load_suite": "suite_files",
    "make_policy": "policy",
    "measure": "metrics",
    "paired_difference": "metrics",
    "plot_episode": "figures.episodes",
    "policy_options": "policy",
    "run_benchmark": "benchmark",
    "run_episodes": "rollout",
    "sb3": "sb3_policy",
    "shipped_policies": "trained",
    "train": "training.runs",
}

__all__ = [
    "CheckpointError",
    "Episode",
    "Estimate",
    "EstimateWrapper",
    "Evaluation",
    "Policy",
    "PolicyCheckError",
    "PolicyError",
    "PolicyState",
    "Record",
    "Results",
    "ResultsError",
    "Suite",
    "TrainingError",
    "TrainingResult",
    "check_policy",
    "estimate",
    "evaluate",
    "export_policy",
    "load_policy",
    "load_suite",
    "make_policy",
    "measure",
    "paired_difference",
    "plot_episode",
    "policy_options",
    "run_benchmark",
    "run_episodes",
    "sb3",
    "shipped_policies",
    "train",
]


def __getattr__(name: str) -> Any:
    return load_public(__name__, _PUBLIC, name)


def __dir__() -> list[str]:
    return public_names(globals())
