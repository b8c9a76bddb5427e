"""What MkDocs does to each page beyond its plugins, so that the site loads nothing from elsewhere.

Equations become MathML when the site is built: `pymdownx.arithmatex` has marked them, their TeX escaped as
HTML. The one script that the theme would take from the network is the copy in docs/vendor. And tables of what
the code knows are written from it: the columns of tables, the limits, the hyperparameters of the learners,
the options of the controllers, the arguments of `train` and `run_benchmark`.
"""

from __future__ import annotations

import html
import inspect
import re
from dataclasses import MISSING, fields
from typing import Any

_WIDE = 7  # bars of a line of a table with more than six columns
_INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
_DISPLAY = re.compile(r'<div class="arithmatex">\\\[(.*?)\\\]</div>', re.DOTALL)
_SHIM, _OWN_SHIM = "https://unpkg.com/iframe-worker/shim", "vendor/iframe-worker.js"


def columns_table() -> str:
    """The columns of the tables of evaluations, as Markdown."""
    from baselines.evaluation.columns import COLUMNS

    lines = ["| column | on the page | unit | |", "|---|---|---|---|"]
    for name, column in COLUMNS.items():
        notes = "; ".join(column.notes).replace("|", r"\|")
        if column.source in ("", name):
            lines.append(f"| `{name}` | {column.title} | {column.unit} | {notes} |")
    return "\n".join(lines)


def episode_table() -> str:
    """The columns of an episode as a table, as Markdown."""
    from baselines.evaluation.episode_columns import GROUPS

    lines = ["| column | unit | |", "|---|---|---|"]
    for group in GROUPS:
        names = ", ".join(f"`{name}`" for name in group.names)
        lines.append(f"| {names} | {group.unit} | {group.about} |")
    return "\n".join(lines)


def limits_table() -> str:
    """The limits that environments take, as Markdown."""
    from quad_envs.limits import LIMITS

    lines = ["| argument | limits | violation that costs the whole reward of a step |", "|---|---|---|"]
    for limit in LIMITS:
        form = ": ((x, y, z) lower, (x, y, z) upper)" if limit.box else ""
        scale = f"{limit.scale:g} {limit.unit}" if limit.scale else "the largest permitted one of a step"
        lines.append(f"| `{limit.option}` | {limit.about}{form}, {limit.given_unit} | {scale} |")
    return "\n".join(lines)


def hyperparameter_tables() -> str:
    """What each learner lets choose, in Markdown, from the comments in its options."""
    from baselines.training.algorithms import ALGORITHMS
    from baselines.training.hyperparameters import hyperparameters, plain_options
    from quad_envs.arguments.field_comments import field_comments

    lines = []
    for name, entry in ALGORITHMS.items():
        lines += [f"### {name}", ""]
        values = plain_options(hyperparameters(name, ""))
        lines += [*_rows("hyperparameter", values, field_comments(entry.options)), ""]
    return "\n".join(lines)


def controller_options_table() -> str:
    """What each controller lets choose, in Markdown; what several MPCs share stands first."""
    from controllers.feedback.options import FeedbackLinearizationOptions, LqrOptions, SdreOptions
    from controllers.mpc.options import LmpcOptions, MpcOptions, NmpcOptions, SdcOptions
    from controllers.team.options import CentralOptions, CooperativeOptions
    from quad_envs.arguments.field_comments import field_comments

    lines = []
    parents = dict.fromkeys((LmpcOptions, SdcOptions, NmpcOptions), MpcOptions)
    mpcs = (MpcOptions, *parents, CooperativeOptions, CentralOptions)
    for kind in (*mpcs, SdreOptions, LqrOptions, FeedbackLinearizationOptions):
        shared = {field.name for field in fields(parents[kind])} if kind in parents else set()
        shared -= set(kind.__annotations__)  # what it has otherwise
        values = {field.name: field.default for field in fields(kind) if field.name not in shared}
        lines += [f"#### {kind.__name__}", "", *_rows("option", values, field_comments(kind)), ""]
    return "\n".join(lines)


def training_arguments() -> str:
    """The arguments of `train`, as Markdown."""
    from baselines.training.request import TrainingRequest

    return _arguments(TrainingRequest)


def benchmark_arguments() -> str:
    """The arguments of `run_benchmark`, as Markdown."""
    from baselines.report.benchmark import BenchmarkRequest

    return _arguments(BenchmarkRequest)


def _arguments(kind: type[Any]) -> str:
    """The arguments of a function whose arguments are the fields of a dataclass."""
    from quad_envs.arguments.field_comments import field_comments

    defaults = {field.name: field.default for field in fields(kind)}
    values = {name: defaults[name] for name in inspect.signature(kind).parameters}
    return "\n".join(_rows("argument", values, field_comments(kind)))


def _rows(what: str, values: dict[str, Any], comments: dict[str, str]) -> list[str]:
    """A table of fields, their defaults and comments."""
    shown = {key: "" if value is MISSING else f"`{value!r}`" for key, value in values.items()}
    rows = [f"| `{key}` | {value} | {comments[key]} |" for key, value in shown.items()]
    return [f"| {what} | default | |", "|---|---|---|", *rows]


_TABLES = {
    "<!-- table: columns -->": columns_table,
    "<!-- table: episode -->": episode_table,
    "<!-- table: limits -->": limits_table,
    "<!-- table: hyperparameters -->": hyperparameter_tables,
    "<!-- table: controller options -->": controller_options_table,
    "<!-- table: arguments of train -->": training_arguments,
    "<!-- table: arguments of run_benchmark -->": benchmark_arguments,
}


def with_tables(markdown: str) -> str:
    """A page with its tables of what the code knows, where it has some."""
    for mark, table in _TABLES.items():
        if mark in markdown:
            markdown = markdown.replace(mark, table())
    return markdown


def on_page_markdown(markdown: str, page: Any, **kwargs: Any) -> str:
    """The page with its tables; where one is wide, it takes the place of the contents beside it."""
    markdown = with_tables(markdown)
    if any(line.startswith("|") and line.count("|") > _WIDE for line in markdown.splitlines()):
        page.meta.setdefault("hide", []).append("toc")
    return markdown


def to_mathml(tex: str, display: str) -> str:
    """MathML of an equation.

    Args:
        tex: The equation in TeX, escaped as HTML.
        display: "inline" or "block".

    Raises:
        ValueError: If a command is left that the converter does not know; it would print it as it stands.
    """
    from latex2mathml.converter import convert

    source = html.unescape(tex).strip()
    found: str = convert(source, display=display)
    unknown = re.findall(r">\s*(\\[A-Za-z]+|&(?=<))", found)
    if unknown:
        raise ValueError(f"no MathML for {', '.join(unknown)} in the equation {source!r}")
    # Browsers know MathML Core, which leaves the alignment of columns to CSS, and takes a bar for a relation.
    found = re.sub(r'columnalign="(\w+)"', r'style="text-align: \1"', found)
    return re.sub(r"<mo( stretchy=\"false\")?>(&#x0007C;)", r'<mo\1 lspace="0" rspace="0">\2', found)


def on_page_content(content: str, **kwargs: Any) -> str:
    """The page with its equations in MathML."""
    content = _INLINE.sub(lambda match: to_mathml(match[1], "inline"), content)
    return _DISPLAY.sub(lambda match: f'<div class="equation">{to_mathml(match[1], "block")}</div>', content)


def on_post_page(output: str, page: Any, **kwargs: Any) -> str:
    """The page with our copy of the theme's script."""
    from mkdocs.utils import get_relative_url

    return output.replace(_SHIM, get_relative_url(_OWN_SHIM, page.url))


def on_post_template(output: str, **kwargs: Any) -> str:
    """The same for pages that are not Markdown, as 404.html."""
    return output.replace(_SHIM, _OWN_SHIM)
