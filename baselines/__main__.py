"""The command line, `quad-envs` or `python -m baselines`. What a command needs is imported when it runs."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

from .cli.options import (
    BenchmarkOptions,
    CertifyOptions,
    DoctorOptions,
    EvaluateOptions,
    ExportOptions,
    ListOptions,
    Parser,
    RecordOptions,
    ReplayOptions,
    ReportOptions,
    ReproduceOptions,
    TrainOptions,
    TuneOptions,
    WarmOptions,
    WorkerOptions,
    add_options,
    read_options,
    refuse_unknown,
)
from .cli.streams import give_up_output, quiet_pipe, take_streams
from .errors import MissingPackageError
from .interruptions import exit_code, remembered

if TYPE_CHECKING:
    from collections.abc import Iterator


class Command(NamedTuple):
    """A subcommand."""

    options: type[Any]
    run: Callable[[Any], int]


def _list(options: ListOptions) -> int:
    from .cli import commands

    return commands.list_names(options)


def _evaluate(options: EvaluateOptions) -> int:
    from .cli import commands

    return commands.evaluate_one(options)


def _benchmark(options: BenchmarkOptions) -> int:
    from .cli import commands

    return commands.benchmark_suite(options)


def _train(options: TrainOptions) -> int:
    from .cli import train as train_command

    return train_command.train_one(options)


def _tune(options: TuneOptions) -> int:
    from .cli import tune as tune_command

    return tune_command.tune_one(options)


def _record(options: RecordOptions) -> int:
    from .cli import record as record_command

    return record_command.record_flights(options)


def _export(options: ExportOptions) -> int:
    from .cli import export as export_command

    return export_command.export_one(options)


def _reproduce(options: ReproduceOptions) -> int:
    from . import reproduction as reproduce

    return int(reproduce.run(options.what, options.out, options.json, options.jobs, options.fresh))


def _report(options: ReportOptions) -> int:
    from .cli import report as commands

    return commands.make_page(options)


def _replay(options: ReplayOptions) -> int:
    from .cli import report as commands

    return commands.replay(options)


def _certify(options: CertifyOptions) -> int:
    from .cli import certify as command

    return command.certify_one(options)


def _doctor(options: DoctorOptions) -> int:
    from .cli import doctor

    return doctor.examine(options.json)


def _warm(options: WarmOptions) -> int:
    from .cli import warm

    return warm.compile_all(options)


def _worker(options: WorkerOptions) -> int:
    from .cli import worker

    return worker.join(options)


COMMANDS: dict[str, Command] = {
    "list": Command(ListOptions, _list),
    "evaluate": Command(EvaluateOptions, _evaluate),
    "benchmark": Command(BenchmarkOptions, _benchmark),
    "worker": Command(WorkerOptions, _worker),
    "train": Command(TrainOptions, _train),
    "tune": Command(TuneOptions, _tune),
    "record": Command(RecordOptions, _record),
    "export": Command(ExportOptions, _export),
    "reproduce": Command(ReproduceOptions, _reproduce),
    "report": Command(ReportOptions, _report),
    "replay": Command(ReplayOptions, _replay),
    "certify": Command(CertifyOptions, _certify),
    "warm": Command(WarmOptions, _warm),
    "doctor": Command(DoctorOptions, _doctor),
}


class _Version(argparse.Action):
    """Prints the version, which is looked up when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *given: Any) -> NoReturn:
        from quad_envs import __version__

        print(f"quad-envs {__version__}")
        parser.exit()


def make_parser() -> Parser:
    """The parser of all commands."""
    parser = Parser(
        prog="quad-envs", description="Quadrotor environments with MPC baselines.", allow_abbrev=False
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        summary = str(command.options.__doc__)
        add_options(
            commands.add_parser(name, help=summary, description=summary, allow_abbrev=False), command.options
        )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit code: 0, or 2 if the input was bad, 130 if interrupted, 143 if terminated.

    Modules of the current folder can be named, as `mypolicy:make`.
    """
    if not take_streams():
        print("quad-envs: error: standard output is closed; > /dev/null prints nowhere", file=sys.stderr)
        return 2
    with quiet_pipe(), _importable_here(), remembered(terminate=True):
        try:
            return _run(list(sys.argv[1:] if arguments is None else arguments))
        except BrokenPipeError:
            raise
        except Exception as error:
            give_up_output()
            if os.environ.get("QUAD_ENVS_TRACEBACK") or not isinstance(error, _input_errors()):
                raise
            print(f"quad-envs: error: {_one_line(error)}", file=sys.stderr)
            return 2
        except KeyboardInterrupt as interruption:
            print("quad-envs: interrupted", file=sys.stderr)
            return exit_code(interruption)


def _run(given: list[str]) -> int:
    """Run the command of some arguments."""
    parser = make_parser()
    if given and not given[0].startswith("-") and given[0] not in COMMANDS:
        from quad_envs.arguments.names import unknown_name

        parser.error(unknown_name("command", given[0], COMMANDS))
    found, rest = parser.parse_known_args(given)
    command = COMMANDS[found.command]
    refuse_unknown(rest, command.options, parser)
    return command.run(read_options(command.options, found))


def _input_errors() -> tuple[type[Exception], ...]:
    """What bad input raises; Gymnasium's own errors if it is loaded at all."""
    kinds: tuple[type[Exception], ...] = (ValueError, TypeError, OSError, MemoryError, OverflowError)
    kinds = (*kinds, MissingPackageError, RecursionError)
    gymnasium = sys.modules.get("gymnasium")
    return kinds if gymnasium is None else (*kinds, gymnasium.error.Error)


def _one_line(error: Exception) -> str:
    """What is wrong, on one line and with the file or the cause where Python leaves it out."""
    from quad_envs.arguments.names import shortened

    text = str(error)
    if isinstance(error, OSError) and error.filename is not None:
        text = f"{error.filename}: {error.strerror}"
    elif isinstance(error, MemoryError):
        text = f"not enough memory: {text or 'choose smaller numbers'}"
    elif isinstance(error, OverflowError):
        text = f"a number is too large: {text}"
    elif isinstance(error, RecursionError):
        text = "something is nested too deeply: look for brackets in brackets"
    return shortened(text) or type(error).__name__


@contextmanager
def _importable_here() -> Iterator[None]:
    """Let modules of the current folder be imported, as `python -m` does."""
    here = os.getcwd()
    if here in sys.path or "" in sys.path or getattr(sys.flags, "safe_path", False):
        yield
        return
    sys.path.insert(0, here)
    try:
        yield
    finally:
        if here in sys.path:
            sys.path.remove(here)


if __name__ == "__main__":
    sys.exit(main())
