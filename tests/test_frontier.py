"""The frontier of score against quadratic cost: who is in the picture, where, and that names stay text."""

import math
from itertools import pairwise
from xml.etree import ElementTree

import pytest

from baselines.report.frontier import Point, Spread, as_file, draw_frontier

NO = math.nan
EVIL = '</text><script>alert("x")</script>&'
FAMILY = [
    Point("floor 1", "by floor", 0, Spread(0.80, NO, NO), Spread(260.0, NO, NO)),
    Point("floor 0.05", "by floor", 0, Spread(0.85, NO, NO), Spread(360.0, NO, NO)),
    Point("floor 0.2", "by floor", 0, Spread(0.83, NO, NO), Spread(290.0, NO, NO)),
]


def contender(name="apg", score=0.81, cost=330.0, half=0.01):
    return Point(
        name, "", 3, Spread(score, score - half, score + half), Spread(cost, cost - 20.0, cost + 20.0)
    )


def marks(svg, kind):
    root = ElementTree.fromstring(svg)
    return [one for one in root.iter() if one.get("class") == kind]


def places(svg, kind):
    return [(float(one.get("cx")), float(one.get("cy"))) for one in marks(svg, kind)]


def test_the_family_is_a_line_ordered_by_cost_and_more_score_is_higher():
    svg = draw_frontier(FAMILY).svg
    steps = places(svg, "step")
    assert (
        len(steps) == 3
        and steps == sorted(steps)
        and [y for _, y in steps] == sorted([y for _, y in steps])[::-1]
    )
    (line,) = marks(svg, "trace")
    assert line.get("points") == " ".join(f"{x:.1f},{y:.1f}" for x, y in steps)


def test_a_contender_below_the_line_is_drawn_below_it_with_its_intervals():
    svg = draw_frontier([*FAMILY, contender()]).svg
    ((x, y),) = places(svg, "point")
    before, after = sorted(places(svg, "step"))[1:]
    assert before[0] < x < after[0] and y > max(before[1], after[1])
    assert len(marks(svg, "spread")) == 2
    assert "apg: score 0.810 ± 0.010, quadratic cost 330 ± 20" in svg


def test_who_crashed_or_is_far_off_is_named_and_does_not_flatten_the_others():
    lost = contender("hover", 0.01, 5000.0)
    crashed = Point("crashed", "", 1, Spread(0.6, 0.5, 0.7), Spread(NO, NO, NO))
    alone, beside = (
        draw_frontier([*FAMILY, contender()]),
        draw_frontier([*FAMILY, contender(), lost, crashed]),
    )
    assert beside.svg == alone.svg and alone.note == ""
    assert beside.note == "Not in the picture, since they crash or lie far off: hover, crashed."


def test_without_a_family_there_is_no_picture():
    assert draw_frontier([contender()]) == draw_frontier([]) == ("", "")


def test_equal_points_have_a_picture_and_few_flights_no_interval():
    few = contender(half=0.0)._replace(score=Spread(0.81, NO, NO), cost=Spread(330.0, NO, NO))
    svg = draw_frontier([FAMILY[0], FAMILY[0]._replace(name="again"), few]).svg
    assert all(math.isfinite(x) and math.isfinite(y) for x, y in places(svg, "step"))
    assert not marks(svg, "spread")


@pytest.mark.parametrize("place", ["name", "trace"])
def test_a_name_stays_text(place):
    points = [*FAMILY, contender(EVIL)] if place == "name" else [one._replace(trace=EVIL) for one in FAMILY]
    svg = draw_frontier(points).svg
    root = ElementTree.fromstring(svg)
    assert not [one for one in root.iter() if one.tag.endswith("script")]
    assert EVIL in [one.text for one in root.iter()]


def test_the_file_of_a_picture_stands_by_itself():
    svg = as_file(draw_frontier([*FAMILY, contender()]).svg)
    root = ElementTree.fromstring(svg)
    style = next(one for one in root.iter() if one.tag.endswith("style"))
    assert "--c3:" in style.text and ".frontier .point" in style.text and "dark" not in style.text


def test_names_of_near_points_do_not_stand_on_each_other():
    svg = draw_frontier([*FAMILY, *(contender(f"net {k}", 0.81 + 1e-4 * k) for k in range(4))]).svg
    heights = sorted(float(one.get("y")) for one in marks(svg, "name"))
    assert min(b - a for a, b in pairwise(heights)) >= 15.0 - 1e-9
