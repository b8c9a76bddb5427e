"""The redrawn figures and the page of the reproduction."""

import base64
import hashlib
import io
import json
import re
import sys

import numpy as np
import pytest
from PIL import Image

from baselines import reproduction as package
from baselines.errors import MissingPackageError, ResultsError
from baselines.report.figures import COLOURS
from baselines.reproduction import (
    FIGURE_SECTIONS,
    ORDER,
    SECTIONS,
    figures,
    page,
    run,
    section_names,
    sections,
)
from baselines.reproduction.figures import FIGURES, draw_plate
from baselines.reproduction.figures.model import DRAWN, OWN, REDRAWN
from baselines.reproduction.results import FITTED, SHOWN, Cell, Claim, Measured, Plate, Section

SKETCHES = {sketch.key: sketch for group in FIGURES.values() for sketch in group}
EVIL = '<script>alert("x")</script>'


def test_every_figure_of_the_four_lists_can_be_drawn():
    wanted = [
        *(f"4.{i}" for i in range(1, 26)),
        *(f"5.{i}" for i in range(1, 14)),
        *(f"6.{i}" for i in range(1, 7)),
        *(f"7.{i}" for i in range(1, 10)),
    ]
    assert [key for key in SKETCHES if key[0].isdigit()] == wanted


def test_what_was_found_beyond_has_its_eight_figures():
    assert [sketch.key for sketch in FIGURES["beyond"]] == [
        "beyond-alpha",
        "beyond-relinearisation",
        "beyond-descent",
        "beyond-climb",
        "beyond-gains",
        "beyond-horizon",
        "beyond-messages",
        "beyond-separation",
    ]


def test_captions_say_where_the_data_comes_from():
    for key, sketch in SKETCHES.items():
        assert sketch.whole_caption.endswith(
            (REDRAWN if sketch.flown else DRAWN) if key[0].isdigit() else OWN
        )


def test_files_of_figures_sort_by_number():
    names = [sketch.name for sketch in FIGURES["figures-4"]]
    assert names == sorted(names) and len(set(names)) == 25


def test_the_order_of_the_page_has_every_section_once():
    assert set(ORDER) == {*SECTIONS, *FIGURE_SECTIONS} and len(set(ORDER)) == len(ORDER)
    assert tuple(FIGURES) == FIGURE_SECTIONS


def test_everything_has_figures_only_where_there_is_a_folder_for_them():
    assert section_names(["all"], figures=True) == list(ORDER)
    assert section_names() == list(SECTIONS)


def test_figures_without_a_folder_are_refused():
    with pytest.raises(ValueError, match=r"figures-5 is drawn into a folder: add --out DIR"):
        sections(["figures-5"])


def test_figures_without_matplotlib_name_the_extra(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingPackageError, match=r"-e \"\.\[report\]\""):
        sections(["figures-4"], out=tmp_path)


def test_a_folder_that_cannot_be_written_ends_the_run_before_its_flights(tmp_path):
    (tmp_path / "file").write_text("here")
    with pytest.raises(ResultsError, match="cannot write"):
        run(["table-4.1"], tmp_path / "file" / "out", False, 1)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """The folder with one figure that needs no flight, and what is known of it."""
    folder = tmp_path_factory.mktemp("figures")
    return folder, draw_plate(SKETCHES["4.13"], folder)


def test_a_figure_is_written_as_png_and_pdf(drawn):
    folder, plate = drawn
    png, pdf = (folder / name for name in plate.files)
    assert png.read_bytes().startswith(b"\x89PNG") and pdf.read_bytes().startswith(b"%PDF")
    assert plate.verdict == SHOWN and plate.files[0] == "figures/figure-4-13.png"


@pytest.mark.slow
@pytest.mark.parametrize("key", ["4.2", "4.17", "5.6", "6.6", "7.6", "beyond-climb"])
def test_a_figure_of_each_chapter_is_drawn_and_judged(key, tmp_path):
    plate = draw_plate(SKETCHES[key], tmp_path)
    assert plate.verdict == (SHOWN if key == "6.6" else "HOLDS") and plate.numbers
    assert (tmp_path / plate.files[0]).stat().st_size > 10_000


def a_section(drawn, text="a claim", word="FALSE"):
    plate = drawn[1]._replace(title=text, caption=text, numbers={text: text})
    claim = Claim("k", text, word, {text: 1.0, "lost": float("inf")})
    return Section("claims-4", text, [Cell(text, text, 2.0, 1.0)], [claim], (plate,))


def test_a_page_escapes_what_it_shows(drawn):
    section = a_section(drawn, EVIL)
    measured = Section("claims-5", EVIL, [Measured(EVIL, EVIL, 1.0, 2.0)], [])
    text = page.render([section, measured], drawn[0], [EVIL])
    assert "<script" not in text and text.count("&lt;script&gt;") >= 10


@pytest.mark.parametrize("word", page.VERDICTS)
def test_a_page_says_each_verdict_in_words(word, drawn):
    text = page.render([a_section(drawn, word=word)], drawn[0])
    kind = word.lower().replace(" ", "-")
    assert f'<h3>a claim</h3><span class="verdict {kind}">{word}</span>' in text


def test_a_verdict_on_our_own_finding_is_not_taken_for_one_on_the_text(drawn):
    plate = drawn[1]._replace(key="beyond-x", verdict="HOLDS")
    text = page.render([Section("beyond", "Beyond", [], [], (plate,))], drawn[0])
    assert "our finding HOLDS" in text and "0 HOLDS</span></dt>" in text


def test_a_finding_of_ours_is_marked_and_not_counted(drawn):
    section = a_section(drawn, word="HOLDS")
    own = section._replace(claims=[section.claims[0]._replace(own=True)], plates=())
    text = page.render([own], drawn[0])
    assert '<span class="verdict holds">our finding HOLDS</span>' in text and "0 HOLDS</span></dt>" in text
    assert 'class="card is-holds is-own"' in text


def test_a_fitted_table_has_that_for_its_verdict_and_says_why(drawn):
    text = page.render([a_section(drawn)._replace(fitted="Chosen so.")], drawn[0])
    assert f'<span class="verdict fitted">{FITTED}</span> Chosen so.' in text
    assert f"1 {FITTED}</span></dt>" in text and f"0 {FITTED}" in page.render([a_section(drawn)], drawn[0])


def test_what_has_a_verdict_can_be_hidden_by_it(drawn):
    text = page.render([a_section(drawn, word=page.NOT_REPRODUCED)], drawn[0])
    style = re.search(r"<style>(.*)</style>", text, re.DOTALL)[1]
    boxes = set(re.findall(r'<input type="checkbox" id="show-([a-z-]+)" checked>', text))
    assert boxes == {"not-reproduced", "shown", "false"}  # the claim, the figure, the table
    for word in page.VERDICTS:
        kind = word.lower().replace(" ", "-")
        assert f"body:has(#show-{kind}:not(:checked)) .is-{kind}" in style
    assert all(f"is-{kind}" in text.split("</style>")[1] for kind in boxes)


def test_rows_of_numbers_with_the_same_columns_share_a_table_with_their_heads(drawn):
    pair = {"LMPC": 1.0, "NMPC": 2.0}
    numbers = {"RMS": pair, "effort": pair, "share": 0.5}
    claim = Claim("k", "a claim", "HOLDS", numbers)
    text = page.render([Section("s", "t", [], [claim])], drawn[0])
    assert text.count('<table class="numbers">') == 2
    assert "<th scope='col'>LMPC</th><th scope='col'>NMPC</th></tr></thead>" in text
    assert text.index("RMS") < text.index("effort") < text.index("<th scope='col'>value</th>")


def test_a_page_loads_nothing_and_its_policy_allows_its_own_style_alone(drawn):
    text = page.render([a_section(drawn)], drawn[0])
    style = re.search(r"<style>(.*)</style>", text, re.DOTALL)[1]
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    assert f"default-src 'none'; style-src 'sha256-{digest}'; img-src data:;" in text
    assert "style=" not in text and all(
        source.startswith("data:image/png") for source in re.findall(r'src="([^"]*)', text)
    )


def test_the_images_of_a_page_keep_the_colours_that_tell_curves_apart(drawn):
    folder, plate = drawn  # blue, orange and green, each of them a thin line
    data, width, height = page._small(folder / plate.files[0], 0)
    image = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"), dtype=float)
    assert image.shape == (height, width, 3) and (image[0] == 255.0).all()
    for name in ("blue", "orange", "green"):
        near = np.abs(image - 255.0 * np.array(COLOURS[name])).max(axis=-1) < 10.0  # smoothing of a thin line
        assert near.sum() > 200


def test_a_page_lists_its_contents_and_what_is_missing(drawn):
    text = page.render([a_section(drawn)], drawn[0], ["claims-5"])
    assert '<a href="#claims-4">' in text and 'id="claims-4"' in text
    assert "Not finished yet, or interrupted: claims-5." in text
    assert "<code>quad-envs reproduce claims-4 --out DIR</code>" in text


def test_a_printed_number_that_is_far_off_is_said_to_be(drawn):
    text = page.render([a_section(drawn)], drawn[0])
    assert "beyond 15%" in text and "0 of 1 numbers within 5%" in text


def stop(jobs):
    raise KeyboardInterrupt


def test_an_interrupt_leaves_finished_figures_whole_and_a_page_that_says_so(tmp_path, monkeypatch):
    first, second, *_ = (SKETCHES[key] for key in ("4.13", "4.14"))
    stopping = type(second)(second.key, second.title, second.printed, second.caption, stop)
    monkeypatch.setitem(figures.FIGURES, "figures-4", (first, stopping))
    with pytest.raises(KeyboardInterrupt):
        run(["figures-4"], tmp_path, False, 1)
    found = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert found == {
        "figure-4-13.png",
        "figure-4-13.pdf",
        page.NAME,
        "reproduce.json",
        "config.json",
        ".lock",
    }
    assert "interrupted: figures-4" in (tmp_path / page.NAME).read_text()


def test_the_command_writes_a_page_with_the_figures_in_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(figures.FIGURES, "figures-4", (SKETCHES["4.13"],))
    assert package.run(["figures-4"], tmp_path, False, 1) == 0
    assert page.NAME in capsys.readouterr().out
    told = json.loads((tmp_path / "reproduce.json").read_text())["sections"][0]["figures"][0]
    assert Plate(**told).key == "4.13" and told["files"][0] == "figures/figure-4-13.png"
    text = (tmp_path / page.NAME).read_text()
    assert text.count("data:image/png") == 1 and 'href="figures/figure-4-13.pdf"' in text
