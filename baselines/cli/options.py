"""Options of the commands: typed dataclasses, from which argparse's arguments are made."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, NoReturn, TypeAlias, TypeVar, get_args, get_type_hints

from .values import read_value

Options = TypeVar("Options")


def _whole(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a whole number, got {text[:80]!r}") from None


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be a number, got {text[:80]!r}") from None


def _path(text: str) -> Path:
    if not text.strip():
        raise argparse.ArgumentTypeError(
            "must name a file or folder, got nothing; . is the folder you are in"
        )
    return Path(text)


# What an option is read as; the others are text.
_KINDS: dict[Any, Callable[[str], Any]] = {
    int: _whole,
    int | None: _whole,
    float | None: _number,
    Path: _path,
    Path | None: _path,
}


# What an option that may be repeated takes, where that is no name.
_REPEATED = {"set": "KEY=VALUE", "policy_set": "KEY=VALUE", "hyper": "KEY=VALUE", "noise": "X"}


class Positional(str):
    """Help text of an argument without a flag; the help text of a flag is a plain string."""


# What several commands take.
EnvArguments: TypeAlias = Annotated[
    list[str], "keyword argument of the environment; JSON, {key: value}, or text"
]
PolicyOptions: TypeAlias = Annotated[list[str], "option of the policy; JSON, {key: value}, or text"]
Json: TypeAlias = Annotated[bool, "print JSON"]
SaveEpisodes: TypeAlias = Annotated[bool, "save every flight, not only the first two of the report"]
ResultsFolder: TypeAlias = Annotated[Path, Positional("results folder of evaluate or benchmark")]


@dataclass(frozen=True, slots=True)
class ListOptions:
    """What there is: environments, policies, suites."""

    name: Annotated[
        str,
        Positional(
            "environment, policy or training algorithm, to see its options; or a vehicle, a trained policy, "
            "a suite or a column of the tables, or `columns`, to see what it is"
        ),
    ] = ""
    json: Json = False


@dataclass(frozen=True, slots=True)
class EvaluateOptions:
    """Fly one policy in one environment."""

    env: Annotated[str, Positional("environment id, as quad/HelixTracking-v0 or quad/Formation-v0")]
    policy: Annotated[
        str,
        Positional(
            "policy, as sdc-nmpc, the folder of a trained one, or module:factory of your own; safe:NAME puts "
            "a safety filter in front"
        ),
    ]
    episodes: Annotated[int, "number of flights"] = 20
    seed: Annotated[int, "environment seed of the first flight"] = 0
    set: EnvArguments = field(default_factory=list)
    policy_set: PolicyOptions = field(default_factory=list)
    json: Json = False
    out: Annotated[Path | None, "results folder"] = None
    fresh: Annotated[bool, "discard what the results folder holds of an earlier run"] = False
    save_episodes: SaveEpisodes = False


@dataclass(frozen=True, slots=True)
class BenchmarkOptions:
    """Fly a suite: environments x policies, from the same starts."""

    suite: Annotated[str, Positional("name of a shipped suite, or a .toml file")] = "default"
    policy: Annotated[
        list[str], "policy that flies, too, as module:factory of your own; several if repeated"
    ] = field(default_factory=list)
    out: Annotated[Path | None, "results folder; runs/SUITE-DATE-TIME if not given"] = None
    episodes: Annotated[int | None, "flights per environment and policy, instead of the suite's"] = None
    seed: Annotated[int | None, "environment seed of the first flight, instead of the suite's"] = None
    engine: Annotated[str, "who runs units: processes, ray, dask, or folder, which workers join"] = (
        "processes"
    )
    jobs: Annotated[int | None, "units flown at a time; 1, or all that a cluster has, if not given"] = None
    fresh: Annotated[bool, "discard what the folder holds of an earlier run, but for networks"] = False
    networks: Annotated[
        Path | None, "where networks and tuned policies that the suite makes are or go; OUT/networks"
    ] = None
    only: Annotated[
        list[str],
        "part of the suite: tracking, teams, an environment, a condition or a table; several if repeated",
    ] = field(default_factory=list)
    quick: Annotated[bool, "a small part of the suite, to see it work"] = False
    json: Json = False
    save_episodes: SaveEpisodes = False


@dataclass(frozen=True, slots=True)
class TrainOptions:
    """Train a network, judge it while it learns, and leave it as a checkpoint."""

    env: Annotated[str, Positional("environment id, as quad/HelixTracking-v0")]
    algorithm: Annotated[str, Positional("apg, dagger, mappo, ppo, ppo-lagrangian or sac")]
    seed: Annotated[int, "of everything random"] = 0
    seconds: Annotated[float | None, "budget in CPU-seconds; the algorithm's own if not given"] = None
    steps: Annotated[int | None, "budget in environment steps instead"] = None
    out: Annotated[Path | None, "folder; runs/ALGORITHM-TASK-SEED if not given"] = None
    set: EnvArguments = field(default_factory=list)
    hyper: Annotated[list[str], "hyperparameter, as in quad-envs list ALGORITHM; JSON, or text"] = field(
        default_factory=list
    )
    from_: Annotated[str, "begin with the network of a checkpoint: its folder, or a shipped policy"] = ""
    resume: Annotated[bool, "go on with the run in the folder: its weights, counters and curve"] = False
    fresh: Annotated[bool, "discard the run that is in the folder"] = False
    json: Json = False


@dataclass(frozen=True, slots=True)
class TuneOptions:
    """Tune the options of a controller, as its weights, for the score or the cost."""

    env: Annotated[str, Positional("environment id, as quad/HelixTracking-v0")]
    policy: Annotated[str, Positional("lmpc, sdc-nmpc, nmpc, score-nmpc or another with weights")]
    objective: Annotated[str, "score or quadratic_cost"] = "score"
    seed: Annotated[int, "of the search"] = 0
    seconds: Annotated[float | None, "budget in CPU-seconds; 60 if not given"] = None
    episodes: Annotated[int | None, "budget in episodes instead"] = None
    tuned: Annotated[list[str], "option to tune; all that mean something if none is given"] = field(
        default_factory=list
    )
    out: Annotated[Path | None, "folder; runs/tuned-POLICY-TASK-SEED if not given"] = None
    set: EnvArguments = field(default_factory=list)
    policy_set: PolicyOptions = field(default_factory=list)
    resume: Annotated[bool, "go on with the search in the folder"] = False
    fresh: Annotated[bool, "discard the search that is in the folder"] = False
    json: Json = False


@dataclass(frozen=True, slots=True)
class RecordOptions:
    """Fly, and leave the flights as a Minari dataset for offline learning."""

    env: Annotated[str, Positional("environment id of one vehicle, as quad/CorridorTracking-v0")]
    policy: Annotated[
        list[str],
        Positional("policy, as nmpc, or several, which fly one after the other: a mixed dataset"),
    ] = field(default_factory=list)
    minari: Annotated[str, "of the dataset, as quad/corridor/expert-v0"] = ""
    episodes: Annotated[int, "flights of each policy"] = 50
    seed: Annotated[int, "environment seed of the first flight"] = 0
    noise: Annotated[
        list[str],
        "standard deviation of noise on actions in -1 to 1; repeated, one for each policy",
    ] = field(default_factory=list)
    set: EnvArguments = field(default_factory=list)
    policy_set: PolicyOptions = field(default_factory=list)
    json: Json = False


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """Make a checkpoint of a model of Stable-Baselines3: layers alone, which run no code."""

    model: Annotated[
        Path, Positional("zip that model.save of Stable-Baselines3 wrote: PPO, A2C, SAC, TD3, DDPG")
    ]
    folder: Annotated[Path, Positional("of the checkpoint")]
    vecnormalize: Annotated[Path | None, "file of VecNormalize.save, if it was trained with it"] = None
    env: Annotated[str, "environment it was trained in, so that what it sees is known by name"] = ""
    set: EnvArguments = field(default_factory=list)
    fresh: Annotated[bool, "replace the checkpoint that is in the folder"] = False


@dataclass(frozen=True, slots=True)
class ReproduceOptions:
    """Tables and claims of the dissertation beside our numbers."""

    what: Annotated[list[str], Positional("as table-4.1, claims-4; everything if none is named")] = field(
        default_factory=list
    )
    jobs: Annotated[int, "processes"] = 1
    json: Json = False
    out: Annotated[Path | None, "folder; sections that are there are read, and not flown again"] = None
    fresh: Annotated[bool, "discard the sections that the folder holds"] = False


@dataclass(frozen=True, slots=True)
class ReportOptions:
    """Make the page of a results folder again: leaderboard and flights in one file."""

    run: ResultsFolder
    out: Annotated[Path | None, "file of the page; RUN/report.html if not given"] = None


@dataclass(frozen=True, slots=True)
class ReplayOptions:
    """Open one flight of a results folder in the browser."""

    run: ResultsFolder
    env: Annotated[str, "environment, its id or its label in the suite; the first if not given"] = ""
    policy: Annotated[str, "policy that is shown; the best and the base if not given"] = ""
    seed: Annotated[int | None, "environment seed of the flight; the first saved one if not given"] = None
    out: Annotated[Path | None, "file of the page; RUN/replay.html if not given"] = None


@dataclass(frozen=True, slots=True)
class CertifyOptions:
    """What the stability theory of chapter 9 says of a policy, and what not."""

    env: Annotated[str, Positional("environment id of one vehicle, as quad/HelixTracking-v0")]
    policy: Annotated[str, Positional("lmpc, sdc-nmpc, sdre, lqr or nmpc")]
    seed: Annotated[int, "of the flight and of the random starts"] = 0
    starts: Annotated[int, "random starts in each invariant ellipsoid"] = 100
    set: EnvArguments = field(default_factory=list)
    policy_set: PolicyOptions = field(default_factory=list)
    json: Json = False
    out: Annotated[Path | None, "folder for certify.json and the figures"] = None


@dataclass(frozen=True, slots=True)
class WorkerOptions:
    """Take part in a sweep that `benchmark --engine folder` has begun."""

    folder: Annotated[Path, Positional("its results folder")]


@dataclass(frozen=True, slots=True)
class WarmOptions:
    """Compile all kernels now, so that nothing has to wait for them later."""

    jobs: Annotated[int | None, "processes; as many as there are cores if not given"] = None
    portable: Annotated[Path | None, "folder for kernels that run on other processors, too: for a wheel"] = (
        None
    )


@dataclass(frozen=True, slots=True)
class DoctorOptions:
    """Look at the installation and fly a moment."""

    json: Json = False


class Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        """Exit with code 2."""
        from quad_envs.arguments.names import shortened  # here, so that --help need not load Gymnasium

        self.exit(2, f"{self.prog}: error: {shortened(message)} (--help shows what there is)\n")


def add_options(parser: argparse.ArgumentParser, kind: type[Any]) -> None:
    """One argument per field."""
    hints = get_type_hints(kind, include_extras=True)
    for entry in fields(kind):
        hint, text = get_args(hints[entry.name])
        many, positional = hint == list[str], isinstance(text, Positional)
        required = entry.default is MISSING and not many
        settings: dict[str, Any] = {"help": str(text), "default": None}
        if hint is bool:
            settings["action"] = "store_true"
        else:
            settings["type"] = _KINDS.get(hint, str)
        if not required and not many and entry.default not in (None, "", False):
            settings["help"] += f" (default {entry.default})"
        if positional:
            settings["nargs"] = "*" if many else None if required else "?"
        elif many:
            settings |= {
                "action": "append",
                "metavar": _REPEATED.get(entry.name, "NAME"),
            }
        elif hint is not bool:
            of_kind = {_whole: "N", _number: "S", _path: "FILE" if _is_file(str(text)) else "FOLDER"}
            settings["metavar"] = of_kind.get(settings["type"], "NAME")
        if positional:
            parser.add_argument(entry.name, **settings)
        else:
            parser.add_argument(_flag(entry.name), dest=entry.name, **settings)


def _is_file(text: str) -> bool:
    return text.startswith("file ")


def _flag(name: str) -> str:
    return "--" + name.rstrip("_").replace("_", "-")  # `from_`, since Python keeps `from` for itself


def read_options(kind: type[Options], found: argparse.Namespace) -> Options:
    """The dataclass of what was parsed."""
    values = {entry.name: getattr(found, entry.name) for entry in fields(kind)}  # type: ignore[arg-type]
    return kind(**{name: value for name, value in values.items() if value is not None})


def refuse_unknown(rest: Sequence[str], kind: type[Any], parser: Parser) -> None:
    """One clear line about arguments that no option takes."""
    if not rest:
        return
    from quad_envs.arguments.names import shown, unknown_name

    hints = get_type_hints(kind, include_extras=True)
    known = [_flag(name) for name, hint in hints.items() if not isinstance(get_args(hint)[1], Positional)]
    name = rest[0].split("=")[0]
    parser.error(
        unknown_name("option", name, known) if name.startswith("-") else f"unexpected argument {shown(name)}"
    )


def read_assignments(flag: str, texts: Sequence[str]) -> dict[str, Any]:
    """KEY=VALUE texts as a mapping.

    Raises:
        ValueError: If one has no '=', a key comes twice, or a value begins with a bracket and is no mapping.
    """
    from quad_envs.arguments.names import shown

    out: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise ValueError(f"{flag} needs KEY=VALUE, as {flag} kappa=0.3125; got {shown(text)}")
        if key in out:
            raise ValueError(f"{flag} sets {shown(key)} twice")
        try:
            out[key] = read_value(value)
        except ValueError as error:
            raise ValueError(f"{flag} {shown(key)}: {error}") from None
    return out
