"""The page of a protocol in a browser: two tables, conditions, a frontier, and the answer of each."""
# ruff: noqa: F811  fixtures of another file

import pytest
from pages import browser, show, until  # noqa: F401

from baselines import run_benchmark
from baselines.report.build import build_report, frontier_files
from baselines.sweeps.folder import read_run
from baselines.sweeps.suite import BEST_MPC

SUITE = {
    "name": "bench",
    "protocol": "bench-1",
    "episodes": 6,
    "seed": 10_000,
    "compare_with": BEST_MPC,
    "envs": [
        {"id": f"quad/{name}Tracking-v0", "label": name, "kwargs": {"time_limit": 2.0}}
        for name in ("Helix", "Random")
    ],
    "tables": [{"label": "as derived"}, {"label": "levelled", "about": "the same budget"}],
    "policies": [
        {"name": "lmpc", "tables": ["as derived"]},
        {"name": "lqr", "tables": ["as derived"]},
        {
            "name": "lmpc",
            "tables": ["levelled"],
            "tune": {"seeds": [0, 1], "episodes": 32, "fields": ["R"]},
        },
        {"name": "sdre", "tables": ["levelled"]},
        *(
            {"name": "lmpc", "kwargs": {"R": R}, "conditions": ["nominal"], "trace": "lmpc by R"}
            for R in (1.0, 0.3, 0.1)
        ),
    ],
    "conditions": [{"label": "nominal"}, {"label": "weak", "kwargs": {"kappa": 0.3125}, "envs": ["Helix"]}],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = tmp_path_factory.mktemp("page") / "run"
    run_benchmark(SUITE, found)
    return found


def chips(page):
    return [text.split("\n")[0] for text in page.locator(".chips button").all_inner_texts()]


def test_each_table_has_its_answer_its_policies_and_its_flights(folder):
    env = build_report(read_run(folder)).environments[0]
    derived, levelled = env.boards
    assert (derived.title, levelled.title, levelled.about) == ("as derived", "levelled", "the same budget")
    assert [row.policy for row in derived.rows] == ["lmpc (controller)", "lqr (controller)"]
    assert [row.policy for row in levelled.rows] == ["lmpc, tuned (tuned)", "sdre (controller)"]
    assert derived.answer.sentence.startswith("lmpc ") and derived.answer.pair == ("lmpc", "lqr")
    assert levelled.answer.pair[0] == "lmpc, tuned, seed 0" and env.answer.sentence == ""
    assert set(levelled.names) == {"lmpc, tuned, seed 0", "sdre"}
    assert derived.base == "lmpc (controller)" and levelled.base == "lmpc, tuned (tuned)"


def test_a_page_keeps_one_seed_of_each_contender_and_no_point_of_the_frontier(folder):
    env = build_report(read_run(folder)).environments[0]
    assert {flight.policy for flight in env.flights} == {"lmpc", "lqr", "lmpc, tuned, seed 0", "sdre"}


def test_the_answers_over_all_environments_stand_above_them_one_for_each_table(folder):
    answers = build_report(read_run(folder)).answers
    assert [text.split(":")[0] for text in answers] == ["As derived, nominal", "Levelled, nominal"]
    assert all("Over 2 environments, " in text for text in answers)


def test_the_frontier_stands_in_the_folder_for_each_table_and_environment(folder):
    report = build_report(read_run(folder))
    assert sorted(frontier_files(report)) == sorted(path.name for path in folder.glob("frontier-*.svg"))
    assert len(frontier_files(report)) == 4
    weak = next(env for env in report.environments if env.condition == "weak")
    assert all(board.frontier.svg == "" for board in weak.boards)


def test_an_unfinished_protocol_has_a_page_without_those_whose_seeds_are_missing(folder):
    run = read_run(folder)
    some = run._replace(finished=tuple(one for one in run.finished if "seed 1" not in one.unit.policy.title))
    here = some.environments()[0].here
    assert [one.name for one in some.contenders(here, "levelled")] == ["sdre"]


@pytest.mark.slow
def test_another_table_shows_its_own_answer_board_and_flights(show):
    page = show()
    said = page.locator("#answer").inner_text()
    assert said.startswith("lmpc ") and chips(page) == ["lmpc", "lqr"]
    assert "protocol bench-1, definition" in page.locator("#facts").inner_text()
    assert page.locator("#answers p").count() == 2
    page.get_by_role("button", name="levelled").click()
    until(page, "document.querySelector('.chips button').textContent.includes('tuned')")
    assert (
        page.locator("#answer").inner_text() != said
        and "the same budget" in page.locator("#board-lede").inner_text()
    )
    assert chips(page) == ["lmpc, tuned, seed 0", "sdre"]
    assert page.locator("#board tbody tr").count() == 2
    page.locator("#policies summary").click()
    assert page.locator("#policies-board tbody tr").count() == 8  # every policy and seed


@pytest.mark.slow
def test_conditions_are_chosen_below_environments_and_the_table_stays(show):
    page = show()
    page.get_by_role("button", name="levelled").click()
    assert page.locator("#environments button").all_inner_texts() == ["Helix", "Random"]
    assert page.locator("#conditions button").all_inner_texts() == ["nominal", "weak"]
    assert page.locator("#frontier .frontier").is_visible()
    page.locator("#conditions button", has_text="weak").click()
    assert page.locator("#conditions button[aria-current=true]").inner_text() == "weak"
    assert not page.locator("#frontier").is_visible()
    until(page, "document.querySelector('.chips button').textContent.includes('tuned')")
    page.locator("#environments button", has_text="Random").click()
    assert page.locator("#conditions button").count() == 0  # one condition is no choice
    assert page.evaluate("document.documentElement.scrollWidth") == 1440


@pytest.mark.slow
def test_colours_of_flights_are_those_of_their_rows(show):
    page = show()
    page.get_by_role("button", name="levelled").click()
    until(page, "document.querySelector('.chips button').textContent.includes('tuned')")
    own = "(parts) => parts.map((part) => getComputedStyle(part).getPropertyValue('--own'))"
    rows = page.locator("#board tbody tr th").evaluate_all(own)
    assert sorted(rows) == sorted(page.locator(".chips button").evaluate_all(own))
