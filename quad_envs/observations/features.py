"""Features: which entries of an observation a network sees, by name, and their scaling to order one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .team import AgentLayout
from .tracking import N_REFERENCE, TrackingLayout

# Preview stages that a network sees: near ones densely, the horizon of the MPCs at the end.
TRACKING_STAGES = (0, 1, 2, 3, 5, 7, 10, 14, 19, 25)
# Part -> argument of the environment that says how many rows it has, and by how much it exceeds the last row.
_ARGUMENTS = {"preview": ("preview", 0), "comm": ("neighbours", 1), "sensed": ("sensed", 1)}
PLACES = ("observation[0]",)  # how names of places begin, see `Features`
# Typical size of each part, so that a network sees numbers of order one.
_SCALES = {
    "V_B": 3.0,
    "phi_theta": 0.5,
    "sin_cos_psi": 1.0,
    "Omega": 3.0,
    "F": 2.0,
    "last_command": 2.0,
    "position": 2.0,
    "disturbance": 0.5,
    "role": 1.0,
    "slot": 2.0,
}
_ROW_SCALES = {
    "disturbance_estimate": (0.05, 0.05, 0.01, 1.0, 1.0, 1.0),
    "preview": (2.0, 2.0, 2.0, 3.0, 3.0, 3.0, 1.0, 1.0),
    "sensed": (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0),
    "measured": (1.0, 5.0, 1.0, 1.0, 1.0),
    "estimate": (1.0, 2.0, 2.0, 2.0, 1.0, 1.0, 1.0, *(1.0,) * 6),
    "comm": (10.0, 1.0, *(2.0,) * 3, *(1.0,) * 3, 0.5, 0.5, 1.0, 1.0, *(2.0,) * 3, *(2.0,) * 6),
}


@dataclass(frozen=True, slots=True)
class Features:
    """Which entries of an observation a network sees, and how they are scaled: (obs - mean) / scale.

    The entries are named, so that a network for 25 preview stages can fly where there are 30. Names
    "observation[0]", "observation[1]", ... are places: of these a network sees all, where there are as many.
    """

    names: tuple[str, ...]  # "V_B[0]", "preview[5][2]", ...: part, then index in the part
    mean: tuple[float, ...]
    scale: tuple[float, ...]
    clip: float | None = None  # largest size of what is scaled, as VecNormalize cuts it; None for none
    heading_axes: bool = False  # whether they are of the observation in `heading.HeadingAxes`

    def columns(self, layout: TrackingLayout | AgentLayout) -> NDArray[np.int64]:
        """Indices in an observation of this layout.

        Raises:
            ValueError: If the layout lacks an entry; the message names it.
        """
        if self.names[:1] == PLACES[:1]:
            if len(self.names) != layout.size:
                raise ValueError(
                    f"the network sees observations of {len(self.names)} numbers, here they have "
                    f"{layout.size}: evaluate it in a task with the layout it was trained on"
                )
            return np.arange(layout.size)
        known = {name: k for k, name in enumerate(entry_names(layout))}
        missing = [name for name in self.names if name not in known]
        if missing:
            raise ValueError(
                f"the network sees {missing[0]} (and {len(missing) - 1} more), which observations here "
                "lack: evaluate it in a task with the layout it was trained on "
                f"({_remedy(missing[0], self.names)})"
            )
        return np.array([known[name] for name in self.names], dtype=np.int64)


def _remedy(name: str, names: tuple[str, ...]) -> str:
    """How an environment comes to show an entry, where an argument says how many there are."""
    part = name.partition("[")[0]
    if part not in _ARGUMENTS:
        return "preview, limits, slots"
    argument, beyond = _ARGUMENTS[part]
    last = max(int(one.split("[")[1].rstrip("]")) for one in names if one.startswith(f"{part}["))
    return f"pass {argument}={last + beyond}, or more"


def part_shapes(layout: TrackingLayout | AgentLayout) -> dict[str, tuple[int, ...]]:
    """Name -> shape of the parts of an observation, in their order."""
    if isinstance(layout, AgentLayout):
        return layout.shapes
    sizes = {name: part.stop - part.start for name, part in layout.slices.items() if name != "own"}
    return {
        name: (size // N_REFERENCE, N_REFERENCE) if name == "preview" else (size,)
        for name, size in sizes.items()
    }


def entry_names(layout: TrackingLayout | AgentLayout) -> list[str]:
    """A name for each entry of an observation."""
    return [
        name + "".join(f"[{i}]" for i in index)
        for name, shape in part_shapes(layout).items()
        for index in np.ndindex(*shape)
    ]


def preview_stages(preview: int) -> tuple[int, ...]:
    """Stages of a preview that networks see."""
    return tuple(stage for stage in TRACKING_STAGES if stage <= preview)


def default_features(layout: TrackingLayout | AgentLayout, stages: tuple[int, ...] | None = None) -> Features:
    """Everything but some preview stages, scaled to order one.

    Args:
        layout: Of the task.
        stages: Preview stages to keep; None for `preview_stages`.
    """
    stages = preview_stages(layout.preview) if stages is None else stages
    names, scale = [], []
    for name, shape in part_shapes(layout).items():
        row = _ROW_SCALES.get(name, (_SCALES.get(name, 1.0),))
        for index in np.ndindex(*shape):
            if name == "preview" and index[0] not in stages:
                continue
            names.append(name + "".join(f"[{i}]" for i in index))
            scale.append(row[index[-1] % len(row)])
    mean = [1.96 if name.startswith(("F[", "last_command[")) else 0.0 for name in names]
    return Features(tuple(names), tuple(mean), tuple(scale))
