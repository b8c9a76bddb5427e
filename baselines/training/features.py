"""What networks in training see: everything that can differ from one observation of the task to another."""

from __future__ import annotations

from dataclasses import replace

from quad_envs.envs.team.options import TeamOptions
from quad_envs.envs.tracking.options import TrackingOptions
from quad_envs.graphs import in_neighbours
from quad_envs.names import shown
from quad_envs.observations.features import Features, default_features


def training_features(
    options: TrackingOptions | TeamOptions,
    stages: tuple[int, ...] | None = None,
    disturbance_estimate: bool = False,
    heading_axes: bool = False,
) -> Features:
    """The default features without comm slots that nobody fills in this task's graphs.

    Args:
        options: Of the task.
        stages: Preview stages to keep; None for the usual ones.
        disturbance_estimate: Whether the network sees an estimate of the disturbance, too.
        heading_axes: Whether it sees in axes turned to the heading of the reference.

    Raises:
        ValueError: If the preview has not these stages, or what is for one vehicle is asked for in a team.
    """
    layout = options.task.layout
    if stages is not None and not set(stages) <= set(range(layout.preview + 1)):
        raise ValueError(
            f"hyperparameter stages: the preview has stages 0 to {layout.preview}, got {shown(stages)}"
        )
    if not isinstance(options, TeamOptions):
        own = replace(options.task.layout, disturbance_estimate=disturbance_estimate)
        return replace(default_features(own, stages), heading_axes=heading_axes)
    require_plain(options, disturbance_estimate, heading_axes)
    features = default_features(layout, stages)
    used = in_neighbours(options.graphs.graphs).shape[1]
    empty = tuple(
        name
        for slot in range(used, options.task.layout.neighbours)
        for name in (f"comm[{slot}]", f"measured[{slot + 1}]", f"estimate[{slot + 1}]")
    )
    kept = [k for k, name in enumerate(features.names) if not name.startswith(empty)] if empty else None
    if kept is None:
        return features
    return replace(
        features,
        names=tuple(features.names[k] for k in kept),
        mean=tuple(features.mean[k] for k in kept),
        scale=tuple(features.scale[k] for k in kept),
    )


def require_plain(options: TeamOptions, disturbance_estimate: bool, heading_axes: bool) -> None:
    """Refuse in a team what is for one vehicle.

    Raises:
        ValueError: If one of them is asked for.
    """
    for name, asked in (("disturbance_estimate", disturbance_estimate), ("heading_axes", heading_axes)):
        if asked:
            raise ValueError(
                f"hyperparameter {name} is for one vehicle, and {options.env_id} has several: leave it out"
            )
