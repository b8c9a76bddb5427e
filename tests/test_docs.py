"""Every code block of the documentation and of the README does what its page says.

Blocks of a page run in order, in one module and in an empty folder: Python as it stands, `quad-envs ...` as
the command line would, and a block with a title is a file of that name. After `<!-- not run: why -->` a block
is only read: Python is compiled, commands are parsed. Of the README the commands are only parsed, too.
"""

import importlib.util
import json
import pathlib
import re
import shlex
import subprocess
import sys
import types
from typing import NamedTuple

import pytest
from sources import ROOT, reads_sources, script

from baselines.__main__ import main, make_parser
from baselines.files import write_csv
from baselines.report.benchmark import BenchmarkRequest
from baselines.training.algorithms import ALGORITHMS
from baselines.training.request import TrainingRequest
from controllers import CooperativeOptions, LmpcOptions, NmpcOptions, SdcOptions
from controllers.feedback.options import FeedbackLinearizationOptions, LqrOptions, SdreOptions
from controllers.team.options import CentralOptions
from quad_envs.arguments.field_comments import field_comments
from quad_envs.registration import TEAMS, TRACKING

README = ROOT / "README.md"
NOTEBOOK = ROOT / "docs" / "tutorial" / "first_flight.ipynb"
PAGES = [README, *sorted((ROOT / "docs").rglob("*.md"))]
QUICK = (
    "docs/extending.md",
    "docs/maths/qp.md",
    "docs/maths/sdc.md",
    "docs/tutorial/method.md",
)  # run by default, the others are slow
NEEDED = {  # packages that a page needs to run
    "docs/tutorial/datasets.md": ("minari", "h5py"),
    "docs/tutorial/method.md": ("stable_baselines3",),
}
LANGUAGES = ("python", "bash", "toml", "csv", "text", "")  # "": text
_FENCE = re.compile(r"^```(\w*)(?: title=\"([^\"]+)\")?\s*$")
_MARK = re.compile(r"<!-- not run: .+ -->")


class Block(NamedTuple):
    language: str
    title: str
    code: str
    line: int  # of the fence
    runs: bool


def name_of(page):
    return page.relative_to(ROOT).as_posix()


def blocks_of(page):
    lines = page.read_text(encoding="utf-8").splitlines()
    blocks, start, head = [], None, None
    for number, line in enumerate(lines):
        if start is None and line.startswith("```"):
            head = _FENCE.match(line)
            assert head, (
                f"{name_of(page)}, line {number + 1}: a fence is ```language or ```language title=..."
            )
            start = number
        elif start is not None and line.startswith("```"):
            runs = not (_MARK.fullmatch(lines[start - 1]) or (page == README and head[1] == "bash"))
            code = "\n".join(lines[start + 1 : number]) + "\n"
            blocks.append(Block(head[1], head[2] or "", code, start + 1, runs))
            start = None
    assert start is None, f"{name_of(page)}, line {start + 1}: the block has no end"
    return blocks


def commands_of(block):
    joined = block.code.replace("\\\n", " ")
    return [words for line in joined.splitlines() if (words := shlex.split(line, comments=True))]


def has_something_to_run(page):
    return any(block.runs and block.language in ("python", "bash") for block in blocks_of(page))


def pages(condition):
    return [
        pytest.param(page, id=name_of(page), marks=[] if name_of(page) in QUICK else pytest.mark.slow)
        for page in PAGES
        if condition(page)
    ]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_block_can_be_read(page):
    for block in blocks_of(page):
        where = f"{name_of(page)}, line {block.line}"
        assert block.language in LANGUAGES, where
        if block.language == "python":
            compile(block.code, where, "exec")
        if block.language == "bash":
            for words in commands_of(block):
                read_command(words, where)


def read_command(words, where):
    """Refuse a command that does not exist, or options that it does not have."""
    if words[0] == "quad-envs":
        found, rest = make_parser().parse_known_args(words[1:])
        assert not rest, f"{where}: {found.command} has no option {rest[0]}"
    elif words[0] == "make":
        targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
        assert set(words[1:]) <= set(targets), where
    elif words[:2] == ["python", "-m"]:
        assert importlib.util.find_spec(words[2]), where
    else:
        assert words[0] in ("pip", "tensorboard", "git", "cd", "docker"), (
            f"{where}: nothing tests {words[0]!r}"
        )


@pytest.mark.parametrize("page", pages(has_something_to_run))
def test_every_block_runs(page, tmp_path, monkeypatch):
    for package in NEEDED.get(name_of(page), ()):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    module = types.ModuleType("documented_page")  # a real one, so that its classes pickle
    monkeypatch.setitem(sys.modules, module.__name__, module)
    for block in blocks_of(page):
        if not block.runs:
            continue
        if block.title:
            pathlib.Path(block.title).write_text(block.code, encoding="utf-8")
        elif block.language == "python":
            source = "\n" * block.line + block.code  # so that a traceback names the line of the page
            exec(compile(source, str(page), "exec"), module.__dict__)
        elif block.language == "bash":
            for words in commands_of(block):
                assert words[0] == "quad-envs", (
                    f"{name_of(page)}, line {block.line}: mark {words[0]} as not run"
                )
                assert main(words[1:]) == 0, shlex.join(words)


def test_every_cell_of_the_notebook_runs_and_no_output_is_stored(monkeypatch):
    pyplot = pytest.importorskip("matplotlib.pyplot", reason="the notebook needs the extra [report]")
    notebook = json.loads(NOTEBOOK.read_text(encoding="utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert notebook["nbformat"] == 4 and len(cells) > 3
    module = types.ModuleType("documented_notebook")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    with pyplot.rc_context({"backend": "agg"}):
        for cell in cells:
            assert cell["outputs"] == [] and cell["execution_count"] is None, "clear the outputs"
            exec(compile("".join(cell["source"]), cell["id"], "exec"), module.__dict__)
    pyplot.close("all")
    costs = {name: found.summary()["constraint_cost"].mean for name, found in module.found.items()}
    assert costs["nmpc"] == 0.0 < costs["ppo-corridor"]  # as the text says


def test_the_pages_of_the_protocol_are_what_its_published_numbers_say():
    made = script("protocol")
    for page in made.PAGES:
        assert page.read_text(encoding="utf-8") == made.renewed(page), "run: python docs/protocol.py"
    for label in ("as derived", "levelled"):
        assert any(row["table"] == label and row["base"] for row in made.published())


def test_only_results_of_a_protocol_are_published(tmp_path):
    (tmp_path / "config.json").write_text('{"suite": {}}')
    with pytest.raises(ValueError, match="holds no results of a protocol"):
        script("protocol").publish(tmp_path)


@pytest.fixture
def protocol(tmp_path, monkeypatch):
    """The script, which publishes elsewhere; and `flown`, a results folder as far as it reads it."""
    made = script("protocol")
    for name, file in {"PLACE": "", "NUMBERS": "protocol.csv", "FACTS": "protocol.json"}.items():
        monkeypatch.setattr(made, name, tmp_path / file)
    real = made._read(ROOT / "docs" / "results" / "protocol.csv")

    def flown(name, env, start=10_000, conditions=("nominal", "gusts"), like="Helix", without=""):
        run = tmp_path / name
        run.mkdir()
        of = {"version": "quad-bench-2026.1", "definition": "d", "flown": name, "starts": {"judging": start}}
        config = {"protocol": of, "git_revision": name * 10, "platform": "", "versions": {}}
        (run / "config.json").write_text(json.dumps(config))
        rows = [row for row in real if row["env"] == like and row["condition"] in conditions]
        rows = [row for row in rows if row["policy"] != without]
        write_csv(run / "contenders.csv", [row | {"env": env} for row in rows])
        (run / f"frontier-{env.lower()}-nominal-levelled.svg").write_text(name)
        return run

    return made, flown


def test_a_part_of_the_protocol_takes_the_place_of_what_was_published_of_its_environments(protocol):
    made, flown = protocol
    made.publish(flown("first", "Line"))
    made.publish(flown("second", "Spiral"))
    made.publish(flown("third", "Line", conditions=("nominal", "gusts", "sensor noise")))
    rows = made.published()
    assert [row["env"] for row in rows if row["policy"] == "lmpc" and row["condition"] == "sensor noise"] == [
        "Line"
    ]
    runs = json.loads(made.FACTS.read_text())["runs"]
    assert [(run["envs"], run["flown"]) for run in runs] == [
        ({"Spiral": ["nominal", "gusts"]}, "second"),
        ({"Line": ["nominal", "gusts", "sensor noise"]}, "third"),
    ]
    assert (made.PLACE / "frontier-line-levelled.svg").read_text() == "third"
    means = [row for row in rows if row["env"] == made.ALL]
    assert {(row["environments"], row["condition"]) for row in means} == {("2", "nominal"), ("2", "gusts")}
    for mean in means:  # of two environments with the same numbers
        one = next(row for row in rows if made._cell(row) == made._cell(mean | {"env": "Line"}))
        for name in ("score", "violation_share", "score_minus_base"):
            assert float(mean[name]) == pytest.approx(float(one[name]), abs=1e-15)
        assert made._half(mean) == pytest.approx(made._half(one) / 2**0.5, abs=1e-15)


def test_conditions_that_were_flown_later_stand_beside_those_that_were_flown_before(protocol):
    made, flown = protocol
    made.publish(flown("first", "Helix"))
    made.publish(flown("later", "Helix", conditions=("gusts", "sensor noise")))
    assert list(dict.fromkeys(row["condition"] for row in made.published())) == [
        *("nominal", "gusts", "sensor noise")
    ]
    runs = json.loads(made.FACTS.read_text())["runs"]
    assert [run["envs"] for run in runs] == [{"Helix": ["nominal"]}, {"Helix": ["gusts", "sensor noise"]}]
    assert (made.PLACE / "frontier-helix-levelled.svg").read_text() == "first"  # drawn in still air alone
    origin = made.tables().splitlines()[0]
    assert "Flown: Helix (nominal) at revision first" in origin.replace("firstfi", "first")
    assert "; Helix (gusts; sensor noise) at revision laterla" in origin
    assert "Not flown: Helix (weak rotors, far starts; " in origin and ", Random, Corridor, " in origin


def test_what_does_not_compare_is_not_published_together(protocol):
    made, flown = protocol
    made.publish(flown("first", "Line"))
    kept = made.NUMBERS.read_bytes(), made.FACTS.read_bytes()
    with pytest.raises(ValueError, match="do not compare"):
        made.publish(flown("quick", "Spiral", start=5))
    with pytest.raises(ValueError, match=r"lacks \d+ of the cells.*fly all of Line"):
        made.publish(flown("less", "Line", without="lmpc"))
    assert (made.NUMBERS.read_bytes(), made.FACTS.read_bytes()) == kept
    made.publish(flown("anew", "Line", start=5))
    assert json.loads(made.FACTS.read_text())["protocol"]["starts"] == {"judging": 5}


def test_every_page_is_in_the_navigation_and_every_entry_of_it_is_a_page():
    listed = re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(listed) == sorted(page.relative_to(ROOT / "docs").as_posix() for page in PAGES[1:])


@pytest.mark.slow
def test_the_site_builds_strictly_and_loads_nothing_from_elsewhere(tmp_path):
    pytest.importorskip("mkdocs", reason="the site needs the extra [docs]")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path)]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    for page in tmp_path.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        loaded = re.findall(r"<(?:script|img|iframe|source)[^>]*\ssrc=[\"']?(https?:[^\"'\s>]+)", text)
        loaded += re.findall(r"<link[^>]*rel=[\"']?stylesheet[^>]*href=[\"']?(https?:[^\"'\s>]+)", text)
        assert not loaded, page
        assert 'class="arithmatex"' not in text, f"{page}: an equation was left as TeX"


def test_pages_get_every_column_of_the_tables():
    page = ROOT / "docs" / "contracts" / "environments.md"
    text = script("hooks").with_tables(page.read_text(encoding="utf-8"))
    for name in ("quadratic_cost", "constraint_cost", "position_rms", "anees", "crashed", "left_model"):
        assert re.search(rf"^\| `{name}` \|", text, re.MULTILINE), name
    files = (ROOT / "docs" / "contracts" / "files.md").read_text(encoding="utf-8")
    assert "| `vx_ref`, `vy_ref`, `vz_ref` | m/s |" in script("hooks").with_tables(files)
    row = next(line for line in text.splitlines() if line.startswith("| `effort`"))
    assert row.count("|") - row.count(r"\|") == 5  # bars of the mathematics end no cell


def test_the_page_on_training_gets_every_hyperparameter_with_its_meaning():
    page = ROOT / "docs" / "tutorial" / "training.md"
    text = script("hooks").with_tables(page.read_text(encoding="utf-8"))
    for name, entry in ALGORITHMS.items():
        table = text.split(f"### {name}\n")[1].split("###")[0]
        for field, comment in field_comments(entry.options).items():
            row = next(line for line in table.splitlines() if line.startswith(f"| `{field}` |"))
            assert row.endswith(f"| {comment} |") and row.count("|") == 4


@pytest.mark.parametrize("kind", [TrainingRequest, BenchmarkRequest])
def test_the_page_on_baselines_gets_the_arguments_of_long_functions(kind):
    page = ROOT / "docs" / "api" / "baselines.md"
    text = script("hooks").with_tables(page.read_text(encoding="utf-8"))
    for field, comment in field_comments(kind).items():
        rows = [line for line in text.splitlines() if line.startswith(f"| `{field}` |")]
        assert comment and any(line.endswith(f"| {comment} |") and line.count("|") == 4 for line in rows)


LAWS = (SdreOptions, LqrOptions, FeedbackLinearizationOptions)


def test_the_page_on_controllers_gets_every_option_with_its_meaning():
    page = ROOT / "docs" / "api" / "controllers.md"
    text = script("hooks").with_tables(page.read_text(encoding="utf-8"))
    for kind in (LmpcOptions, SdcOptions, NmpcOptions, CooperativeOptions, CentralOptions, *LAWS):
        for field, comment in field_comments(kind).items():
            rows = [line for line in text.splitlines() if line.startswith(f"| `{field}` |")]
            assert comment and any(line.endswith(f"| {comment} |") and line.count("|") == 4 for line in rows)


def test_the_readme_can_be_read_in_a_few_minutes():
    # Results grew into it once: 200 lines of 16 words, a third of them digits.
    lines = README.read_text(encoding="utf-8").splitlines()
    full = [line.split() for line in lines if line.strip()]
    assert len(lines) <= 130 and sum(map(len, full)) <= 12 * len(full)


def test_the_gallery_shows_every_id():
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    assert [env_id for env_id in (*TRACKING, *TEAMS) if f"`{env_id}`" not in page] == []


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md"], ids=name_of)
def test_every_link_and_picture_leads_to_a_file(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    targets = [target.partition("#")[0] for target in re.findall(r"\]\(([^)\s]+)\)", text)]
    missing = [t for t in targets if t and not t.startswith("http") and not (page.parent / t).exists()]
    assert missing == []


@reads_sources
@pytest.mark.parametrize("page", ["docs/chapters.md", "CONTRIBUTING.md"])
def test_every_file_that_a_map_of_the_project_names_is_there(page):
    named = re.findall(r"`(\w+/[\w./]*)`", (ROOT / page).read_text(encoding="utf-8"))
    made = {"site/", "dist/"}
    assert len(named) > 8 and [name for name in {*named} - made if not (ROOT / name).exists()] == []


def test_every_extra_is_explained_in_the_readme():
    project = (
        (ROOT / "pyproject.toml").read_text(encoding="utf-8").split("[project.optional-dependencies]")[1]
    )
    extras = re.findall(r"^(\w+) = \[", project.split("[project.scripts]")[0], re.MULTILINE)
    text = README.read_text(encoding="utf-8")
    assert extras and [extra for extra in extras if f"`{extra}`" not in text] == []
