"""`plot_episode`: a flight, or several on top of each other, as a figure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from quad_envs.parameters import POSITION, Array

from ...evaluation.episode import Episode
from .style import COLOURS, CYCLE, house_style, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ERROR_FLOOR = 1e-4  # m, below which the logarithmic axis need not go


@house_style()
def plot_episode(*episodes: Episode, labels: Sequence[str] = ()) -> Figure:
    """Draw flights: seen from above and over time, with error, forces, reward and limits.

    Several flights, of one start by other policies or of the vehicles of a team, are drawn over each other.

    Args:
        episodes: One or more, from `run_episodes` or `evaluate(..., on_episode=...)`.
        labels: Of each, for the legend; agents of a team are named by themselves.

    Returns:
        A figure of matplotlib, as `figure.savefig("flight.png")`.

    Raises:
        ValueError: If there is no flight, the labels are not as many, or plants are not shown.
        MissingPackageError: If matplotlib is not installed; the message names the extra.
    """
    if not episodes:
        raise ValueError("plot_episode needs a flight, as next(run_episodes(policy, env, 1))")
    names = list(labels) or [episode.agent for episode in episodes]
    if len(names) != len(episodes):
        raise ValueError(f"plot_episode needs a label for each of {len(episodes)} flights, got {len(names)}")
    if any(episode.states.shape[1] == 0 for episode in episodes):
        raise ValueError("plot_episode needs flights of an environment of this suite, whose plants are known")
    figure, axes = new_figure(3, 2, height=1.0)
    draws: tuple[Callable[[Any, Episode, dict[str, Any]], None], ...] = (
        _above,
        _height,
        _error,
        _forces,
        _reward,
        _limits,
    )
    for k, (episode, name) in enumerate(zip(episodes, names, strict=True)):
        style = {"color": COLOURS[CYCLE[k % len(CYCLE)]], "label": name or None}
        for ax, draw in zip(axes.flat, draws, strict=True):
            draw(ax, episode, style)
    _finish(axes, episodes[0], any(names))
    return figure


def _finish(axes: Any, first: Episode, legend: bool) -> None:
    """Titles, axes, and what is the same for all flights."""
    titles = (
        ("from above, m", "y (east)", "x (north)"),
        ("height, m", "t, s", "-z"),
        ("distance to the reference, m", "t, s", ""),
        ("commanded rotor forces, N", "t, s", ""),
        ("reward", "t, s", ""),
        ("limits: value minus limit, SI", "t, s", ""),
    )
    for ax, (title, x, y) in zip(axes.flat, titles, strict=True):
        ax.set_title(title)
        ax.set_xlabel(x)
        ax.set_ylabel(y)
    axes[0, 0].set_aspect("equal", adjustable="datalim")
    axes[1, 0].set_yscale("log")
    for force in (0.0, float(np.max(first.task.force_max))):
        axes[1, 1].axhline(force, color=COLOURS["faint"], linestyle=":")
    axes[2, 1].axhline(0.0, color=COLOURS["red"], linestyle=":")
    if legend:
        axes[0, 0].legend()


def _times(episode: Episode, rows: int) -> Array:
    return np.arange(float(rows)) * float(episode.task.dt)


def _reference(episode: Episode) -> Array | None:
    """Positions wanted, (T+1, 3), if there are as many as flown ones."""
    return episode.references[:, POSITION] if len(episode.references) == len(episode.states) else None


def _above(ax: Any, episode: Episode, style: dict[str, Any]) -> None:
    wanted, p = _reference(episode), episode.states[:, POSITION]
    if wanted is not None:
        ax.plot(wanted[:, 1], wanted[:, 0], color=COLOURS["faint"], linestyle="--")
    ax.plot(p[:, 1], p[:, 0], **style)
    if episode.crashed:
        ax.plot(p[-1, 1], p[-1, 0], marker="x", color=COLOURS["red"])


def _height(ax: Any, episode: Episode, style: dict[str, Any]) -> None:
    wanted, p = _reference(episode), episode.states[:, POSITION]
    if wanted is not None:
        ax.plot(_times(episode, len(wanted)), -wanted[:, 2], color=COLOURS["faint"], linestyle="--")
    ax.plot(_times(episode, len(p)), -p[:, 2], **style)


def _error(ax: Any, episode: Episode, style: dict[str, Any]) -> None:
    wanted = _reference(episode)
    if wanted is not None:
        error = np.linalg.norm(episode.states[:, POSITION] - wanted, axis=1)
        ax.plot(_times(episode, len(error)), np.maximum(error, _ERROR_FLOOR), **style)


def _forces(ax: Any, episode: Episode, style: dict[str, Any]) -> None:
    ax.step(_times(episode, len(episode.commands)), episode.commands, where="post", linewidth=0.7, **style)


def _reward(ax: Any, episode: Episode, style: dict[str, Any]) -> None:
    ax.step(_times(episode, len(episode.rewards)), episode.rewards, where="post", **style)


def _limits(ax: Any, episode: Episode, style: dict[str, Any]) -> None:
    values = episode.constraint_values
    if values.shape[1]:
        ax.plot(_times(episode, len(values)), values, linewidth=0.7, **style)
    else:
        ax.text(0.5, 0.5, "the task has none", transform=ax.transAxes, ha="center", color=COLOURS["faint"])
