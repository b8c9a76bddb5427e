"""Flights as a Minari dataset, from which others learn without flying.

A dataset lies where Minari looks (`MINARI_DATASETS_PATH`, else `~/.minari/datasets`), and holds what Minari's
own collector would: T+1 observations and infos of an episode, T actions, rewards and ends. `infos["cost"]`
is the constraint signal; its first entry is that of the reset.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

import quad_envs
from quad_envs.arguments.checks import Bound, require_number
from quad_envs.arguments.extras import install_command
from quad_envs.arguments.names import shown

from ..errors import MissingPackageError
from ..evaluation.rollout import check_flights, run_episodes
from ..policies.outside import is_policy
from ..policies.protocol import Policy
from ..policies.registry import make_policy, policy_name

Source = str | os.PathLike[str] | Policy
_UNFINISHED = ".recording-"  # a hidden folder, which Minari does not list
_ABANDONED = 86400.0  # s, after which one of those belongs to nobody


class Recorded(NamedTuple):
    """What `record` wrote."""

    dataset: str  # its name
    folder: Path
    episodes: int
    steps: int
    score: float  # summed reward / steps of the full time limit, mean of the episodes
    cost: float  # constraint signal, summed over an episode, mean of the episodes


class _Pilot(NamedTuple):
    """Who flies a part of a dataset."""

    name: str
    policy: Policy
    noise: float  # standard deviation of what is added to each action


class _Tape(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Keeps all that an environment says in an episode, and disturbs actions by noise."""

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.noise = 0.0  # standard deviation of what is added to each action
        self._rng = np.random.default_rng(0)
        self.rows: list[tuple[Any, ...]] = []  # action, reward, terminated, truncated
        self.observations: list[NDArray[Any]] = []
        self.infos: list[dict[str, Any]] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; its noise follows from its seed."""
        self._rng = np.random.default_rng(seed)
        observation, info = self.env.reset(seed=seed, options=options)
        self.rows, self.observations, self.infos = [], [observation], [info]
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Fly one step, with the noise."""
        if self.noise > 0.0:
            noisy = action + self.noise * self._rng.standard_normal(np.shape(action))
            action = np.clip(noisy, -1.0, 1.0).astype(np.float32)
        observation, reward, terminated, truncated, info = self.env.step(action)
        flown = np.clip(action, -1.0, 1.0).astype(np.float32)  # the environment clips, too
        self.rows.append((flown, float(reward), terminated, truncated))
        self.observations.append(observation)
        self.infos.append(info)
        return observation, reward, terminated, truncated, info

    def episode(self, seed: int) -> dict[str, Any]:
        """The episode that has ended, as the fields of Minari's `EpisodeBuffer`."""
        actions, rewards, terminations, truncations = zip(*self.rows, strict=True)
        kept = [key for key in self.infos[0] if all(key in info for info in self.infos)]
        return {
            "seed": seed,
            "observations": np.stack(self.observations),
            "actions": np.stack(actions),
            "rewards": np.array(rewards),
            "terminations": np.array(terminations),
            "truncations": np.array(truncations),
            "infos": {key: np.array([info[key] for info in self.infos]) for key in kept},
        }


def record(
    env: Any,
    policies: Source | Sequence[Source],
    dataset: str,
    *,
    episodes: int = 50,
    seed: int = 0,
    noise: float | Sequence[float] = 0.0,
    on_episode: Callable[[int], None] | None = None,
) -> Recorded:
    """Fly episodes and leave them as a Minari dataset, whole or not at all.

    Args:
        env: A single environment of this suite (`gymnasium.make`), whose arguments JSON can hold.
        policies: A policy or whatever `make_policy` takes, or several, which fly one after the other: a
            mixed dataset.
        dataset: Minari's name for it, as "quad/corridor/expert-v0".
        episodes: Of each policy.
        seed: Of the first episode; episode k starts from `seed + k`, as in `evaluate`.
        noise: Standard deviation of a normal number added to each action, whose box is -1 to 1; of all
            policies, or one number for each.
        on_episode: Called after each episode with the number of those flown.

    Raises:
        MissingPackageError: If Minari is not installed.
        ValueError: If there is a dataset of that name, the name is none, the environment is of several
            vehicles or a vector, or holds what JSON cannot, or as `run_episodes` says.
    """
    _require_minari()
    _require_single(env)
    pilots = _pilots(policies, env, noise)
    for pilot in pilots:
        check_flights(pilot.policy, env, episodes, seed, False)
    said = ", ".join(f"{pilot.name}{f' with noise {pilot.noise:g}' * (pilot.noise > 0)}" for pilot in pilots)
    about = {
        "dataset_id": dataset,
        "algorithm_name": said,
        "description": f"{env.spec.id}: {episodes} episodes by each of {said}, from seed {seed}",
        "quad_envs_version": quad_envs.__version__,
        "ref_min_score": 0.0,  # of a return: Minari's normalized score is the score of every table here
        "ref_max_score": float(env.unwrapped.task.episode_steps),
    }
    tape, count, sums = _Tape(env), 0, []
    with _new_dataset(dataset, env, about) as (storage, keep):
        for pilot in pilots:
            tape.noise = pilot.noise
            for episode in run_episodes(pilot.policy, tape, episodes, seed + count):
                buffer = tape.episode(episode.seed)
                total, cost = float(buffer["rewards"].sum()), float(buffer["infos"]["cost"][1:].sum())
                told = {"policy": pilot.name, "noise": pilot.noise, "rewards_sum": total, "costs_sum": cost}
                keep(buffer, told)
                sums.append((total / episode.task.episode_steps, cost))
                count += 1
                if on_episode is not None:
                    on_episode(count)
        steps = int(storage.total_steps)
    score, cost = np.mean(sums, axis=0).tolist()
    return Recorded(dataset, _folder(dataset), count, steps, score, cost)


def _require_single(env: Any) -> None:
    """Raises ValueError if it is no single environment of Gymnasium."""
    if isinstance(env, gymnasium.Env) and env.spec is not None:
        return
    task = getattr(getattr(env, "unwrapped", None), "task", None)
    given = shown(env) if task is None else f"{task.env_id}, {type(env).__name__}"
    raise ValueError(
        f"Minari's datasets are of a single Gymnasium environment, got {given}; flights of a team "
        "are kept by quad-envs evaluate --out FOLDER --save-episodes"
    )


def _pilots(policies: Source | Sequence[Source], env: Any, noise: float | Sequence[float]) -> list[_Pilot]:
    """Who flies.

    Raises:
        ValueError: If nobody does, a policy is unknown, or as `_one_each` says.
    """
    one = isinstance(policies, str | os.PathLike) or is_policy(policies)
    given: list[Any] = [policies] if one else list(policies)  # type: ignore[arg-type]
    if not given:
        raise ValueError("no policy is named that flies")
    made = [source if is_policy(source) else make_policy(source, env) for source in given]
    names = [
        policy_name(policy, str(source) if isinstance(source, str | os.PathLike) else "")
        for policy, source in zip(made, given, strict=True)
    ]
    return list(map(_Pilot, names, made, _one_each(noise, len(made))))


def _one_each(noise: float | Sequence[float], count: int) -> list[float]:
    """Noise of each policy.

    Raises:
        ValueError: If it is no number that means something, or there are as many as neither one nor policies.
    """
    given = list(noise) if isinstance(noise, Sequence) else [noise]
    for number in given:
        require_number("noise", number, Bound(most=2.0, why="actions lie between -1 and 1"))
    if len(given) not in (1, count):
        raise ValueError(
            f"noise is one number for all policies, or one for each of {count}, got {len(given)}"
        )
    return [float(number) for number in (given if len(given) == count else given * count)]


def _require_minari() -> None:
    try:
        import h5py  # noqa: F401
        import minari  # noqa: F401
    except ImportError as error:
        raise MissingPackageError(
            f"recording a dataset needs {error.name}: {install_command('minari')}"
        ) from error


def _folder(dataset: str) -> Path:
    """Where a dataset is or goes.

    Raises:
        ValueError: If the name is none.
    """
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.storage import get_dataset_path

    try:
        parse_dataset_id(dataset)
    except (ValueError, TypeError):
        raise ValueError(
            f"{shown(dataset)} is no name of a Minari dataset: folders and a name that ends with a version, "
            "as quad/corridor/expert-v0, of letters, digits, - and _"
        ) from None
    return Path(get_dataset_path(dataset))


Keep = Callable[[Mapping[str, Any], Mapping[str, Any]], None]


@contextmanager
def _new_dataset(dataset: str, env: Any, about: Mapping[str, Any]) -> Iterator[tuple[Any, Keep]]:
    """Storage of a dataset that appears under its name at the end, if nothing went wrong until then.

    Raises:
        ValueError: If the name is taken, or JSON cannot hold an argument of the environment.
    """
    from minari import __version__
    from minari.data_collector.episode_buffer import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    final = _folder(dataset)
    _require_free(dataset, final)
    env.spec.to_json()  # refuses what cannot be written before anything is flown
    root = Path(*final.parts[: len(final.parts) - len(Path(dataset).parts)])
    root.mkdir(parents=True, exist_ok=True)
    _sweep(root)
    unfinished = Path(tempfile.mkdtemp(prefix=_UNFINISHED, dir=root))
    try:
        storage = MinariStorage.new(
            unfinished / "data",
            observation_space=env.observation_space,
            action_space=env.action_space,
            env_spec=env.spec,
        )
        storage.update_metadata({**about, "minari_version": __version__})

        def keep(buffer: Mapping[str, Any], said: Mapping[str, Any]) -> None:
            place = storage.total_episodes
            storage.update_episodes([EpisodeBuffer(**buffer)])
            storage.update_episode_metadata([dict(said)], [place])

        yield storage, keep
        unfinished.chmod(0o755)
        _publish(unfinished, dataset, final)
    except BaseException:
        shutil.rmtree(unfinished, ignore_errors=True)
        raise


def _require_free(dataset: str, final: Path) -> None:
    """Raises ValueError if there is something under a dataset's name, or above it a dataset."""
    if final.exists():
        raise ValueError(
            f"there is a Minari dataset {dataset!r} in {str(final)!r}: choose another name or version, as "
            f"{dataset.rpartition('-v')[0]}-v{int(dataset.rpartition('-v')[2]) + 1}, or delete it first: "
            f"minari delete {dataset}"
        )
    above = final.parent
    for name in reversed(dataset.split("/")[:-1]):
        if (above / "data").exists():
            raise ValueError(f"{name!r} in {dataset!r} is a Minari dataset itself: choose another folder")
        above = above.parent


def _publish(unfinished: Path, dataset: str, final: Path) -> None:
    """Give a finished dataset its name, which is one renaming, and Minari's namespaces around it."""
    from minari.namespace import create_namespace, list_local_namespaces

    namespace = dataset.rpartition("/")[0]
    if namespace and namespace not in list_local_namespaces():
        create_namespace(namespace)
    final.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.rename(unfinished, final)
    except OSError:  # somebody took the name meanwhile
        _require_free(dataset, final)
        raise


def _sweep(root: Path) -> None:
    """Delete what recordings that were killed left long ago."""
    for path in root.glob(f"{_UNFINISHED}*"):
        with suppress(OSError):
            if path.stat().st_mtime < time.time() - _ABANDONED:
                shutil.rmtree(path, ignore_errors=True)
