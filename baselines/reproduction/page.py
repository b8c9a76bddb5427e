"""The page of the reproduction: every table, claim and figure, what is printed, what we get, and the verdict.

It loads nothing: figures stand in it as small images, there is no script (the filter is style), and the
content-security policy allows its own style by its digest and images of its own alone.
"""

from __future__ import annotations

import base64
import hashlib
import io
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from html import escape
from importlib import resources
from itertools import groupby
from pathlib import Path

import numpy as np

from ..report.figures import COLOURS
from .results import (
    FITTED,
    NOT_REPRODUCED,
    SHOWN,
    Cell,
    Claim,
    Measured,
    Numbers,
    Plate,
    Section,
    Value,
    show,
    verdict,
)

NAME = "reproduction.html"
VERDICTS = {
    "HOLDS": "what the text says is what we get",
    "PARTLY": "in some of the cases, or with a condition that the text does not state",
    "FALSE": "we get something else",
    NOT_REPRODUCED: "does not show in the text's setting as far as it is printed; what is not may be why",
    FITTED: "our numbers were chosen by the printed ones: that they agree is no evidence",
    SHOWN: "a picture of which the text states nothing",
}
_OWN = "own"  # beside the verdicts, of what the text does not say
_WIDTH = 960  # of the images in the page, pixels
_SHADES = 24  # of each house colour, from itself to white
_PAPER = 243  # of 255, from which a shade counts as white
_NEAR, _FAR = 0.05, 0.15  # relative misfit of a printed number


def render(sections: Sequence[Section], folder: Path, missing: Sequence[str] = ()) -> str:
    """The page of what was reproduced.

    Args:
        sections: In the order in which they shall stand.
        folder: Where the files of the figures are.
        missing: Names of sections that were asked for and are not finished.
    """
    style = resources.files("baselines.reproduction").joinpath("page.css").read_text("utf-8")
    digest = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode("ascii")
    policy = (
        f"default-src 'none'; style-src 'sha256-{digest}'; img-src data:; base-uri 'none'; form-action 'none'"
    )
    known = {claim.key for section in sections for claim in section.claims}
    body = "\n".join(_section(section, folder, known) for section in sections)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>The dissertation, reproduced</title>
<style>{style}</style>
</head>
<body>
<header>{_head(sections, missing)}</header>
<nav aria-label="Contents"><ul>{"".join(map(_entry, sections))}</ul></nav>
{_filter(sections)}
<main>
{body}
</main>
</body>
</html>
"""


def _head(sections: Sequence[Section], missing: Sequence[str]) -> str:
    total = Counter(word for section in sections if section.name != "beyond" for word in _words(section))
    meaning = "".join(
        f"<dt>{_badge(word, f'{total[word]} {word}')}</dt><dd>{escape(text)}</dd>"
        for word, text in VERDICTS.items()
    )
    note = (
        f'<p class="note">Not finished yet, or interrupted: {escape(", ".join(missing))}.</p>'
        if missing
        else ""
    )
    return f"""<h1>The dissertation, reproduced</h1>
<p>Every table, claim and figure of chapters 4 to 7 of <cite>Nonlinear Model Predictive Control
for Cooperative Control and Estimation</cite> (2017) beside what our flights give, each with a verdict
computed from the numbers under it, and the command that repeats it. Figures are redrawn from our own
flights: the source has their data as pictures only. A finding of ours that the text does not state is said to
be ours, and not counted.</p>
<dl class="meaning">{meaning}</dl>{note}"""


def _filter(sections: Sequence[Section]) -> str:
    """Boxes that hide what has a verdict; the style reads them."""
    here = {word for section in sections for word in _all_words(section)}
    boxes = [(_kind(word), word) for word in VERDICTS if word in here]
    own = any(claim.own for section in sections for claim in section.claims)
    boxes += [(_OWN, "our findings")] if own or any(section.name == "beyond" for section in sections) else []
    marked = "".join(
        f'<label><input type="checkbox" id="show-{kind}" checked> {escape(word)}</label>'
        for kind, word in boxes
    )
    return f'<fieldset class="filter"><legend>Show</legend>{marked}</fieldset>'


def _words(section: Section) -> Iterable[str]:
    """Verdicts on what the text says."""
    yield from (claim.verdict for claim in section.claims if not claim.own)
    yield from (plate.verdict for plate in section.plates)
    if any(isinstance(cell, Cell) for cell in section.cells):
        yield _verdict_of_table(section)


def _all_words(section: Section) -> Iterable[str]:
    yield from _words(section)
    yield from (claim.verdict for claim in section.claims if claim.own)


def _verdict_of_table(section: Section) -> str:
    if section.fitted:
        return FITTED
    near = [abs(cell.ratio - 1.0) <= _NEAR for cell in section.cells if isinstance(cell, Cell)]
    return verdict(sum(near) / len(near))


def _kind(word: str) -> str:
    """The class of a verdict in the style."""
    return word.lower().replace(" ", "-") if word in VERDICTS else "shown"


def _card(word: str, own: bool) -> str:
    """Classes of what has a verdict, by which the filter finds it."""
    return f"card is-{_kind(word)}" + f" is-{_OWN}" * own


def _badge(word: str, text: str = "") -> str:
    return f'<span class="verdict {_kind(word)}">{escape(text or word)}</span>'


def _entry(section: Section) -> str:
    count = Counter(_words(section))
    badges = " ".join(_badge(word, f"{count[word]} {word}") for word in VERDICTS if count[word])
    return f'<li><a href="#{escape(section.name)}">{escape(section.title)}</a><span>{badges}</span></li>'


def _section(section: Section, folder: Path, known: set[str]) -> str:
    command = f"quad-envs reproduce {section.name}" + (" --out DIR" if section.plates else "")
    parts = [
        f'<section id="{escape(section.name)}"><h2>{escape(section.title)}</h2>',
        f'<p class="soft">Repeat: <code>{escape(command)}</code></p>',
        _table(section),
        *(_claim(claim) for claim in section.claims),
        _measured([cell for cell in section.cells if isinstance(cell, Measured)]),
        *(_plate(plate, folder, known) for plate in section.plates),
        "</section>",
    ]
    return "\n".join(part for part in parts if part)


def _table(section: Section) -> str:
    """Printed numbers beside ours."""
    cells = [cell for cell in section.cells if isinstance(cell, Cell)]
    if not cells:
        return ""
    word = _verdict_of_table(section)
    misfit = [abs(cell.ratio - 1.0) for cell in cells]
    near, mean_square = sum(m <= _NEAR for m in misfit), sum(m * m for m in misfit) / len(misfit)
    rows = "".join(
        f"<tr><th scope='row'>{escape(cell.where)}</th><td>{cell.printed:.4f}</td><td>{cell.ours:.4f}</td>"
        f"<td>{cell.ratio:.3f}</td><td>{_closeness(abs(cell.ratio - 1.0))}</td></tr>"
        for cell in cells
    )
    return (
        f'<div class="is-{_kind(word)}"><p>{_badge(word)} {escape(section.fitted)}</p>'
        f"<p>{near} of {len(cells)} numbers within {_NEAR:.0%}; relative "
        f"misfit: rms {mean_square**0.5:.1%}, largest {max(misfit):.1%}.</p>"
        f'<div class="scroll"><table><thead><tr><th>{escape(cells[0].quantity)}</th><th>printed</th>'
        f"<th>ours</th><th>ratio</th><th>agreement</th></tr></thead><tbody>{rows}</tbody></table></div></div>"
    )


def _closeness(misfit: float) -> str:
    if misfit <= _NEAR:
        return _badge("HOLDS", f"within {_NEAR:.0%}")
    return _badge("PARTLY", f"within {_FAR:.0%}") if misfit <= _FAR else _badge("FALSE", f"beyond {_FAR:.0%}")


def _measured(cells: Sequence[Measured]) -> str:
    """Numbers of which the source prints nothing."""
    if not cells:
        return ""
    rows = "".join(
        f"<tr><th scope='row'>{escape(cell.where)}</th><td>{escape(cell.quantity)}</td>"
        f"<td>{escape(show(cell.prototype))}</td><td>{escape(show(cell.ours))}</td></tr>"
        for cell in cells
    )
    return (
        f"<details><summary>{len(cells)} numbers beside those of an independent prototype (the source prints "
        'none)</summary><div class="scroll"><table><thead><tr><th>case</th><th>quantity</th>'
        f"<th>prototype</th><th>ours</th></tr></thead><tbody>{rows}</tbody></table></div></details>"
    )


def _numbers(numbers: Numbers) -> str:
    """What was measured, as tables: rows that follow each other and have the same columns share one."""
    return "".join(
        _number_table(columns, [(what, _columns(value)) for what, value in rows])
        for columns, rows in groupby(numbers.items(), lambda item: tuple(_columns(item[1])))
    )


def _columns(value: Value | Mapping[str, Value]) -> Mapping[str, Value]:
    return value if isinstance(value, Mapping) else {"value": value}


def _number_table(columns: Sequence[str], rows: Iterable[tuple[str, Mapping[str, Value]]]) -> str:
    head = "".join(f"<th scope='col'>{escape(column)}</th>" for column in columns)
    body = "".join(
        f"<tr><th scope='row'>{escape(what)}</th>"
        + "".join(f"<td>{escape(show(value))}</td>" for value in values.values())
        + "</tr>"
        for what, values in rows
    )
    return (
        '<div class="scroll"><table class="numbers"><thead><tr><th scope="col">measured</th>'
        f"{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _claim(claim: Claim) -> str:
    differs = claim.prototype and claim.prototype != claim.verdict
    aside = (
        f'<p class="soft">An independent prototype led to: {escape(claim.prototype)}.</p>' if differs else ""
    )
    badge = _badge(claim.verdict, f"our finding {claim.verdict}" if claim.own else "")
    card = _card(claim.verdict, claim.own)
    return (
        f'<article class="{card}" id="claim-{escape(claim.key)}"><div class="head">'
        f"<h3>{escape(claim.text)}</h3>{badge}</div>{_numbers(claim.numbers)}{aside}"
        "</article>"
    )


def _plate(plate: Plate, folder: Path, known: set[str]) -> str:
    printed = plate.key[:1].isdigit()
    label = f"Figure {plate.key}: {plate.title}" if printed else plate.title
    card = _card(plate.verdict, not printed)
    badge = _badge(plate.verdict, "" if printed else f"our finding {plate.verdict}")
    links = ", ".join(
        f'<a href="{escape(name)}">{escape(Path(name).suffix[1:].upper())}</a>' for name in plate.files
    )
    claims = ", ".join(
        f'<a href="#claim-{escape(key)}">{escape(key)}</a>' if key in known else escape(key)
        for key in plate.claims
    )
    related = f" See also the claims {claims}." if claims else ""
    return (
        f'<figure class="{card}" id="figure-{escape(plate.key)}"><div class="head"><h3>{escape(label)}</h3>'
        f"{badge}</div><p><b>The text:</b> {escape(plate.printed)}</p>"
        f"{_image(folder / plate.files[0], label)}<figcaption><p>{escape(plate.caption)}</p>"
        f"{_numbers(plate.numbers)}<p class='soft'>{links}.{related}</p></figcaption></figure>"
    )


def _image(path: Path, label: str) -> str:
    if path.suffix == ".svg":
        text = path.read_bytes()
        size = re.search(r'width="\d+" height="\d+"', text.decode())
        return (
            '<img class="plate drawn" src="data:image/svg+xml;base64,'
            f'{base64.b64encode(text).decode("ascii")}" {size[0] if size else ""} alt="{escape(label)}">'
        )
    data, width, height = _small(path, path.stat().st_mtime_ns)
    return (
        f'<img class="plate" src="data:image/png;base64,{data}" width="{width}" height="{height}" '
        f'alt="{escape(label)}">'
    )


@lru_cache(maxsize=256)
def _small(path: Path, _changed: int) -> tuple[str, int, int]:
    """A figure as the page shows it, base64: smaller, and in shades of the house colours alone.

    A palette found in the image itself would merge the colours of thin lines, which have few pixels.
    """
    from PIL import Image

    with Image.open(path) as full:
        size = (_WIDTH, round(full.height * _WIDTH / full.width))
        image = full.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    data = io.BytesIO()
    palette = Image.new("P", (1, 1))
    palette.putpalette(_palette())
    image.quantize(palette=palette, dither=Image.Dither.NONE).save(data, "PNG", optimize=True)
    return base64.b64encode(data.getvalue()).decode("ascii"), *size


def _palette() -> list[int]:
    """Red, green and blue of at most 256 colours: those of the house, each fading into white.

    Shades that are nearly white are left out: Pillow matches colours roughly, and paper has to stay white.
    """
    share = np.linspace(1.0, 0.0, _SHADES, endpoint=False)[:, None]
    fading = [255.0 - share * (255.0 - 255.0 * np.array(colour)) for colour in COLOURS.values()]
    shades = np.rint(np.concatenate(fading)).astype(int)
    return [255, 255, 255, *shades[shades.min(axis=1) < _PAPER].ravel().tolist()]
