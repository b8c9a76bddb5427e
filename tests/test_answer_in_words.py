"""What docs/results/learned.md and README say in words of the protocol is what its published numbers say."""

import re

import pytest
from sources import ROOT, script

from baselines.sweeps.contenders import VIOLATING

TABLES = AS_DERIVED, LEVELLED = "as derived", "levelled"
STILL, WEAK, GUSTS, OTHER = "nominal", "weak rotors, far starts", "gusts", "20 % other parameters"
UNSEEN = [f"unseen {name}" for name in ("racetrack", "faster lemniscate", "turning heading")]
RATE, NOISE = "rate limit 5 N/s", "sensor noise"
TASKS = ["Helix", "Random", "Regulation", "Line", "Lemniscate", "Spiral", "Corridor"]


@pytest.fixture(scope="module")
def made():
    return script("protocol")


@pytest.fixture(scope="module")
def rows(made):
    return {made._cell(row): row for row in made.published()}


@pytest.fixture(scope="module")
def said():
    """The sentence, or the entry of the list, that begins with these words; without line breaks."""
    text = (ROOT / "docs/results/learned.md").read_text(encoding="utf-8")

    def find(begin, end="\n-"):
        (found,) = re.findall(re.escape(begin) + rf".*?(?={end}|\n\n)", text, re.DOTALL)
        return " ".join(found.split())

    return find


def number(row, name):
    return float(row[name] or "nan")


def networks(made, rows, table, env, condition):
    keys = [key for key in rows if key[:3] == (table, env, condition)]
    return [rows[key] for key in keys if made._is_network(rows[key])]


def best(made, rows, table, env, condition):
    return min(networks(made, rows, table, env, condition), key=made._judged)


def less(row):
    """By how much less than the best MPC, and half the width of its interval."""
    low, high = (number(row, f"score_minus_base_{end}") for end in ("low", "high"))
    return -number(row, "score_minus_base"), 0.5 * (high - low)


def told(value, half):
    """A difference as the text rounds it."""
    return f"{abs(value):.3f}" if half < 0.02 else f"{abs(value):.2f}"


def has(text, *words):
    """Whether a text says each of these numbers, and not as a part of another one."""
    return all(re.search(rf"(?<![\d.]){re.escape(one)}(?!\d)", text) for one in words)


def test_in_still_air_no_network_within_the_limits_passes_the_best_mpc(made, rows, said):
    text = said("- *In still air no network that keeps the limits")
    for table in TABLES:
        for env in TASKS:
            for row in networks(made, rows, table, env, STILL):
                if number(row, "violation_share") <= VIOLATING:
                    assert number(row, "score_minus_base_low") < 0.0, (table, env, row["policy"])
            assert has(text, told(*less(best(made, rows, table, env, STILL)))), (table, env)


def test_readme_says_from_where_to_where_they_are_behind(made, rows):
    (text,) = re.findall(
        r"is (0\.\d+) to (0\.\d+) behind, levelled (0\.\d+) to (0\.\d+)\.",
        (ROOT / "README.md").read_text(encoding="utf-8"),
    )
    ends = []
    for table in TABLES:
        found = [less(best(made, rows, table, env, STILL)) for env in TASKS]
        ends += [told(*min(found)), told(*max(found))]
    assert list(text) == ends


def test_away_from_there_mpc_leads_by_what_is_said(made, rows, said):
    text = said("- *With other vehicles and starts MPC leads*")
    for env, condition in [
        ("Helix", WEAK),
        ("Random", WEAK),
        ("Regulation", WEAK),
        *[(env, OTHER) for env in ("Helix", "Random")],
    ]:
        for table in TABLES:
            difference = less(best(made, rows, table, env, condition))
            assert difference[0] > difference[1] and has(text, told(*difference)), (env, condition, table)
    for env in ("Helix", "Random", "Regulation"):
        assert re.search(rf"\b{rows[LEVELLED, env, WEAK, 'dagger, levelled']['crashed']}\b", text), env


def test_what_the_corridor_adds_is_told(made, rows, said):
    text = said("- *In the corridor* it leads")
    for condition in (GUSTS, "5 % other parameters"):
        for table in TABLES:
            difference = less(best(made, rows, table, "Corridor", condition))
            assert difference[0] > difference[1] and has(text, told(*difference)), (condition, table)
    here = [row for key, row in rows.items() if key[:3] == (AS_DERIVED, "Corridor", GUSTS)]
    for belongs in (made._is_network, made._is_mpc):
        shares = [100.0 * number(row, "violation_share") for row in here if belongs(row)]
        assert f"{min(shares):.0f} to {max(shares):.0f} %" in text
    row = rows[LEVELLED, "Corridor", STILL, "dagger, levelled"]
    passes = said("- *In still air no network that keeps the limits")
    assert -less(row)[0] > less(row)[1] and has(passes, told(*less(row)))
    assert f"{100.0 * number(row, 'violation_share'):.1f} %" in passes


def test_unseen_references_are_told(made, rows, said):
    text = said("- *On references that training had not*")
    for condition in UNSEEN:
        assert has(text, told(*less(best(made, rows, AS_DERIVED, "Random", condition))))
        for env in ("Helix", "Random"):
            row = best(made, rows, LEVELLED, env, condition)
            assert row["policy"] == "dagger-generalist" and has(text, told(*less(row))), (env, condition)
            low, high = (number(row, f"score_minus_base_{end}") for end in ("low", "high"))
            apart = (env, condition) not in {
                ("Random", UNSEEN[0]),
                ("Helix", UNSEEN[0]),
                ("Helix", UNSEEN[1]),
            }
            assert high < 0.0 if apart else low < 0.0 < high, (env, condition)
    helix = [less(best(made, rows, AS_DERIVED, "Helix", condition))[0] for condition in UNSEEN]
    assert f"{min(helix):.2f} to {max(helix):.2f}" in text


def test_in_gusts_one_network_passes_the_tuned_mpcs(made, rows, said):
    text = said("- *In gusts it depends on how one asks.*")
    for env in ("Helix", "Random"):
        derived, levelled = (less(best(made, rows, table, env, GUSTS)) for table in TABLES)
        assert derived[0] > derived[1] and has(text, told(*derived))
        assert -levelled[0] > levelled[1] and has(text, told(*levelled))
        assert best(made, rows, LEVELLED, env, GUSTS)["policy"] == "apg, levelled"


def test_networks_break_the_rate_limit_and_no_mpc_does(made, rows, said):
    text = said("- *Networks break a limit that training had not*")
    for key, row in rows.items():
        if key[2] == RATE and made._is_mpc(row) and key[1] != made.ALL:
            assert number(row, "violation_share") == 0.0, key
    for env in ("Helix", "Random", "Regulation"):
        for table in TABLES:
            found = networks(made, rows, table, env, RATE)
            shares = [100.0 * number(row, "violation_share") for row in found]
            ends = [
                f"{share:.2g}" if share >= 10.0 else f"{share:.1f}" for share in (min(shares), max(shares))
            ]
            assert " to ".join(ends) in text, (env, table, ends)


def test_who_lies_above_the_frontier_is_named(made, rows, said):
    text = said("- *One network lies above the frontier of exact NMPC*")
    above, beside = {}, {}
    for key, row in rows.items():
        if (
            made._is_network(row)
            and number(row, "violation_share") <= VIOLATING
            and row.get("score_minus_frontier")
        ):
            low, high = (number(row, f"score_minus_frontier_{end}") for end in ("low", "high"))
            (above if low > 0.0 else beside if high > 0.0 else {})[key[1], key[3]] = row
    assert list(above) == [("Lemniscate", "apg, levelled")]
    for policy in ("apg, levelled", "score-nmpc, tuned"):
        row = rows[LEVELLED, "Lemniscate", STILL, policy]
        assert f"by {number(row, 'score_minus_frontier'):.4f} +-" in text
    places = {"Helix": "on the helix", "Regulation": "in regulation", "Spiral": "on the spiral"}
    assert text.count(" (+0.") + text.count(" (-0.") == len(beside)
    for (env, policy), row in beside.items():
        assert f"`{policy}` {places[env]} ({number(row, 'score_minus_frontier'):+.4f} +-" in text


def test_under_noise_the_generalist_passes_mpcs_that_were_tuned(made, rows, said):
    text = said("Under *noise*", end="\n\n")
    for env in ("Helix", "Random"):
        derived, levelled = (best(made, rows, table, env, NOISE) for table in TABLES)
        assert has(text, told(*less(derived)), told(*less(levelled)))
        assert levelled["policy"] == "dagger-generalist" and number(levelled, "score_minus_base_low") > 0.0
        assert has(text, f"{number(rows[AS_DERIVED, env, NOISE, 'score-nmpc'], 'score'):.3f}")


def test_readme_names_what_holds_in_gusts_and_with_weak_rotors(made, rows):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    gusts = [-less(best(made, rows, LEVELLED, env, GUSTS))[0] for env in ("Helix", "Random")]
    assert f"passes the tuned MPCs by {min(gusts):.2f} to {max(gusts):.2f}." in text
    weak = [best(made, rows, table, "Helix", WEAK) for table in TABLES]
    assert weak[1]["policy"] == "dagger-generalist"
    derived, levelled = (told(*less(row)) for row in weak)
    assert (
        f"they are {derived} behind on the helix; levelled the generalist {levelled}, and those of one"
        in text
    )
    own = [row for row in networks(made, rows, LEVELLED, "Helix", WEAK) if "generalist" not in row["policy"]]
    assert all(int(row["crashed"]) > 0 for row in own)
