"""Drawings of graphs, formations and schemes: made from what is flown, and whole."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest

from baselines.reproduction import page
from baselines.reproduction.figures import draw_plate, graphs, schemes
from baselines.reproduction.figures.svg import Point, arrow, bent_arrow
from baselines.reproduction.results import Section
from quad_envs.formations import make_formation
from quad_envs.graphs import make_graph

SKETCHES = {s.key: s for s in (*graphs.FORMATIONS, *graphs.SCENES, *schemes.SCHEMES, *graphs.BESIDE)}
SVG = "{http://www.w3.org/2000/svg}"
SCENARIOS = {"5.2": ("triangle", "weak"), "5.3": ("triangle", "strong"), "5.4": ("hexagon", "weak"),
             "5.5": ("hexagon", "strong")}  # fmt: skip


def drawn(key):
    return SKETCHES[key].draw(1)


def inside(root):
    """Whether all discs, boxes and words are within the drawing."""
    _, _, width, height = map(float, root.get("viewBox").split())
    places = [(float(e.get("cx")), float(e.get("cy"))) for e in root.iter(f"{SVG}circle")]
    places += [(float(e.get("x")), float(e.get("y"))) for e in root.iter(f"{SVG}text")]
    x, y = np.array(places).T
    return (x > 0.0).all() and (x < width).all() and (y > 0.0).all() and (y < height).all()


@pytest.mark.parametrize("key", SKETCHES)
def test_a_drawing_is_an_svg_with_a_title_whose_marks_are_inside(key):
    root = ElementTree.fromstring(drawn(key).figure)
    assert root.tag == f"{SVG}svg" and root.find(f"{SVG}title").text and inside(root)


@pytest.mark.parametrize("key", SCENARIOS)
def test_a_graph_has_an_arrow_head_for_each_link_that_is_flown(key):
    shape, graph = SCENARIOS[key]
    G = make_graph(graph, shape, 6)
    root = ElementTree.fromstring(drawn(key).figure)
    assert len(list(root.iter(f"{SVG}polygon"))) == (G > 0.0).sum() - 6
    assert drawn(key).verdict == "HOLDS"


def test_a_formation_is_drawn_as_it_is_flown():
    slots = make_formation("hexagon", 6)
    root = ElementTree.fromstring(drawn("5.4").figure)
    at = np.array([[float(e.get("cx")), float(e.get("cy"))] for e in root.iter(f"{SVG}circle")])
    up, right = -(at[:, 1] - at[0, 1]), at[:, 0] - at[0, 0]
    scale = np.linalg.norm(at[1] - at[0])  # neighbours are 1 m apart
    np.testing.assert_allclose(np.stack([up, right], axis=1) / scale, slots[:, :2], atol=1e-3)  # 0.1 pixels


def test_the_example_has_the_links_that_the_text_names():
    assert drawn("5.1").verdict == "HOLDS" and "C " in drawn("5.1").figure  # a loop


def test_the_scene_holds_what_the_text_lists():
    numbers = drawn("6.1").numbers
    held = numbers["the text's example: measurements held"]
    assert (held["vehicle 1"], held["vehicle 2"], held["vehicle 3"]) == (
        "{t, 1}",
        "{t, 1, 2, 3, 4}",
        "not told",
    )
    assert numbers["flown, from 5 s: measurements held"]["vehicle 2"] == "{t, 1, 2, 3, 4}"


def test_links_go_around_vehicles_that_are_in_the_way():
    row = [Point(100.0 * i, 50.0) for i in range(3)]
    G = np.eye(3)
    G[2, 0] = 1.0
    assert " Q " in "".join(graphs.graph_marks(G, row))
    G[2, 0], G[1, 0] = 0.0, 1.0
    assert " Q " not in "".join(graphs.graph_marks(G, row))


def test_an_arrow_both_ways_has_two_heads():
    a, b = Point(0.0, 0.0), Point(50.0, 0.0)
    for both, heads in ((False, 1), (True, 2)):
        assert arrow([a, b], both=both).count("<polygon") == heads
        assert bent_arrow(a, b, 10.0, both=both).count("<polygon") == heads


@pytest.mark.parametrize("scheme", [schemes.COOPERATION, schemes.REFERENCES])
def test_every_block_of_a_scheme_is_linked_and_none_covers_another(scheme):
    assert {name for link in scheme.links for name in link} == set(scheme.blocks)
    places = {(block.column, block.row) for block in scheme.blocks.values()}
    assert len(places) == len(scheme.blocks)


def test_a_page_shows_a_drawing_as_it_is_and_links_its_file(tmp_path):
    plate = draw_plate(SKETCHES["5.2"], tmp_path)
    assert plate.files == ("figures/figure-5-02.svg",)
    assert (tmp_path / plate.files[0]).read_text() == drawn("5.2").figure
    text = page.render([Section("figures-5", "t", [], [], (plate,))], tmp_path)
    assert 'src="data:image/svg+xml;base64,' in text and 'href="figures/figure-5-02.svg">SVG</a>' in text
    assert re.search(r'width="440" height="360" alt="Figure 5\.2', text)
