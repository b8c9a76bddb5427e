"""The report of a results folder: safe, small, complete, and honest about what it lacks."""

from __future__ import annotations

import json
import re
import shutil
import webbrowser
from pathlib import Path

import numpy as np
import pytest

import baselines.cli.report
import baselines.report.build
from baselines import ResultsError, run_benchmark
from baselines.__main__ import main
from baselines.report import Choice, build_report, render_report
from baselines.report.flights import BadFlightError, read_flight
from baselines.report.page import embed, render_page
from baselines.report.quantise import Blobs, decode, encode
from baselines.report.shelf import _PER_FLIGHT
from baselines.sweeps.folder import read_run
from baselines.sweeps.store import cells_of
from baselines.sweeps.sweep import REPORTED

EVIL = "</script><script>alert('{{style}}')</script><!--"
HELIX, TEAM = "quad/HelixTracking-v0", "team of 3"
SUITE = {
    "name": "evil <b>name</b>",
    "episodes": 3,
    "seed": 5,
    "envs": [
        {"id": HELIX, "kwargs": {"tilt_limit": 0.5}, "label": HELIX},
        {"id": "quad/TargetTracking-v0", "kwargs": {"vehicles": 3, "formation": "lattice"}, "label": TEAM},
    ],
    "policies": [
        "hover",
        {"name": "random", "label": EVIL},
        {"name": "cooperative-mpc", "envs": [TEAM], "kwargs": {"horizon": 5}, "label": "mpc"},
    ],
}


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """A results folder."""
    folder = tmp_path_factory.mktemp("report") / "run"
    run_benchmark(SUITE, folder)
    return folder


@pytest.fixture
def copied(finished, tmp_path):
    """A results folder to damage."""
    return Path(shutil.copytree(finished, tmp_path / "copy"))


def data_of(page):
    """The data that stand in a page."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.S)
    return json.loads(found[1])


def bare_bytes(folder):
    """Size of the page without its flights."""
    report = build_report(read_run(folder))
    environments = tuple(env._replace(flights=()) for env in report.environments)
    return len(render_page(report._replace(environments=environments, blobs=())).encode())


def a_flight(run):
    """First unit with its first saved flight: path, records."""
    one = run.finished[0]
    seed, team = next(iter(one.flights().items()))
    return one, one.episode_file(seed), team


def shortened(path, steps):
    """Cut a stored flight of one vehicle after some steps, as if it had crashed there."""
    with np.load(path) as file:
        arrays = {key: file[key] for key in file.files}
    longer = ("states", "references")
    whole = ("fallbacks",)
    np.savez_compressed(
        path,
        **{k: v if k in whole else v[: steps + 1] if k in longer else v[:steps] for k, v in arrays.items()},
    )


def test_a_sweep_leaves_a_page_with_every_environment_policy_and_start(finished):
    data = data_of((finished / "report.html").read_text("utf-8"))
    assert [env["title"] for env in data["environments"]] == [HELIX, TEAM]
    assert [row["policy"] for row in data["environments"][1]["rows"]] == ["hover", EVIL, "mpc"]
    for env in data["environments"]:
        flown = {(flight["policy"], flight["seed"]) for flight in env["flights"]}
        assert flown == {(row["policy"], seed) for row in env["rows"] for seed in (5, 6)}
    assert data["notes"] == [] and len(list((finished / "episodes").iterdir())) == 5 * REPORTED


def test_the_page_says_how_to_repeat_the_run(finished):
    run = data_of((finished / "report.html").read_text("utf-8"))["run"]
    assert run["versions"]["numpy"] == np.__version__ and run["command"]
    assert (run["first_seed"], run["last_seed"], run["episodes"]) == (5, 7, 3)
    task = data_of((finished / "report.html").read_text("utf-8"))["environments"][0]["task"]
    assert task["limits"]["tilt"] == 0.5 and task["limits"]["velocity"] is None and task["dt"] == 0.05


def test_the_leaderboard_has_the_numbers_of_the_summary_with_their_intervals(finished):
    run = read_run(finished)
    summary = {row["policy"]: row for flown in run.environments()[:1] for row in flown.results.summary()}
    env = build_report(run).environments[0]
    for row in env.rows:
        for column in ("score", "effort", "violation_share", "score_minus_base"):
            assert row.cells[column][0] == pytest.approx(summary[row.policy][column], rel=1e-6)
            assert row.cells[column][1] is None  # three flights have no interval
    crashed = next(row for row in env.rows if row.policy == EVIL)
    assert crashed.cells["crashed"][0] == 3 and crashed.cells["quadratic_cost"] == (None, None)


def test_no_name_can_leave_its_place_in_the_page(finished):
    page = (finished / "report.html").read_text("utf-8")
    assert EVIL not in page and "<title>evil &lt;b&gt;name&lt;/b&gt; ·" in page
    assert page.count("<script") == page.count("</script>") == 2 and page.count("<style>") == 1
    assert data_of(page)["environments"][0]["rows"][1]["policy"] == EVIL


def test_embedded_json_reads_back_and_holds_no_markup():
    value = {"<!--": "</SCRIPT>&amp;\u2028", "]]>": EVIL}
    text = embed(json.dumps(value))
    assert json.loads(text) == value and not set("<>&") & set(text)


def test_the_page_allows_its_own_style_and_script_and_nothing_else(finished):
    page = (finished / "report.html").read_text("utf-8")
    policy = re.search(r'Content-Security-Policy" content="(.*?)"', page)[1]
    assert policy.startswith("default-src 'none'; style-src 'sha256-") and "unsafe" not in policy
    own = page.replace("http://www.w3.org/2000/svg", "")  # a name, nothing that is fetched
    assert "http:" not in own and "https:" not in own and "@import" not in own


@pytest.mark.parametrize("log", [False, True])
def test_quantised_series_read_back_within_half_a_step(log):
    rng = np.random.default_rng(0)
    x = 10.0 ** rng.uniform(-3.0, 3.0, (2, 40, 3)) if log else rng.normal(0.0, 5.0, (2, 40, 3))
    x[1, 30:] = np.nan
    blobs = Blobs()
    channel = encode("x", x, blobs, log=log)
    back = decode(channel, blobs.texts()[channel.blob])
    if log:
        x, back = np.log10(x), np.log10(back)
    # Half of a step of the 65534 between the extremes; 1e-9 for the rounding of the arithmetic.
    np.testing.assert_allclose(back, x, atol=0.5 * (channel.high - channel.low) / 65534 + 1e-9)


def test_a_constant_series_and_one_of_nothing_but_nan_read_back():
    blobs = Blobs()
    for value in (2.5, np.nan):
        channel = encode("x", np.full((1, 4, 1), value), blobs)
        np.testing.assert_array_equal(decode(channel, blobs.texts()[channel.blob]), np.full((1, 4, 1), value))


def test_a_flight_in_the_page_is_the_flight_that_was_flown(finished):
    one, path, team = a_flight(read_run(finished))
    blobs = Blobs()
    flight = read_flight(path, "hover", team, one.task, blobs)
    tables = {channel.name: decode(channel, blobs.texts()[channel.blob]) for channel in flight.channels}
    with np.load(path) as arrays:
        expected = {"p": arrays["states"][:, :3], "attitude": arrays["states"][:, 6:9]}
        expected |= {"reference": arrays["references"][:, :3], "constraints": arrays["constraint_values"]}
        for name, table in expected.items():
            # Half a quantisation step of what spans at most 100 m.
            np.testing.assert_allclose(tables[name][0], table, atol=8e-4, err_msg=name)
    assert flight.lengths == (200,) and flight.seed == 5 and not flight.crashed[0]


def test_the_belief_of_a_team_stands_in_the_page_with_its_honesty(finished):
    run = read_run(finished)
    one = run.finished[-1]
    team = one.flights()[5]
    blobs = Blobs()
    path = one.episode_file(5)
    flight = read_flight(path, "mpc", team, one.task, blobs)
    tables = {channel.name: decode(channel, blobs.texts()[channel.blob]) for channel in flight.channels}
    with np.load(path) as arrays:
        error, P = arrays["estimate_error"][..., :3], arrays["estimate_covariance"][..., :3, :3]
        nees = np.einsum("...i,...ij,...j", error, np.linalg.inv(P), error)
        truth = arrays["target"][:, :3]
        graph = arrays["graphs"][0]
    # A step of the logarithm over six decades at most: 0.03 %.
    np.testing.assert_allclose(tables["nees"][..., 0], np.maximum(nees, 1e-6), rtol=1e-3)
    np.testing.assert_allclose(tables["estimate"], error + truth[None, :-1], atol=1e-3)
    L = np.zeros((*P.shape[:-2], 3, 3))
    L[..., [0, 1, 1, 2, 2, 2], [0, 0, 1, 0, 1, 2]] = tables["root"]
    np.testing.assert_allclose(L @ L.swapaxes(-1, -2), P, atol=2e-3)  # m^2, of 9 at the start
    links = {(int(i), int(j)) for i, j in np.argwhere(graph > 0.0) if i != j}
    assert set(flight.graphs[0]) == links and flight.schedule[0] == (0, 0)


def test_policies_that_fly_from_one_start_share_their_reference(finished):
    report = build_report(read_run(finished))
    numbers = [
        channel.blob
        for flight in report.environments[1].flights
        if flight.seed == 5 and len(set(flight.lengths)) == 1 and flight.lengths[0] == 400
        for channel in flight.channels
        if channel.name == "reference"
    ]
    assert len(numbers) == 2 and len(set(numbers)) == 1


def test_a_missing_and_a_truncated_flight_are_named_and_the_rest_is_shown(copied):
    first, second = sorted((copied / "episodes").iterdir())[:2]
    first.unlink()
    second.write_bytes(second.read_bytes()[:1000])
    report = build_report(read_run(copied))
    assert f"episodes/{first.name} is missing: this flight is not shown" in report.notes[0]
    assert second.name in report.notes[1] and "damaged" in report.notes[1]
    assert len(report.environments[0].flights) == 2 and len(report.environments[1].flights) == 6


@pytest.mark.parametrize("content", [b"", b"PK", b"not a zip file"])
def test_a_file_that_is_no_flight_is_named(copied, content):
    one, path, team = a_flight(read_run(copied))
    path.write_bytes(content)
    with pytest.raises(BadFlightError, match=path.name):
        read_flight(path, "hover", team, one.task, Blobs())


def test_pickled_objects_in_a_flight_are_never_loaded(copied):
    one, path, team = a_flight(read_run(copied))
    np.savez(path, states=np.array([{"a": 1}], dtype=object))
    with pytest.raises(BadFlightError, match="damaged"):
        read_flight(path, "hover", team, one.task, Blobs())


def test_a_flight_that_crashed_in_its_first_step_is_shown(copied):
    one, path, team = a_flight(read_run(copied))
    shortened(path, 1)
    flight = read_flight(path, "hover", [team[0]._replace(crashed=True, steps=1)], one.task, Blobs())
    assert flight.lengths == (1,) and flight.crashed == (True,)
    assert {channel.name: channel.rows for channel in flight.channels}["p"] == 2


def test_one_flight_of_one_policy_makes_a_page(tmp_path):
    suite = SUITE | {"episodes": 1, "envs": [HELIX], "policies": ["hover"]}
    run_benchmark(suite, tmp_path)
    env = data_of((tmp_path / "report.html").read_text("utf-8"))["environments"][0]
    assert len(env["flights"]) == 1 and env["rows"][0]["cells"]["score"][1] is None
    assert not [column for column in env["columns"] if column["kind"] == "difference"]


def test_ten_thousand_flights_make_a_page_below_3_mb(copied):
    run = read_run(copied)
    (path,) = [cell.path for cell in cells_of(copied, run.finished[0].unit)]
    cell = json.loads(path.read_text())
    record = cell["found"]["records"][0]
    cell["found"]["records"] = [record | {"seed": 5 + i} for i in range(10_000)]
    cell["flights_saved"] = 10_000
    path.write_text(json.dumps(cell))
    config = json.loads((copied / "config.json").read_text())
    config["suite"]["episodes"] = 10_000
    (copied / "config.json").write_text(json.dumps(config))
    page = render_report(read_run(copied))
    assert len(page) < 3e6
    assert data_of(page)["notes"][-1].endswith("more flights are missing or damaged.")
    assert len(data_of(page)["notes"]) < 20


def test_a_full_page_leaves_later_starts_out_and_says_so(finished, monkeypatch):
    room = sum(map(len, build_report(read_run(finished)).blobs)) + 10 * _PER_FLIGHT - 1
    monkeypatch.setattr(baselines.report.build, "PAGE_BYTES", bare_bytes(finished) + room)
    report = build_report(read_run(finished))
    assert [len({f.seed for f in env.flights}) for env in report.environments] == [2, 1]
    assert report.notes[0].startswith("3 more saved flights are not in this page")
    assert sum(map(len, report.blobs)) < room


def test_a_page_too_small_for_one_start_of_each_environment_takes_fewer_samples(finished, monkeypatch):
    size = sum(map(len, build_report(read_run(finished)).blobs))
    monkeypatch.setattr(baselines.report.build, "PAGE_BYTES", bare_bytes(finished) + size // 3)
    report = build_report(read_run(finished))
    stride = round(report.environments[0].flights[0].dt / 0.05)
    assert stride in (2, 4) and f"one sample in {stride}" in report.notes[0]
    assert all(env.flights for env in report.environments)


def test_contenders_stand_in_the_page_where_networks_were_trained(copied):
    title, *_ = (flown.env.title for flown in read_run(copied).environments())
    columns = "env,condition,policy,kind,score,iqm,iqm_low,iqm_high,base,crashed,training_cpu_s"
    row = f"{title},,ppo,model-free,0.5,0.6,0.55,0.65,lmpc,1,"
    (copied / "contenders.csv").write_text(f"{columns}\n{row}\n")
    first, second = build_report(read_run(copied)).environments
    (board,) = first.boards
    assert board.rows[0].policy == "ppo (model-free)" and second.boards == ()
    assert board.rows[0].cells["iqm"] == (0.6, 0.55, 0.65)
    assert [column.key for column in board.columns] == ["score", "crashed", "iqm"]


def test_a_run_that_is_not_complete_makes_a_page_that_says_so(copied):
    cells_of(copied, read_run(copied).finished[0].unit)[0].path.unlink()
    report = build_report(read_run(copied))
    assert "4 of 5 units" in report.notes[0]
    assert report.environments[0].base == EVIL  # the base of the suite has not been flown there


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": None}, "results of format 1, written by quad-envs"),
        ({"format": 99}, "results of format 99"),
        ({"suite": None}, "is not that of a results folder"),
        ({"suite": {"name": "x"}}, "is not valid"),
    ],
)
def test_results_that_this_version_cannot_read_are_refused(copied, change, message):
    config = json.loads((copied / "config.json").read_text()) | change
    (copied / "config.json").write_text(json.dumps({k: v for k, v in config.items() if v is not None}))
    with pytest.raises(ResultsError, match=re.escape(message)):
        read_run(copied)


def test_a_folder_without_results_is_refused_with_what_to_do(tmp_path):
    with pytest.raises(ResultsError, match=r"has no config\.json; make one with"):
        read_run(tmp_path)
    with pytest.raises(ResultsError, match="does not exist"):
        read_run(tmp_path / "none")


def test_a_cell_of_something_else_is_named(copied):
    path = sorted((copied / "cells").iterdir())[0]
    path.write_text("{}")
    with pytest.raises(ResultsError, match="delete it to fly this unit again"):
        read_run(copied)


def test_report_makes_the_page_again_and_prints_its_path(copied, capsys):
    page = copied / "report.html"
    before = page.read_text("utf-8")
    page.unlink()
    assert main(["report", str(copied)]) == 0
    assert capsys.readouterr().out.strip() == str(page) and page.read_text("utf-8") == before


def test_a_folder_that_cannot_be_written_gets_a_line_and_a_way_out(copied, tmp_path, capsys, monkeypatch):
    refuse_writing(monkeypatch, copied)
    assert main(["report", str(copied)]) == 2
    said = capsys.readouterr().err
    assert "Read-only file system; name another file with --out FILE" in said
    assert main(["report", str(copied), "--out", str(tmp_path / "page.html")]) == 0
    assert (tmp_path / "page.html").is_file()


def refuse_writing(monkeypatch, folder):
    """Make a folder read-only for us, who may be root."""
    real = baselines.files.open if hasattr(baselines.files, "open") else open

    def refuse(path, mode="r", *rest, **more):
        if "w" in mode and Path(path).is_relative_to(folder):
            raise OSError(30, "Read-only file system", str(path))
        return real(path, mode, *rest, **more)

    monkeypatch.setattr(baselines.files, "open", refuse, raising=False)


def test_replay_holds_the_chosen_flight_and_opens_it(copied, capsys, monkeypatch):
    opened = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(webbrowser, "open", lambda url: opened.append(url) or True)
    assert main(["replay", str(copied), "--env", TEAM, "--seed", "6", "--policy", "mpc"]) == 0
    page = Path(capsys.readouterr().out.strip())
    assert opened == [page.as_uri()] and page == copied / "replay.html"
    data = data_of(page.read_text("utf-8"))
    assert data["open"] == {"env": TEAM, "seed": 6, "policy": "mpc"}
    assert {flight["seed"] for env in data["environments"] for flight in env["flights"]} == {6}


def test_replay_without_a_display_prints_where_the_page_is(copied, capsys, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(baselines.cli.report.sys, "platform", "linux")
    refuse_writing(monkeypatch, copied)
    assert main(["replay", str(copied)]) == 0
    printed, said = capsys.readouterr()
    assert "no browser" in said and Path(printed.strip()).is_file() and not printed.startswith(str(copied))
    shutil.rmtree(Path(printed.strip()).parent)


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        (Choice(env="quad/HelixTracing-v0"), "did you mean 'quad/HelixTracking-v0'"),
        (Choice(env=HELIX, seed=7), "no flight with seed 7 is saved"),
        (Choice(env=HELIX, policy="hovr"), "did you mean 'hover'"),
    ],
)
def test_what_cannot_be_replayed_is_refused(finished, choice, message):
    with pytest.raises(ResultsError, match=re.escape(message)):
        build_report(read_run(finished), choice)


def test_a_title_that_looks_like_a_mark_of_the_template_stays_a_title(finished):
    report = build_report(read_run(finished))._replace(title="{{data}} {{script}}")
    page = render_page(report)
    assert "<title>{{data}} {{script}} ·" in page and page.count("<script") == 2
