"""The dissertation's tables and claims: what is printed, what we get, and the verdicts that follow."""

import dataclasses
import json
import re
from types import SimpleNamespace

import pytest

from baselines.reproduction import (
    FIGURE_SECTIONS,
    ORDER,
    SECONDS,
    SECTIONS,
    reproduce,
    run,
    tables,
    tracking_claims,
)
from baselines.reproduction.flights import DESCENDING
from baselines.reproduction.identification import (
    FAMILIES,
    NEAR,
    Drawn,
    draw_family,
    family_claim,
    printed_rms,
)
from baselines.reproduction.published import TABLE_4_1, TABLE_4_2
from baselines.reproduction.regulation_claims import (
    LATE,
    comparable_claim,
    instability_claim,
    saturation_claim,
)
from baselines.reproduction.results import FITTED, Cell, Claim, Section, show, verdict
from baselines.reproduction.tracking_claims import (
    decision_cost_claim,
    disturbance_claim,
    effort_claim,
    norm_claim,
    optimality_claim,
    regulation_claim,
    rms_claim,
    taylor_claim,
    transient_claim,
)

# What this implementation gave when its tables were first compared with the printed ones: rms and maximum of
# the relative misfit over the 30 cells. The printed numbers themselves belong to trajectories shown as
# figures.
MISFIT = {"table-4.1": (0.034, 0.117), "table-4.2": (0.055, 0.137)}


def test_the_printed_tables_are_complete():
    for table in (TABLE_4_1, TABLE_4_2):
        assert len(table) == 15 and len({(row.task, row.horizon) for row in table}) == 15


def test_a_section_prints_its_cells_and_serialises():
    section = Section(
        "t", "Title", [Cell("here", "RMS, m", 2.0, 1.0)], [Claim("k", "text", "HOLDS", {"n": 1.0})]
    )
    assert "0.500" in str(section) and "[HOLDS] text" in str(section)
    assert json.loads(json.dumps(section.to_dict()))["cells"][0]["ratio"] == 0.5


def test_a_finding_of_ours_is_not_taken_for_a_sentence_of_the_text():
    claims = [Claim("k", "text", "HOLDS", {}), Claim("l", "ours: more", "PARTLY", {}, own=True)]
    section = Section("t", "Title", [], claims)
    assert "[HOLDS] text" in str(section) and "[our finding PARTLY] ours: more" in str(section)
    assert [claim["own"] for claim in section.to_dict()["claims"]] == [False, True]


def test_a_list_of_numbers_has_the_names_of_its_columns():
    numbers = {"RMS, m": {"LMPC": 1.5, "NMPC": float("nan")}}
    section = Section("t", "Title", [], [Claim("k", "text", "HOLDS", numbers)])
    assert show(numbers["RMS, m"]) == "LMPC: 1.50, NMPC: -" and "RMS, m: LMPC: 1.50" in str(section)
    told = json.loads(json.dumps(section.to_dict(), allow_nan=False))
    assert told["claims"][0]["numbers"] == {"RMS, m": {"LMPC": 1.5, "NMPC": None}}


@pytest.mark.parametrize("table", [tables.table_4_1, tables.table_4_2])
def test_a_table_says_that_its_trajectories_were_fitted_to_it(table, monkeypatch):
    record = SimpleNamespace(position_rms=1.0, effort=1.0)
    monkeypatch.setattr(tables, "_FLOWN", {})
    monkeypatch.setattr(
        tables, "fly_all", lambda flights, jobs: [SimpleNamespace(record=record)] * len(flights)
    )
    section = table()
    assert section.fitted == tables.FITTED_TO and f"[{FITTED}] {tables.FITTED_TO}" in str(section)
    assert section.fitted.rstrip(".").count(". ") == 0  # one sentence
    assert "identified from these very cells" in section.fitted and "lower RMS" in section.fitted


@pytest.mark.parametrize("task", FAMILIES)
def test_the_families_contain_what_was_identified(task):
    identified = DESCENDING[task]
    values = [getattr(identified, field.name) for field in dataclasses.fields(identified)]
    assert isinstance(identified, FAMILIES[task].kind)
    for value, (low, high) in zip(values, FAMILIES[task].ranges, strict=False):
        assert low <= value <= high


def test_a_member_fits_only_if_both_its_cells_do():
    linear, ours = printed_rms("helix")
    assert (linear, ours) == (0.8484, 0.5831)
    near, far = 1.0 + 0.9 * NEAR, 1.0 - 1.1 * NEAR
    assert Drawn((near * linear, ours), (1.0, 1.0)).fits((linear, ours))
    assert not Drawn((linear, far * ours), (1.0, 1.0)).fits((linear, ours))


def test_a_single_member_on_which_nmpc_is_worse_breaks_the_prediction():
    better, worse = Drawn((2.0, 1.0), (1.0, 2.0)), Drawn((1.0, 2.0), (2.0, 1.0))
    assert family_claim({"helix": [better] * 3}).verdict == "HOLDS"
    claim = family_claim({"helix": [better, worse], "lines": [better]})
    assert claim.verdict == "PARTLY" and claim.own
    assert [row["NMPC has the lower RMS"] for row in claim.numbers.values()] == ["1 of 2", "1 of 1"]


@pytest.mark.slow
def test_several_random_helices_fit_the_table_and_nmpc_is_better_on_all_of_them():
    members = draw_family("helix")
    assert len(members) == 63 and sum(each.fits(printed_rms("helix")) for each in members) == 6
    assert family_claim({"helix": members}).verdict == "HOLDS"


@pytest.mark.parametrize(("share", "word"), [(1.0, "HOLDS"), (0.0, "FALSE"), (0.5, "PARTLY")])
def test_a_verdict_follows_from_the_share_of_cases(share, word):
    assert verdict(share) == word


def test_an_unknown_section_is_refused_with_a_suggestion():
    with pytest.raises(ValueError, match=r"did you mean 'table-4\.1'"):
        reproduce(["table4.1"])


@pytest.mark.parametrize("jobs", [0, -1, True])
def test_the_number_of_jobs_must_be_a_whole_positive_one(jobs):
    with pytest.raises(ValueError, match="jobs must be a whole number >= 1"):
        reproduce(["table-4.1"], jobs)


def test_a_name_that_is_unknown_leaves_no_folder(tmp_path):
    with pytest.raises(ValueError, match="unknown table"):
        run(["table4.1"], tmp_path / "out", False, 1)
    assert not (tmp_path / "out").exists()


def test_the_tables_and_claims_share_their_flights_however_many_jobs_fly_them(monkeypatch):
    flown = []

    def count(flights, jobs):
        flown.extend((flight.controller, flight.horizon, flight.reference) for flight in flights)
        return [len(flown)] * len(flights)

    monkeypatch.setattr(tables, "_FLOWN", {})
    monkeypatch.setattr(tables, "fly_all", count)
    first = tables.table_flights(("LMPC", "SDC 1/2"), jobs=1)
    assert tables.table_flights(("LMPC", "SDC 1/2"), jobs=2) == first and len(flown) == 30
    assert tables.table_flights(("LMPC", "SDC 1/2", "SDC 1"), jobs=2).items() >= first.items()
    assert len(flown) == 45
    tables.table_flights(("LMPC",), climbing=True)
    assert len(flown) == 60


def test_taylor_form_is_better_than_claimed_inside_and_useless_far_outside():
    claim = taylor_claim()
    assert claim.verdict == "HOLDS" and claim.numbers["error at 3 rad"] == "272%"


@pytest.mark.slow
@pytest.mark.parametrize("name", MISFIT)
def test_tables_are_reproduced_to_their_recorded_misfit(name):
    section = reproduce([name])[0]
    misfit = [abs(cell.ratio - 1.0) for cell in section.cells]
    rms, largest = MISFIT[name]
    assert len(misfit) == 30
    assert (sum(m * m for m in misfit) / 30) ** 0.5 < rms and max(misfit) < largest


@pytest.mark.slow
def test_nmpc_is_better_in_every_descending_cell_but_not_when_climbing():
    rms, effort = rms_claim(), effort_claim()
    (down, up), (less, more) = rms.numbers.values(), effort.numbers.values()
    assert down["SDC 1/2"] == "15 of 15" and up["SDC 1/2"] == "5 of 15"
    assert less == {"SDC 1/2": "11 of 15", "SDC 1": "15 of 15", "1 pass": "15 of 15"}
    assert more["SDC 1/2"] == "0 of 15" and more["1 pass"] == "14 of 15"
    assert (rms.verdict, effort.verdict) == ("HOLDS", "PARTLY")  # by the trajectories of the text alone
    assert all("ours" in list(claim.numbers)[1] for claim in (rms, effort))


@pytest.mark.slow
def test_transient_is_better_on_helix_and_lines_and_of_the_spiral_the_text_says_nothing():
    claim = transient_claim()
    helix, spiral, lines, _ = claim.numbers.values()
    assert helix == pytest.approx({"LMPC": 3.25, "NMPC": 2.45})
    assert spiral == pytest.approx({"LMPC": 3.15, "NMPC": 3.55})
    assert lines["NMPC"] < lines["LMPC"]
    assert "claims nothing" in list(claim.numbers)[1] and claim.verdict == "HOLDS"


@pytest.mark.slow
def test_the_cost_of_nmpc_is_judged_by_the_work_of_its_solves_and_not_by_times(monkeypatch):
    claim = decision_cost_claim()
    assert claim.verdict == "HOLDS"
    for row in claim.numbers.values():
        if "factor" in row:
            assert int(row["NMPC"]) <= int(row["most steps of a solve, LMPC"])

    def slow(flights, jobs):
        times = {"LMPC": 0.01, "SDC 1/2": 1.0}  # ms of a stage
        return [
            SimpleNamespace(
                record=SimpleNamespace(decision_p50_ms=times[f.controller] * f.horizon, iterations_max=3)
            )
            for f in flights
        ]

    monkeypatch.setattr(tracking_claims, "fly_all", slow)
    assert decision_cost_claim().verdict == "HOLDS"  # a factor of 100 is a constant, too


@pytest.mark.slow
def test_torque_pulse_is_harmless_with_feed_forward_and_not_without():
    claim = disturbance_claim()
    for task in DESCENDING:
        assert max(claim.numbers[f"with feed-forward, {task}: RMS / clean RMS"].values()) < 1.04
    assert claim.numbers["ours: absolute time, without, LMPC: RMS, m"]["helix"].startswith("5.2")


@pytest.mark.slow
def test_under_the_disturbance_nmpc_is_better_but_for_the_transient_of_the_spiral():
    claim = disturbance_claim()
    linear, ours = (
        claim.numbers[f"absolute time, with feed-forward, {name}: RMS, m"] for name in ("LMPC", "SDC 1/2")
    )
    assert all(float(ours[task]) < float(linear[task]) for task in DESCENDING)
    transient = {
        task: next(
            row["NMPC"] < row["LMPC"]
            for what, row in claim.numbers.items()
            if what.startswith(f"with feed-forward, {task}: ") and "clean" not in what
        )
        for task in DESCENDING
    }
    assert transient == {"helix": True, "spiral": False, "lines": True} and claim.verdict == "PARTLY"


@pytest.mark.slow
def test_one_relinearisation_is_near_the_optimum_where_the_printed_controller_is_not():
    claim = optimality_claim()
    climb = claim.numbers["helix, climbing"]
    assert climb["SDC 1/2"] == "lost"
    assert climb["1 pass"].startswith("+4.") and climb["RTI"].startswith("+0.")
    assert claim.verdict == "PARTLY" and claim.own


@pytest.mark.slow
def test_norm_of_the_state_grows_at_times_whatever_the_lemma_says():
    assert norm_claim().verdict == "FALSE"


@pytest.mark.slow
def test_regulation_is_better_descending_and_never_climbing_with_the_printed_factorisation():
    claim = regulation_claim(samples=10)
    assert set(claim.numbers["climbing, SDC 1/2: share of offsets"].values()) == {"0%"}
    assert set(claim.numbers["level, 1 pass: share of offsets"].values()) == {"100%"}
    assert claim.own and list(claim.numbers["level, 1 pass: share of offsets"]) == [
        "1 m",
        "2 m",
        "4 m",
        "6 m",
        "8 m",
    ]


@pytest.mark.slow
def test_feedback_linearization_is_comparable_and_its_instability_depends_on_the_gains():
    comparable = comparable_claim()
    assert comparable.verdict == "HOLDS"
    assert f"no more than {LATE:g} s later than LMPC" in comparable.text and "5 %" in comparable.text
    assert "found by search" in comparable.text
    assert saturation_claim().verdict == "PARTLY"
    claim = instability_claim(samples=30)
    assert claim.numbers["LMPC from 3 and 5 m"] == "stable"
    assert claim.numbers["default gains from 3 m"] == "stable"
    assert claim.numbers["gains from above, from (3,3,-3)"] == "lost after 3.7 s"


@pytest.mark.slow
def test_the_command_writes_what_it_prints(tmp_path, capsys):
    out = tmp_path / "a folder"
    assert run(["table-4.2"], out, True, 1) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((out / "reproduce.json").read_text())
    assert set(printed["sections"][0]["cells"][0]) == {"where", "quantity", "printed", "ours", "ratio"}


def test_every_section_has_a_name_of_its_own():
    assert list(SECTIONS) == [
        "table-4.1",
        "table-4.2",
        "identification",
        *(f"claims-{chapter}" for chapter in range(4, 8)),
    ]


def test_the_command_says_which_sections_it_flies_and_how_long_the_rest_takes(capsys, monkeypatch):
    flown = []
    for name in ("table-4.1", "table-4.2"):
        section = Section(name, f"title of {name}", [], [])
        monkeypatch.setitem(SECTIONS, name, lambda jobs, s=section: flown.append(s.name) or s)
    assert run(["table-4.1", "table-4.2"], None, False, 1) == 0
    printed = capsys.readouterr()
    said = printed.err.splitlines()
    assert said[0].startswith("reproduce: table-4.1, table-4.2; about ")
    assert re.match(r"table-4\.1: about \d+ s left", said[1]) and re.match(r"table-4\.2: took \d+ s", said[2])
    assert "title of table-4.1" in printed.out and "left" not in printed.out


def test_every_section_has_an_estimate():
    assert all(seconds > 0.0 for seconds in SECONDS.values())
    assert {*SECTIONS, *FIGURE_SECTIONS} == set(ORDER)
