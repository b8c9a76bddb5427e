"""The page of the reproduction: every table, claim and figure, what is printed, what we get, and the verdict.

It loads nothing: figures stand in it as small images, there is no script, and the content-security policy
allows its own style by its digest and images of its own alone.
"""

from __future__ import annotations

import base64
import hashlib
import io
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from html import escape
from importlib import resources
from pathlib import Path

import numpy as np

from ..report.figures import COLOURS
from .results import Cell, Claim, Measured, Plate, Section, show, verdict

NAME = "reproduction.html"
VERDICTS = {
    "HOLDS": "what the text says is what we get",
    "PARTLY": "in some of the cases, or with a condition that the text does not state",
    "FALSE": "we get something else",
    "SHOWN": "a picture of which the text states nothing",
}
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
flights: the source has their data as pictures only.</p>
<dl class="meaning">{meaning}</dl>{note}"""


def _words(section: Section) -> Iterable[str]:
    yield from (claim.verdict for claim in section.claims)
    yield from (plate.verdict for plate in section.plates)
    if any(isinstance(cell, Cell) for cell in section.cells):
        yield _verdict_of_table(section.cells)


def _verdict_of_table(cells: Sequence[Cell | Measured]) -> str:
    near = [abs(cell.ratio - 1.0) <= _NEAR for cell in cells if isinstance(cell, Cell)]
    return verdict(sum(near) / len(near))


def _badge(word: str, text: str = "") -> str:
    kind = word.lower() if word in VERDICTS else "shown"
    return f'<span class="verdict {kind}">{escape(text or word)}</span>'


def _entry(section: Section) -> str:
    count = Counter(_words(section))
    badges = " ".join(_badge(word, f"{count[word]} {word}") for word in VERDICTS if count[word])
    return f'<li><a href="#{escape(section.name)}">{escape(section.title)}</a><span>{badges}</span></li>'


def _section(section: Section, folder: Path, known: set[str]) -> str:
    command = f"quad-envs reproduce {section.name}" + (" --out DIR" if section.plates else "")
    parts = [
        f'<section id="{escape(section.name)}"><h2>{escape(section.title)}</h2>',
        f'<p class="soft">Repeat: <code>{escape(command)}</code></p>',
        _table([cell for cell in section.cells if isinstance(cell, Cell)]),
        *(_claim(claim) for claim in section.claims),
        _measured([cell for cell in section.cells if isinstance(cell, Measured)]),
        *(_plate(plate, folder, known) for plate in section.plates),
        "</section>",
    ]
    return "\n".join(part for part in parts if part)


def _table(cells: Sequence[Cell]) -> str:
    """Printed numbers beside ours."""
    if not cells:
        return ""
    misfit = [abs(cell.ratio - 1.0) for cell in cells]
    near, mean_square = sum(m <= _NEAR for m in misfit), sum(m * m for m in misfit) / len(misfit)
    rows = "".join(
        f"<tr><th scope='row'>{escape(cell.where)}</th><td>{cell.printed:.4f}</td><td>{cell.ours:.4f}</td>"
        f"<td>{cell.ratio:.3f}</td><td>{_closeness(abs(cell.ratio - 1.0))}</td></tr>"
        for cell in cells
    )
    return (
        f"<p>{_badge(_verdict_of_table(cells))} {near} of {len(cells)} numbers within {_NEAR:.0%}; relative "
        f"misfit: rms {mean_square**0.5:.1%}, largest {max(misfit):.1%}.</p>"
        f'<div class="scroll"><table><thead><tr><th>{escape(cells[0].quantity)}</th><th>printed</th>'
        f"<th>ours</th><th>ratio</th><th>verdict</th></tr></thead><tbody>{rows}</tbody></table></div>"
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


def _numbers(numbers: Mapping[str, float | str]) -> str:
    return (
        f"<dl>{''.join(f'<dt>{escape(k)}</dt><dd>{escape(show(v))}</dd>' for k, v in numbers.items())}</dl>"
    )


def _claim(claim: Claim) -> str:
    differs = claim.prototype and claim.prototype != claim.verdict
    aside = (
        f'<p class="soft">An independent prototype led to: {escape(claim.prototype)}.</p>' if differs else ""
    )
    return (
        f'<article class="card" id="claim-{escape(claim.key)}"><div class="head">'
        f"<h3>{escape(claim.text)}</h3>{_badge(claim.verdict)}</div>{_numbers(claim.numbers)}{aside}"
        "</article>"
    )


def _plate(plate: Plate, folder: Path, known: set[str]) -> str:
    printed = plate.key[:1].isdigit()
    label = f"Figure {plate.key}: {plate.title}" if printed else plate.title
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
        f'<figure class="card" id="figure-{escape(plate.key)}"><div class="head"><h3>{escape(label)}</h3>'
        f"{badge}</div><p><b>The text:</b> {escape(plate.printed)}</p>"
        f"{_image(folder / plate.files[0], label)}<figcaption><p>{escape(plate.caption)}</p>"
        f"{_numbers(plate.numbers)}<p class='soft'>{links}.{related}</p></figcaption></figure>"
    )


def _image(path: Path, label: str) -> str:
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
