"""What a benchmark trains or tunes: what is finished is taken, what was interrupted goes on, others begin."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from ..errors import CheckpointError
from ..training.algorithms import resumable
from ..training.plans import Plan, make_plan, read_start
from ..training.request import TrainingRequest
from ..training.runs import TrainingResult, run_training
from ..training.tuning import TuningRequest, check_tuning, run_tuning, tuning_begun
from .choices import Training, Tuning
from .units import TrainingUnit


def check_unit(unit: TrainingUnit) -> None:
    """Check what a unit is to make.

    Raises:
        ValueError: If it cannot be trained or tuned.
        MissingPackageError: If what the algorithm needs is not installed.
    """
    if isinstance(unit.made, Tuning):
        check_tuning(_tuning(unit, unit.made))
    else:
        training_plan(unit)


def training_plan(unit: TrainingUnit) -> Plan:
    """What a unit is to train.

    Raises:
        ValueError: If it cannot be trained.
        MissingPackageError: If what the algorithm needs is not installed.
    """
    return make_plan(_request(unit))


def _request(unit: TrainingUnit) -> TrainingRequest:
    said = unit.made
    assert isinstance(said, Training)
    return TrainingRequest(
        unit.env.id,
        unit.policy.name,
        seed=said.seed,
        seconds=said.seconds,
        steps=said.steps,
        out=unit.folder,
        env_kwargs=unit.env_kwargs,
        hyper=said.hyper,
        start_from=said.start_from or None,
    )


def _tuning(unit: TrainingUnit, said: Tuning) -> TuningRequest:
    return TuningRequest(
        unit.env.id,
        unit.policy.name,
        objective=said.objective,  # type: ignore[arg-type]  # which it checks
        seed=said.seed,
        seconds=said.seconds,
        episodes=said.episodes,
        fields=said.fields,
        out=unit.folder,
        env_kwargs=unit.env_kwargs,
        options=unit.policy.kwargs,
    )


def train_unit(unit: TrainingUnit) -> dict[str, Any]:
    """Train or tune a policy, unless its folder holds it already; its cost and its curve, as plain values.

    Raises:
        ResultsError: If the folder holds another training.
        TrainingError: If training diverges, or no candidate of a tuning stays in the air.
    """
    if isinstance(unit.made, Tuning):
        request = _tuning(unit, unit.made)
        return run_tuning(replace(request, resume=tuning_begun(unit.folder))).to_dict()
    plan = training_plan(unit)
    found = _finished(unit, plan)
    if found is None:
        go_on = (unit.folder / "last").is_dir() and resumable(plan.algorithm)
        fresh = (unit.folder / "config.json").exists() and not go_on
        found = run_training(replace(_request(unit), resume=go_on, fresh=fresh))
    return found.to_dict()


def begun(unit: TrainingUnit) -> bool:
    """Whether its folder holds something to go on with."""
    return (unit.folder / "config.json").exists()


def train_elsewhere(unit: TrainingUnit) -> dict[str, Any]:
    """`train_unit` on a machine that has not the folder, from the beginning.

    Returns:
        "training", as `train_unit` gives it, and "files", the content of the folder by relative names.
    """
    with TemporaryDirectory() as home:
        folder = Path(home, unit.folder.name)
        training = train_unit(unit._replace(folder=folder)) | {"folder": str(unit.folder)}
        paths = [path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".")]
        files = {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}
    return {"training": training, "files": files}


def _finished(unit: TrainingUnit, plan: Plan) -> TrainingResult | None:
    """The result that the folder holds; None if there is no run, or an unfinished one."""
    if not (unit.folder / "config.json").exists():
        return None
    try:
        start = read_start(plan.folder(unit.folder))
    except CheckpointError:
        return None  # interrupted before its first policy
    if plan.budget.share(start.seconds, start.steps) < 1.0 or start.best is None:
        return None
    return TrainingResult(unit.folder, plan.env_id, plan.algorithm, plan.seed, start.best, start.curve)
