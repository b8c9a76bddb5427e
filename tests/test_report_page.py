"""The report in a browser, headless Chromium: it plays, scrubs, sorts, compares, and loads nothing."""
# ruff: noqa: F811  fixtures of another file

from __future__ import annotations

import json
import re
import shutil
import subprocess
from importlib import resources

import numpy as np
import pytest
from pages import browser, show, until  # noqa: F401

from baselines import run_benchmark
from baselines.report import Choice, render_report
from baselines.sweeps.folder import read_run
from baselines.sweeps.store import cells_of

pytestmark = pytest.mark.slow

HELIX, CORRIDOR, TEAM = "quad/HelixTracking-v0", "quad/CorridorTracking-v0", "a team"
EVIL = "</script><img src=x onerror=alert(1)>"
SUITE = {
    "name": "seen",
    "episodes": 3,
    "seed": 0,
    "compare_with": "lqr",
    "envs": [
        CORRIDOR,
        HELIX,
        {"id": "quad/TargetTracking-v0", "kwargs": {"vehicles": 3, "formation": "triangle"}, "label": TEAM},
    ],
    "policies": [
        {"name": "lqr", "envs": [CORRIDOR, HELIX]},
        {"name": "feedback-linearization", "envs": [CORRIDOR, HELIX]},
        {"name": "hover", "envs": [CORRIDOR, HELIX, TEAM], "label": EVIL},
        {"name": "cooperative-mpc", "envs": [TEAM], "kwargs": {"horizon": 5}},
    ],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = tmp_path_factory.mktemp("page") / "run"
    run_benchmark(SUITE, found)
    return found


def ink(page, selector="#panes canvas"):
    """Number of painted pixels of the first canvas, and a sum that changes with the picture."""
    return page.evaluate(
        """(selector) => {
        const canvas = document.querySelector(selector);
        const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
        let [count, sum] = [0, 0];
        for (let i = 0; i < data.length; i += 4) {
          if (data[i + 3]) count += 1;
          sum = (sum + (i % 8191) * (data[i] + 2 * data[i + 1] + 3 * data[i + 2] + data[i + 3])) % 1e9;
        }
        return [count, sum];
        }""",
        selector,
    )


def clock(page):
    return float(page.locator("#clock").inner_text().split("/")[0])


def boxes(page, selector):
    return [one.bounding_box() for one in page.locator(selector).all()]


def test_the_page_opens_on_the_answer_then_the_flight_then_six_columns_then_the_rest(show):
    page = show()
    assert "leads with a score of" in page.locator("#answer").inner_text()
    tops = [boxes(page, name)[0]["y"] for name in ("#answer", "#panes", "#board", "#more", "#run")]
    assert tops == sorted(tops) and tops[1] < 1000
    columns = page.locator("#board thead th").count()
    assert columns <= 1 + 6 < page.locator("#board-more thead th").count()
    for key in ("score", "score_minus_base", "violation_share", "crashed", "decision_p50_ms"):
        assert page.locator(f'#board th[data-key="{key}"]').count() == 1


def test_the_flight_plays_around_the_moment_of_the_largest_difference_until_one_chooses_a_time(show):
    page = show(still=False)
    assert page.get_by_label("View").input_value() == "reference"
    assert page.locator("#play").get_attribute("aria-label") == "Pause"
    begin, seen = clock(page), set()
    for _ in range(40):
        page.wait_for_timeout(100)
        seen.add(clock(page))
    assert len(seen) > 5 and max(seen) - min([begin, *seen]) < 2.7  # 1.5 s before to 1 s after
    page.locator("#scrub").fill("0")
    page.locator("#play").click()
    page.keyboard.press("End")
    assert clock(page) > max(seen)
    page.locator("#reset").click()
    assert page.get_by_label("View").input_value() == ""


def test_who_wants_no_motion_sees_the_moment_at_rest(show):
    page = show(still=False, reduced_motion="reduce")
    assert page.locator("#play").get_attribute("aria-label") == "Play"
    before = clock(page)
    page.wait_for_timeout(300)
    assert clock(page) == before > 0.0


def test_three_policies_side_by_side_are_all_seen_at_once(show):
    page = show(height=900)
    page.locator(".chips button[aria-pressed=false]").click()
    page.get_by_role("button", name="Side by side").click()
    until(page, "document.querySelectorAll('#panes canvas').length === 3")
    page.locator("#panes").scroll_into_view_if_needed()
    found = boxes(page, "#panes canvas")
    assert len(found) == 3 and found[-1]["y"] + found[-1]["height"] - found[0]["y"] < 700
    for k in (1, 2, 3):
        assert ink(page, f".pane:nth-child({k}) canvas")[0] > 500


def test_readouts_have_the_decimals_of_their_unit(show):
    page = show()
    page.locator("#scrub").fill("3")
    readouts = page.locator(".plot .readout").all_inner_texts()
    assert re.fullmatch(r"(\d+\.\d{3}\s*)+", readouts[0])  # m
    assert re.fullmatch(r"(\u2212?\d+\.\d{2}\s*)+", readouts[1])  # N
    assert re.fullmatch(r"(\u2212?\d+\.\d\s*)+", readouts[2])  # degrees


def test_a_flight_far_off_leaves_the_axis_and_does_not_flatten_the_others(show):
    page = show()
    page.locator("#environments button", has_text="HelixTracking").click()
    page.get_by_role("button", name=EVIL).click()
    until(page, "document.querySelectorAll('.chips button[aria-pressed=true]').length !== 2")
    if page.locator(".chips button[aria-pressed=true]").count() == 1:
        page.get_by_role("button", name=EVIL).click()
    until(page, "document.querySelector('.plot h3 small').textContent.includes('leaves the axis')")
    assert EVIL in page.locator(".plot h3 small").first.inner_text()


def test_the_ground_lies_below_the_lowest_point_that_is_flown():
    source = "".join(
        resources.files("baselines.report").joinpath("page", name).read_text("utf-8")
        for name in ("camera.js", "scene.js")
    )
    code = f"""{source}
    const task = {{ limits: {{ position_lower: [null, null, null], position_upper: [null, null, null] }} }};
    const rows = (z) => [[0, 0], [0, 0], z].map((values) => Float32Array.from(values));
    const flight = {{ tables: {{ p: [rows([0, 7])], reference: [rows([0, 1])] }}, lengths: [1] }};
    const scene = new Scene(null, null, {{ task }});
    scene.show([{{ flight }}], extent([flight], task));
    console.log(scene.floor);"""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs node")
    said = subprocess.run([node, "-e", code], capture_output=True, text=True, check=True)
    assert float(said.stdout) > 7.0


def test_the_frontier_shows_the_family_of_an_mpc_and_who_is_near_it(show, folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "run")
    names = "table env condition policy kind trace base score score_low score_high quadratic_cost crashed"
    rows = [
        f",{HELIX},,{name},{kind},{trace},lqr,{score},{low},{high},{cost},0"
        for name, kind, trace, score, low, high, cost in (
            ("floor 1", "controller", "by floor", 0.80, "", "", 260),
            ("floor 0.1", "controller", "by floor", 0.84, "", "", 320),
            ("lqr", "controller", "", 0.79, 0.78, 0.80, 270),
            ("ppo", "model-free", "", 0.81, 0.80, 0.82, 330),
            ("lost", "model-free", "", 0.01, 0.01, 0.01, ""),
        )
    ]
    (copy / "contenders.csv").write_text("\n".join([names.replace(" ", ","), *rows, ""]))
    path = tmp_path / "page.html"
    path.write_text(render_report(read_run(copy)), "utf-8")
    page = show(path)
    assert not page.locator("#frontier").is_visible()
    page.locator("#environments button", has_text="HelixTracking").click()
    assert page.locator(".frontier .step").count() == 2 and page.locator(".frontier .point").count() == 2
    assert page.locator(".frontier .name").all_text_contents() == ["ppo", "lqr"]
    assert "lost" in page.locator("#frontier-note").inner_text()
    assert page.locator("#board tbody tr").count() == 3  # points of the family stand in the picture alone


def test_the_first_environment_is_shown_with_two_policies_in_space_and_time(show):
    page = show()
    assert page.locator("#environments button[aria-current=true]").inner_text() == "CorridorTracking"
    assert page.locator("#board tbody tr").count() == 3
    assert page.locator(".chips button[aria-pressed=true]").count() == 2
    titles = page.locator(".plot h3").all_inner_texts()
    for what in ("Position error", "Rotor forces", "Attitude", "Limit: tilt", "Limit: rate", "Decision time"):
        assert any(title.startswith(what) for title in titles), what
    assert ink(page)[0] > 1000 and ink(page, ".plot canvas")[0] > 500


def test_play_moves_the_clock_and_the_picture_and_pauses(show):
    page = show()
    before = ink(page)
    page.locator("#play").click()
    until(page, "Number(document.getElementById('scrub').value) > 0.2")
    page.locator("#play").click()
    stopped = clock(page)
    assert ink(page) != before and stopped > 0.2
    page.wait_for_timeout(200)
    assert clock(page) == stopped


def test_the_whole_viewer_is_used_by_keyboard(show):
    page = show()
    page.locator("#panes canvas").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    assert clock(page) == pytest.approx(0.1)
    page.keyboard.press("ArrowLeft")
    assert clock(page) == pytest.approx(0.05)
    page.keyboard.press("End")
    assert clock(page) > 0.05
    page.keyboard.press("Home")
    assert clock(page) == 0.0
    before = ink(page)
    page.keyboard.press("Shift+ArrowRight")
    turned = ink(page)
    page.keyboard.press("+")
    assert before != turned != ink(page)
    page.keyboard.press("Space")
    until(page, "Number(document.getElementById('scrub').value) > 0.05")
    page.keyboard.press("Space")
    assert page.locator("#play").get_attribute("aria-label") == "Play"


def test_scrubbing_moves_the_cursor_of_every_plot(show):
    page = show()
    page.locator("#scrub").fill("5")
    assert clock(page) == pytest.approx(5.0)
    moved = page.locator(".plot .cursor:not(.ghost)").evaluate_all(
        "(lines) => lines.map((line) => line.style.transform)"
    )
    assert len(moved) > 4 and len(set(moved)) == 1 and moved[0] != "translateX(46px)"


def test_hovering_a_plot_shows_its_values_and_pressing_seeks(show):
    page = show()
    field = page.locator(".plot .field").first
    field.scroll_into_view_if_needed()
    box = field.bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 50)
    tip = page.locator(".plot .tip").first
    assert tip.evaluate("(tip) => tip.style.visibility") == "visible" and " s" in tip.inner_text()
    assert page.locator(".cursor.ghost").nth(2).evaluate("(line) => line.style.visibility") == "visible"
    assert clock(page) == 0.0
    page.mouse.down()
    page.mouse.up()
    assert clock(page) > 1.0
    page.mouse.move(5, 5)
    assert tip.evaluate("(tip) => tip.style.visibility") == "hidden"


def test_dragging_orbits_and_the_wheel_zooms(show):
    page = show()
    canvas = page.locator("#panes canvas")
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    x, y = box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]
    standing = ink(page)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 80, y + 20)
    page.mouse.up()
    turned = ink(page)
    page.mouse.wheel(0, -300)
    page.wait_for_timeout(100)
    assert standing != turned != ink(page)
    page.locator("#reset").click()
    assert ink(page) == standing


def test_up_in_the_world_is_up_on_the_screen_and_nothing_is_mirrored(show):
    page = show()
    source = resources.files("baselines.report").joinpath("page", "camera.js").read_text("utf-8")
    centre, above, east = page.evaluate(  # through the debugger, whom the page's policy does not bind
        """(source) => {
        const camera = new (eval.call(null, source + "; Camera"))();
        camera.fit([-1, -1, -1], [1, 1, 1]);
        [camera.azimuth, camera.elevation] = [Math.PI, 0];
        const project = camera.projector(400, 400);
        return [[0, 0, 0], [0, 0, -0.5], [0, 0.5, 0]].map((point) => project(point));
        }""",
        source,
    )
    # From the south, looking north: up is up, and east is on the right.
    assert above[1] < centre[1] - 10 and abs(above[0] - centre[0]) < 1
    assert east[0] > centre[0] + 10 and abs(east[1] - centre[1]) < 1


def test_the_leaderboard_sorts_by_click_and_by_keyboard(show):
    page = show()
    page.locator("#more summary").click()
    column = page.locator('#board-more th[data-key="effort"]')
    index = page.locator("#board-more thead th").all_inner_texts().index(column.inner_text())

    def values():
        cells = page.locator(f"#board-more tbody tr > :nth-child({index + 1})").all_inner_texts()
        return [float(cell.split("±")[0]) for cell in cells]

    column.locator("button").click()
    assert column.get_attribute("aria-sort") == "ascending" and values() == sorted(values())
    column.locator("button").focus()
    page.keyboard.press("Enter")
    assert column.get_attribute("aria-sort") == "descending"
    assert values() == sorted(values(), reverse=True)
    assert page.locator('#board-more th[data-key="score"]').get_attribute("aria-sort") is None


def test_policies_are_overlaid_or_stand_side_by_side_and_turn_together(show):
    page = show()
    page.locator("#environments button", has_text="HelixTracking").click()
    until(page, "document.querySelectorAll('.chips button').length === 3")
    assert page.locator("#panes canvas").count() == 1
    page.get_by_role("button", name="Side by side").click()
    until(page, "document.querySelectorAll('#panes canvas').length === 2")
    one = ink(page, ".pane:nth-child(1) canvas"), ink(page, ".pane:nth-child(2) canvas")
    page.locator("#panes canvas").first.focus()
    page.keyboard.press("Shift+ArrowLeft")
    two = ink(page, ".pane:nth-child(1) canvas"), ink(page, ".pane:nth-child(2) canvas")
    assert one[0] != two[0] and one[1] != two[1]
    page.locator(".chips button[aria-pressed=false]").click()
    until(page, "document.querySelectorAll('#panes canvas').length === 3")


def test_another_start_shows_another_flight(show):
    page = show()
    before = ink(page)
    page.get_by_label("Start").first.select_option("1")
    page.wait_for_timeout(300)
    assert ink(page) != before


def test_a_team_has_its_separation_its_estimates_and_their_honesty(show):
    page = show()
    page.locator("#environments button", has_text=TEAM).click()
    until(page, "document.querySelector('.plot h3').textContent.startsWith('Formation error')")
    titles = page.locator(".plot h3").all_inner_texts()
    for what in ("Nearest vehicle", "Error of the estimated position", "NEES", "Limit: separation"):
        assert any(title.startswith(what) for title in titles), what
    page.get_by_label("View").select_option("target")
    page.get_by_label("Plots of").select_option("1")
    until(page, "document.querySelectorAll('.plot').length > 5")
    assert "ellipsoids" in page.locator("#legend").inner_text()


def test_the_page_is_dark_or_light_as_the_system_and_as_the_button_says(show):
    def paper(page):
        return page.evaluate("getComputedStyle(document.body).backgroundColor")

    light, dark = show(color_scheme="light"), show(color_scheme="dark")
    assert paper(light) == "rgb(255, 255, 255)" and paper(dark) == "rgb(18, 21, 26)"
    light.locator("#theme").click()
    assert paper(light) == paper(dark) and light.locator("#theme").inner_text() == "Light"


def test_a_phone_sees_the_whole_width_and_only_the_table_scrolls(show):
    page = show(width=390, height=844, has_touch=True, is_mobile=True)
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    page.locator("#more summary").click()
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    assert page.evaluate("document.getElementById('board-more').scrollWidth") > 390
    small = page.evaluate(
        "[...document.querySelectorAll('.transport button, .chips button, .choices select')]"
        ".filter((part) => part.offsetParent && part.getBoundingClientRect().height < 32).length"
    )
    assert small == 0


def test_names_are_shown_as_they_are(show):
    page = show()
    assert EVIL in page.locator("#board tbody").inner_text()
    assert page.locator("#board img").count() == 0


def test_a_replay_opens_on_its_flight(show, folder, tmp_path):
    path = tmp_path / "replay.html"
    path.write_text(render_report(read_run(folder), Choice(env=TEAM, policy=EVIL, seed=1)), "utf-8")
    page = show(path)
    assert page.locator(".chips button[aria-pressed=true]").inner_text().startswith(EVIL)
    assert page.get_by_label("Start").first.input_value() == "1"


def test_contenders_have_a_table_of_their_own(show, folder, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "run")
    columns = (
        "env,condition,policy,kind,base,score,score_minus_base,score_minus_base_low,score_minus_base_high"
    )
    rows = [f"{HELIX},,lqr,controller,lqr,0.5,0,0,0", f"{HELIX},,ppo,model-free,lqr,0.7,0.2,0.15,0.25"]
    (copy / "contenders.csv").write_text("\n".join([columns, *rows, ""]))
    path = tmp_path / "page.html"
    path.write_text(render_report(read_run(copy)), "utf-8")
    page = show(path)
    assert not page.locator("#policies").is_visible()
    page.locator("#environments button", has_text="HelixTracking").click()
    text = page.locator("#board tbody").inner_text()
    assert page.locator("#policies").is_visible()
    assert (
        "NaN" not in text
        and text.startswith("ppo (model-free)")
        and "▲ +0.20[0.15, 0.25]" in text
        and "base" in text
    )


def test_after_a_crash_there_are_no_values(show):
    page = show()
    page.locator(".chips button", has_text="feedback-linearization").click()
    until(page, "document.querySelectorAll('.chips button[aria-pressed=true]').length === 3")
    page.locator("#scrub").fill("10")
    assert "\u2013" in page.locator(".plot .readout").first.inner_text()


def test_a_flight_that_ended_in_its_first_step_is_shown(show, folder, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(folder, copy)
    run = read_run(copy)
    one = run.finished[0]
    path = one.episode_file(0)
    with np.load(path) as file:
        arrays = {key: file[key] for key in file.files}
    rows = {"states": 2, "references": 2, "fallbacks": None}
    np.savez(path, **{key: value[: rows.get(key, 1)] for key, value in arrays.items()})
    (cell_path,) = [cell.path for cell in cells_of(copy, one.unit)]
    cell = json.loads(cell_path.read_text())
    cell["found"]["records"][0] |= {"crashed": True, "steps": 1}
    cell_path.write_text(json.dumps(cell))
    page_path = tmp_path / "page.html"
    title = one.unit.policy.title
    page_path.write_text(render_report(read_run(copy), Choice(policy=title, seed=0)), "utf-8")
    page = show(page_path)
    assert page.locator("#clock").inner_text() == "0.00 / 0.05 s"
    page.keyboard.press("End")
    assert clock(page) == 0.05
