"""The one table of columns, and files in which a column still has its name of before."""

from __future__ import annotations

import csv
import json

import pytest

from baselines import evaluate, run_benchmark
from baselines.__main__ import main
from baselines.evaluation.column import COUNTED, LARGEST
from baselines.evaluation.columns import COLUMNS, Record, read_record, shown
from baselines.report import build_report
from baselines.sweeps.folder import read_run
from baselines.training.held_out import Point, read_point

HELIX = "quad/HelixTracking-v0"
SUITE = {
    "name": "columns",
    "episodes": 2,
    "envs": [{"id": HELIX, "kwargs": {"time_limit": 1.0, "velocity_limit": 0.05}, "label": "slow"}],
    "policies": ["hover", "lqr"],
}


@pytest.fixture
def folder(tmp_path):
    """A results folder."""
    run_benchmark(SUITE, tmp_path / "run")
    return tmp_path / "run"


def make_old(folder):
    """As it was when the quadratic cost was called cost, and nothing else of today was there."""
    for path in (folder / "cells").iterdir():
        cell = json.loads(path.read_text())
        for record in cell["found"]["records"]:
            record["cost"] = record.pop("quadratic_cost")
            for name in ("constraint_cost", "crash_cause", "left_model"):
                del record[name]
        path.write_text(json.dumps(cell))


def test_a_column_of_the_record_is_one_of_the_csv_file_and_of_the_page(folder):
    with open(folder / "summary.csv", newline="") as file:
        summary = list(csv.DictReader(file))
    (env,) = build_report(read_run(folder)).environments
    assert [row["policy"] for row in summary] == [row.policy for row in env.rows]
    for row, cells in zip(summary, (row.cells for row in env.rows), strict=True):
        for name in ("quadratic_cost", "constraint_cost", "violation_share", "effort"):
            # The page has seven digits.
            assert cells[name][0] == pytest.approx(float(row[name]), rel=1e-6)
        assert "cost" not in row
    assert float(summary[1]["constraint_cost"]) > 0.0  # lqr is faster than 0.05 m/s
    titles = {column.key: (column.title, column.unit, column.kind) for column in env.columns}
    assert titles["effort"] == ("Effort", "N²", "number")
    assert titles["violation_share"] == ("Violating", "%", "percent")
    assert titles["quadratic_cost_minus_base"] == ("Δ quadratic cost", "", "difference")
    assert titles["worst_velocity"][1] == "m/s" and titles["crashed"][2] == "count"


def test_limits_stand_before_crashes_and_teams_have_columns_of_their_own():
    single, team = ([column.name for column in shown(of_team, ["tilt"])] for of_team in (False, True))
    assert single[single.index("worst_tilt") + 1] == team[team.index("worst_tilt") + 1] == "crashed"
    assert "position_rms" in single and "position_rms" not in team
    assert "anees" in team and "formation_rms_worst" in team and "team_p50_ms" in team
    assert not {"anees", "formation_rms_worst", "team_p50_ms"} & set(single)


@pytest.mark.parametrize("of_team", [False, True])
def test_no_two_columns_of_a_table_share_a_heading(of_team):
    headings = [column.heading for column in shown(of_team, ["tilt", "rate"]) if column.printed]
    assert len(headings) == len(set(headings))


def test_the_worst_vehicle_is_told_as_a_column_of_the_same_unit():
    worst = COLUMNS["estimate_rmse_worst"]
    assert worst.source == "estimate_rmse" and worst.has(LARGEST) and worst.unit == "m"
    assert worst.heading == "estimate worst m" and worst.of_team([0.1, 0.3]) == 0.3
    assert all(column.about and column.title for column in COLUMNS.values())


def test_a_results_folder_that_says_cost_is_read(folder, capsys):
    before = read_run(folder).environments()[0].results
    make_old(folder)
    after = read_run(folder).environments()[0].results
    for old, new in zip(before.summary(), after.summary(), strict=True):
        assert old["quadratic_cost"] == new["quadratic_cost"] and old["effort"] == new["effort"]
        assert old["quadratic_cost_minus_base"] == new["quadratic_cost_minus_base"]
        assert new["constraint_cost"] != new["constraint_cost"]  # nan: nobody has added it up
    (env,) = build_report(read_run(folder)).environments
    assert "constraint_cost" not in {column.key for column in env.columns}
    again = run_benchmark(SUITE, folder)  # nothing is flown again
    assert [row["quadratic_cost"] for row in again.summary()] == [
        row["quadratic_cost"] for row in before.summary()
    ]
    assert main(["report", str(folder)]) == 0 and "report.html" in capsys.readouterr().out


def test_a_record_with_a_column_that_nobody_knows_is_refused():
    with pytest.raises(TypeError, match="costs"):
        read_record({"seed": 0, "costs": 1.0})


def test_a_learning_curve_that_says_cost_is_read():
    point = Point(1.0, 200, 1, 0.5, 3.5, 0.2, 0, 20, 0.5)
    row = {key: str(value) for key, value in point._asdict().items()}
    assert read_point(row) == point
    row["cost"] = row.pop("quadratic_cost")
    assert read_point(row) == point


def test_counts_are_sums_and_no_means():
    counted = {name for name, column in COLUMNS.items() if column.has(COUNTED)}
    assert {"crashed", "left_model"} <= counted <= {*Record._fields, "fallbacks"}
    assert not any(COLUMNS[name].averaged for name in counted)


def test_a_record_answers_to_the_name_of_before_with_a_warning():
    evaluation = evaluate("lqr", HELIX, episodes=1)
    with pytest.warns(DeprecationWarning, match="now quadratic_cost"):
        assert evaluation.records[0].cost == evaluation.records[0].quadratic_cost


@pytest.mark.parametrize("value", [0.25, -3.0, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["score", "min_separation", "settling_time"])
def test_a_vehicle_alone_counts_as_a_team_of_vehicles_like_it(name, value):
    column = COLUMNS[name]
    assert str(column.of_team([value])) == str(column.of_team([value, value]))
