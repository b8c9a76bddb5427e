"""How an extra of pyproject.toml is installed: from a clone, since the suite is on no package index."""

from __future__ import annotations


def install_command(extra: str) -> str:
    """What an error message tells the user to run.

    Args:
        extra: A name of `[project.optional-dependencies]`, as "rl".
    """
    return f'pip install -c constraints.txt -e ".[{extra}]" in your clone of the repository'
