"""What a user runs: policies, their evaluation, benchmarks. Names load at first use."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .benchmark import run_benchmark
    from .errors import CheckpointError, PolicyCheckError, PolicyError, ResultsError, TrainingError
    from .evaluation.columns import Record
    from .evaluation.evaluate import Evaluation
    from .evaluation.metrics import Estimate, estimate, measure, paired_difference
    from .evaluation.rollout import Episode, run_episodes
    from .policies.conformance import check_policy
    from .policies.estimate_wrapper import EstimateWrapper
    from .policies.export import export_policy
    from .policies.protocol import Policy, PolicyState
    from .policies.registry import make_policy, policy_options
    from .policies.sb3_policy import sb3
    from .policies.trained import load_policy, shipped_policies
    from .report.figures.episodes import plot_episode
    from .single import evaluate
    from .sweeps.comparison import Results
    from .sweeps.suite import Suite
    from .sweeps.suite_files import load_suite
    from .training.runs import TrainingResult, train

# Public name -> module; loaded at first use, so that importing the package stays cheap.
_PUBLIC = {
    "CheckpointError": "errors",
    "Episode": "evaluation.rollout",
    "Estimate": "evaluation.metrics",
    "EstimateWrapper": "policies.estimate_wrapper",
    "Evaluation": "evaluation.evaluate",
    "Policy": "policies.protocol",
    "PolicyCheckError": "errors",
    "PolicyError": "errors",
    "PolicyState": "policies.protocol",
    "Record": "evaluation.columns",
    "Results": "sweeps.comparison",
    "ResultsError": "errors",
    "Suite": "sweeps.suite",
    "TrainingError": "errors",
    "TrainingResult": "training.runs",
    "check_policy": "policies.conformance",
    "estimate": "evaluation.metrics",
    "evaluate": "single",
    "export_policy": "policies.export",
    "load_policy": "policies.trained",
    "load_suite": "sweeps.suite_files",
    "make_policy": "policies.registry",
    "measure": "evaluation.metrics",
    "paired_difference": "evaluation.metrics",
    "plot_episode": "report.figures.episodes",
    "policy_options": "policies.registry",
    "run_benchmark": "benchmark",
    "run_episodes": "evaluation.rollout",
    "sb3": "policies.sb3_policy",
    "shipped_policies": "policies.trained",
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
    from quad_envs.lazy import (
        load_public,  # not before: it loads Gymnasium, and `quad-envs --help` has to be quick
    )

    return load_public(__name__, _PUBLIC, name)


def __dir__() -> list[str]:
    from quad_envs.lazy import public_names

    return public_names(globals())
