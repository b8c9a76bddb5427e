# The public names, once: type checkers read this file, and `__init__.py` loads by it.
from .errors import CheckpointError as CheckpointError
from .errors import PolicyCheckError as PolicyCheckError
from .errors import PolicyError as PolicyError
from .errors import ResultsError as ResultsError
from .errors import TrainingError as TrainingError
from .evaluation.columns import Record as Record
from .evaluation.evaluate import Evaluation as Evaluation
from .evaluation.metrics import Estimate as Estimate
from .evaluation.metrics import estimate as estimate
from .evaluation.metrics import measure as measure
from .evaluation.metrics import paired_difference as paired_difference
from .evaluation.rollout import Episode as Episode
from .evaluation.rollout import run_episodes as run_episodes
from .policies.conformance import check_policy as check_policy
from .policies.disturbance_wrappers import DisturbanceEstimateWrapper as DisturbanceEstimateWrapper
from .policies.disturbance_wrappers import (
    VectorDisturbanceEstimateWrapper as VectorDisturbanceEstimateWrapper,
)
from .policies.estimate_vector import EstimateVectorWrapper as EstimateVectorWrapper
from .policies.estimate_wrapper import EstimateWrapper as EstimateWrapper
from .policies.export import export_policy as export_policy
from .policies.protocol import Policy as Policy
from .policies.protocol import PolicyState as PolicyState
from .policies.registry import make_policy as make_policy
from .policies.registry import policy_options as policy_options
from .policies.registry import safe as safe
from .policies.sb3_policy import sb3 as sb3
from .policies.trained import load_policy as load_policy
from .policies.trained import shipped_policies as shipped_policies
from .report.benchmark import run_benchmark as run_benchmark
from .report.figures.episodes import plot_episode as plot_episode
from .report.single import evaluate as evaluate
from .sweeps.comparison import Results as Results
from .sweeps.suite import Suite as Suite
from .sweeps.suite_files import load_suite as load_suite
from .training.recording import Recorded as Recorded
from .training.recording import record as record
from .training.runs import TrainingResult as TrainingResult
from .training.runs import train as train
from .training.tuning import TuningResult as TuningResult
from .training.tuning import tune as tune
