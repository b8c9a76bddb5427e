"""The page itself: template, style and scripts joined into one file that loads nothing else."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from functools import cache
from importlib import resources

from .model import Report, to_plain

# In the order in which they build on each other; together they are one script.
SCRIPTS = (
    "data.js",
    "format.js",
    "table.js",
    "frontier.js",
    "camera.js",
    "scene.js",
    "plots.js",
    "series.js",
    "viewer.js",
    "app.js",
)


@cache
def _part(name: str) -> str:
    return resources.files("baselines.report").joinpath("page", name).read_text("utf-8")


def render_page(report: Report) -> str:
    """The page of a report.

    Names in the data come from users. They stand in a block of JSON in which every character that could end
    the block is written as an escape, and the scripts show them as text only. The content-security policy
    allows the page's own style and script by their digests and nothing else, so that nothing is ever fetched.
    """
    style = _part("style.css")
    script = '"use strict";\n(() => {\n' + "\n".join(_part(name) for name in SCRIPTS) + "\n})();\n"
    policy = (
        f"default-src 'none'; style-src 'sha256-{_digest(style)}'; script-src 'sha256-{_digest(script)}'; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )
    parts = {
        "policy": policy,
        "title": html.escape(report.title),
        "style": style,
        "script": script,
        "data": embed(json.dumps(to_plain(report), allow_nan=False, separators=(",", ":"))),
    }
    # In one pass, so that a name that looks like a mark stays a name.
    return re.sub(r"{{(\w+)}}", lambda mark: parts[mark[1]], _part("template.html"))


def embed(text: str) -> str:
    """JSON that may stand in a script block: no character of it can end the block or begin a comment."""
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
