"""Writes the results table of README.md from docs/results/learned.md, so that the numbers stand in one place.

    python docs/summary.py

MkDocs does not read this file; a test holds README to what it writes.
"""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
README, RESULTS = ROOT / "README.md", ROOT / "docs" / "results" / "learned.md"
POLICIES = {"lmpc": "linear MPC", "nmpc": "exact NMPC", "apg": "APG", "dagger": "DAgger", "ppo": "PPO"}
# Beginning of a row in the results, and what README calls it.
ROWS = {
    "Helix": "`HelixTracking`",
    "Random": "`RandomTracking`",
    "Spiral": "`SpiralTracking`",
    "Corridor": "`CorridorTracking`",
    "its steps violating": "its steps that break a limit",
    "2.45 N rotors": "weak rotors, far starts (crashes)",
}
_BLOCK = re.compile(r"(<!-- table: python docs/summary.py -->\n).*?(<!-- end of table -->)", re.DOTALL)


def result_rows() -> list[dict[str, str]]:
    """Rows of all tables of the results page: cells by column name, the first under "". Bold is left out."""
    rows, head = [], None
    for line in RESULTS.read_text(encoding="utf-8").replace("**", "").splitlines():
        if not line.startswith("|"):
            head = None
            continue
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if head is None:
            head = ["", *cells[1:]]
        elif not set(cells[0]) <= set("-: "):
            rows.append(dict(zip(head, cells, strict=True)))
    return rows


def table() -> str:
    """The table as Markdown.

    Raises:
        ValueError: If the results page has no row, or no column, that README shows.
    """
    rows = result_rows()
    lines = ["| | " + " | ".join(POLICIES.values()) + " |", "|---" * (1 + len(POLICIES)) + "|"]
    for start, title in ROWS.items():
        found = next((row for row in rows if row[""].startswith(start)), None)
        if found is None or not found.keys() >= POLICIES.keys():
            raise ValueError(
                f"{RESULTS} has no row {start!r} with the columns {', '.join(POLICIES)}: change ROWS and "
                f"POLICIES of {Path(__file__).name}, or the page"
            )
        lines.append(f"| {title} | " + " | ".join(found[name] for name in POLICIES) + " |")
    return "\n".join(lines) + "\n"


def renewed() -> str:
    """The text of README.md with the table of today's results."""
    return _BLOCK.sub(lambda match: match[1] + table() + match[2], README.read_text(encoding="utf-8"))


if __name__ == "__main__":
    README.write_text(renewed(), encoding="utf-8")
    print(README)
