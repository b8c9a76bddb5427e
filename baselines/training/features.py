"""What networks in training see: everything that can differ from one observation of the task to another.

Of a target they see what their own filter believes, as `cooperative-mpc` does, in place of measurements.
"""

from __future__ import annotations

from dataclasses import replace

from quad_envs.arguments.names import shown
from quad_envs.envs.team.options import TeamOptions
from quad_envs.envs.tracking.options import TrackingOptions
from quad_envs.graphs import in_neighbours
from quad_envs.observations.features import Features, default_features
from quad_envs.observations.team import AgentLayout
from quad_envs.tasks import Task, TeamTask

from ..policies.target_estimate import with_target_estimate


def training_task(options: TrackingOptions | TeamOptions) -> Task | TeamTask:
    """The task as networks in training see it: with estimates where there is a target to follow."""
    task = options.task
    if not isinstance(task, TeamTask) or task.mission != "target-tracking":
        return task
    return with_target_estimate(task)


def require_measured(options: TeamOptions) -> None:
    """Check that somebody measures the target, if there is one.

    Raises:
        ValueError: If nobody does.
    """
    if options.task.layout.target and not options.informed():
        raise ValueError(
            f"nobody measures the target of {options.env_id}, so that no estimate of it ever becomes valid: "
            "let somebody measure (measuring=, detection=)"
        )


def training_features(
    options: TrackingOptions | TeamOptions,
    stages: tuple[int, ...] | None = None,
    disturbance_estimate: bool = False,
    heading_axes: bool = False,
) -> Features:
    """The default features of `training_task` without slots that nobody fills in its graphs, or measurements.

    Args:
        options: Of the task.
        stages: Preview stages to keep; None for the usual ones.
        disturbance_estimate: Whether the network sees an estimate of the disturbance, too.
        heading_axes: Whether it sees in axes turned to the heading of the reference.

    Raises:
        ValueError: If the preview has not these stages, or what is for one vehicle is asked for in a team.
    """
    layout = training_task(options).layout
    if stages is not None and not set(stages) <= set(range(layout.preview + 1)):
        raise ValueError(
            f"hyperparameter stages: the preview has stages 0 to {layout.preview}, got {shown(stages)}"
        )
    layout = replace(layout, disturbance_estimate=disturbance_estimate)
    if not isinstance(options, TeamOptions):
        return replace(default_features(layout, stages), heading_axes=heading_axes)
    require_own_axes(options, heading_axes)
    features = default_features(layout, stages)
    used = in_neighbours(options.graphs.graphs).shape[1]
    empty = tuple(
        name
        for slot in range(used, options.task.layout.neighbours)
        for name in (f"comm[{slot}]", f"measured[{slot + 1}]")
    )
    if isinstance(layout, AgentLayout) and layout.estimate:
        told = (f"estimate[{slot + 1}]" for slot in range(layout.neighbours))
        empty = (*empty, "measured[", *told, "estimate[0][0]")
    if not empty:
        return features
    kept = [k for k, name in enumerate(features.names) if not name.startswith(empty)]
    return replace(
        features,
        names=tuple(features.names[k] for k in kept),
        mean=tuple(features.mean[k] for k in kept),
        scale=tuple(features.scale[k] for k in kept),
    )


def require_own_axes(options: TeamOptions, heading_axes: bool) -> None:
    """Refuse in a team the axes that are for one vehicle.

    Raises:
        ValueError: If they are asked for.
    """
    if heading_axes:
        raise ValueError(
            f"hyperparameter heading_axes is for one vehicle, and {options.env_id} has several: leave it out"
        )
