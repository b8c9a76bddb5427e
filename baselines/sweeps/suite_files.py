"""Suites as TOML files.

name = "mine"
episodes = 10
seed = 0
compare_with = "lmpc"        # label of the policy from which differences are taken

envs = "all"                 # or a list of ids, or of tables
[[policies]]
name = "sdc-nmpc"
label = "sdc-nmpc, N 15"
kwargs = {horizon = 15}
[[policies]]
name = "mypolicy:make"       # module:factory of your own, or an entry point of an installed package
[[policies]]
name = "safe:ppo-corridor"   # behind a safety filter
[[policies]]
name = "ppo"                 # an algorithm: one network is trained in each environment and with each seed
train = {seeds = [0, 1, 2], steps = 4_000_000}   # start_from = "dagger-formation": goes on from that
[[policies]]
name = "ppo"                 # the network that comes with the suite
shipped = true
[[policies]]
name = "nmpc"                # a controller: its options are tuned in each environment and with each seed
tune = {seeds = [0, 1], seconds = 60}
train_under = {randomize = 0.2}   # of a training or a tuning, beside the arguments of the environment
[[conditions]]               # each environment is flown in each; networks are trained without them
label = "2.45 N"
kwargs = {kappa = 0.3125}

"all" means the tracking ids, or policies. Multi-agent ids are named, and a policy that is not for all of the
suite's environments says for which it is: `envs = ["quad/Formation-v0"]`, ids or labels. So do conditions.
In an environment with `tables` fly policies of these tables alone: so teams stand beside single vehicles.
Policies are compared within `tables` (label, about), if there are any: `tables = ["levelled"]` of a policy
says in which it stands. `small` says what --quick keeps; `protocol` is the version that others repeat.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

from quad_envs.arguments.checks import require_path
from quad_envs.arguments.names import shown, unknown_name
from quad_envs.registration import TEAMS, TRACKING

from ..policies.registry import TEAM_POLICIES, TRACKING_POLICIES, behind_filter, from_outside
from ..policies.trained import names_trained
from ..training.algorithms import ALGORITHMS
from .choices import Condition, EnvChoice, Part, PolicyChoice, TableChoice, Training, Tuning
from .suite import Suite

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_Choice = TypeVar("_Choice", EnvChoice, PolicyChoice, Condition, TableChoice)
_KEYS = {EnvChoice: "id", PolicyChoice: "name", Condition: "label", TableChoice: "label"}
_MADE = {"train": Training, "tune": Tuning}
_LISTS = {"envs": "ids or labels", "conditions": "labels", "tables": "labels"}
_TABLES = ("kwargs", "train_under")


def suite_from_dict(data: Mapping[str, Any], name: str = "suite") -> Suite:
    """A suite from the values of a TOML file.

    Raises:
        ValueError: If a key is unknown, one that is needed is missing, or a value is not allowed.
    """
    known = [entry.name for entry in fields(Suite) if entry.name != "definition"]
    data = {key: value for key, value in data.items() if key != "definition"}  # it is found anew
    for key in data:
        if key not in (*known, "description"):
            raise ValueError(unknown_name(f"key of suite {name!r}:", key, known))
    for key in ("envs", "policies"):
        if key not in data:
            raise ValueError(f'suite {name!r} needs {key}: a list of tables, or "all"')
    given = {key: value for key, value in data.items() if key != "description"}
    envs, policies = given["envs"], given["policies"]
    given["envs"] = _choices(EnvChoice, list(TRACKING) if envs == "all" else envs, name)
    every = list(TRACKING_POLICIES) if policies == "all" else policies
    given["policies"] = _choices(PolicyChoice, every, name)
    given["conditions"] = _choices(Condition, given.get("conditions", ()), name)
    given["tables"] = _choices(TableChoice, given.get("tables", ()), name)
    given["small"] = _small(given.get("small", {}), name)
    return Suite(**{"name": name, **given}).defined()


def _small(table: Any, suite: str) -> Part:
    """What --quick keeps."""
    known = [entry.name for entry in fields(Part)]
    if not isinstance(table, Mapping):
        raise ValueError(f"suite {suite!r}: small must be a table, as {{seeds = 2}}, got {shown(table)}")
    for key in table:
        if key not in known:
            raise ValueError(unknown_name(f"key of small in suite {suite!r}:", key, known))
    lists = {key: _names(value, "small", key, suite) for key, value in table.items() if key in _LISTS}
    return Part(**{**table, **lists})


def _choices(kind: type[_Choice], entries: Any, suite: str) -> tuple[_Choice, ...]:
    """The tables of a list; a policy that is trained with several seeds is several."""
    key = _KEYS[kind]
    if not isinstance(entries, Sequence) or isinstance(entries, str):
        raise ValueError(
            f'suite {suite!r}: choose from a list of tables with {key!r}, or "all"; got {shown(entries)}'
        )
    out: list[_Choice] = []
    for entry in entries:
        if not isinstance(entry, str | Mapping):
            raise ValueError(
                f"suite {suite!r}: choose by name or by a table with {key!r}, got {shown(entry)}"
            )
        table = _checked({key: entry} if isinstance(entry, str) else dict(entry), kind, suite)
        out.extend(kind(**{**table, **made}) for made in _seeds_of(table, suite))
    return tuple(out)


def _seeds_of(table: Mapping[str, Any], suite: str) -> list[dict[str, Any]]:
    """What makes a policy, once per seed; once nothing for one that is not made."""
    made = [name for name in _MADE if name in table]
    if len(made) > 1:
        raise ValueError(f"suite {suite!r}: policy {table['name']!r} has train and tune: give one of them")
    return [{name: each} for name in made for each in _made(name, table[name], suite)] or [{}]


def _checked(table: dict[str, Any], kind: type[Any], suite: str) -> dict[str, Any]:
    """A table whose keys are known and whose values are of the right kind."""
    key, known = _KEYS[kind], [entry.name for entry in fields(kind)]
    for name in table:
        if name not in known:
            raise ValueError(unknown_name(f"key in suite {suite!r}:", name, known))
    if key not in table:
        raise ValueError(f"suite {suite!r}: each table needs {key!r}, got {table}")
    if not isinstance(table[key], str):
        raise ValueError(f"suite {suite!r}: {key} must be text, got {shown(table[key])}")
    for name in _MADE:
        if table.get(name, 0) is None:
            del table[name]
    allowed = _allowed(kind, table)
    name = table[key]
    if kind is PolicyChoice and not ("train" in table or table.get("shipped")):
        name = behind_filter(name)
    if allowed is not None and name not in allowed and not _is_users(kind, name):
        raise ValueError(unknown_name(f"{key} in suite {suite!r}:", name, allowed))
    _check_kinds(table, table[key], suite)
    for entry in _LISTS:
        if table.get(entry):
            table[entry] = _names(table[entry], table[key], entry, suite)
        else:
            table.pop(entry, None)
    return table


def _check_kinds(table: Mapping[str, Any], who: str, suite: str) -> None:
    """Refuse a word for a table and the like."""
    for entry in _TABLES:
        if not isinstance(table.get(entry, {}), Mapping):
            raise ValueError(
                f"suite {suite!r}: {entry} of {who!r} must be a table, as {{horizon = 15}}, "
                f"got {table[entry]!r}"
            )
    for entry in ("label", "about", "trace"):
        if not isinstance(table.get(entry, ""), str):
            raise ValueError(f"suite {suite!r}: the {entry} of {who!r} must be text, got {table[entry]!r}")
    if not isinstance(table.get("shipped", False), bool):
        raise ValueError(
            f"suite {suite!r}: shipped of {who!r} must be true or false, got {shown(table['shipped'])}"
        )


def _is_users(kind: type[Any], name: Any) -> bool:
    """Whether a name is one of the user's: a checkpoint, `module:factory`, an entry point, `module:id`."""
    if kind is PolicyChoice and from_outside(name):
        return True
    return names_trained(name) or (kind is EnvChoice and ":" in name)


def _allowed(kind: type[Any], table: Mapping[str, Any]) -> list[str] | None:
    """Names that a choice may have; None for any."""
    if kind is EnvChoice:
        return [*TRACKING, *TEAMS]
    if kind in (Condition, TableChoice):
        return None
    if "train" in table or table.get("shipped"):
        return list(ALGORITHMS)
    return list(dict.fromkeys([*TRACKING_POLICIES, *TEAM_POLICIES]))


def _made(name: str, table: Any, suite: str) -> list[Training] | list[Tuning]:
    """One training, or one tuning, per seed."""
    kind: Any = _MADE[name]
    known = [*(entry.name for entry in fields(kind)), "seeds"]
    if not isinstance(table, Mapping):
        raise ValueError(
            f"suite {suite!r}: {name} must be a table, as {{seeds = [0, 1]}}, got {shown(table)}"
        )
    for key in table:
        if key not in known:
            raise ValueError(unknown_name(f"key of {name} in suite {suite!r}:", key, known))
    given = {key: value for key, value in table.items() if key != "seeds"}
    if not isinstance(given.get("hyper", {}), Mapping):
        raise ValueError(
            f"suite {suite!r}: hyper of a training must be a table, as {{n_envs = 64}}, "
            f"got {shown(given['hyper'])}"
        )
    seeds = table.get("seeds", [given.pop("seed", 0)])
    if not isinstance(seeds, Sequence) or isinstance(seeds, str) or not seeds:
        what = "training" if kind is Training else "tuning"
        raise ValueError(f"suite {suite!r}: seeds of a {what} must be a list, as [0, 1], got {shown(seeds)}")
    return [kind(**{**given, "seed": seed}) for seed in seeds]


def _names(value: Any, who: str, kind: str, suite: str) -> tuple[str, ...]:
    """The environments, conditions or tables that a policy or a condition names."""
    if not isinstance(value, list | tuple) or not all(isinstance(name, str) for name in value):
        raise ValueError(
            f"suite {suite!r}: {kind} of {who!r} must be a list of {_LISTS[kind]}, got {shown(value)}; "
            "without it all are meant"
        )
    return tuple(value)


def suite_names() -> dict[str, str]:
    """Shipped suites and what they are."""
    files = sorted(resources.files(__package__).joinpath("suites").iterdir(), key=lambda file: file.name)
    toml = [file for file in files if file.name.endswith(".toml")]
    return {
        file.name[:-5]: str(tomllib.loads(file.read_text("utf-8")).get("description", "")) for file in toml
    }


def load_suite(source: str | Path | Mapping[str, Any] | Suite) -> Suite:
    """A shipped suite by name, one from a TOML file, from a mapping, or as it is.

    Raises:
        ValueError: If it does not exist or is not valid.
    """
    if isinstance(source, Suite):
        return source
    if isinstance(source, Mapping):
        return suite_from_dict(source)
    require_path("a suite, if no mapping,", source)
    path = Path(source)
    if path.suffix == ".toml":
        if not path.is_file():
            raise ValueError(
                f"there is no suite file {str(path)!r}; shipped suites: {', '.join(suite_names())}"
            )
        return _read_suite(path)
    if str(source) not in suite_names():
        raise ValueError(unknown_name("suite", str(source), suite_names()) + "; or the path of a .toml file")
    text = resources.files(__package__).joinpath("suites", f"{source}.toml").read_text("utf-8")
    return suite_from_dict(tomllib.loads(text), str(source))


def _read_suite(path: Path) -> Suite:
    """The suite of a file; every complaint names the file."""
    try:
        return suite_from_dict(tomllib.loads(path.read_text("utf-8")), path.stem)
    except OSError as error:
        raise ValueError(f"cannot read suite file {str(path)!r}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"suite file {str(path)!r} is not valid TOML: {error}") from error
    except RecursionError:
        raise ValueError(f"suite file {str(path)!r} has brackets nested too deeply to be read") from None
    except ValueError as error:
        raise ValueError(f"suite file {str(path)!r}: {error}") from error
