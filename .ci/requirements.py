"""Requirements of pyproject.toml as pip reads them: `requirements.py EXTRA [--lowest] [--without NAME ...]`.

All of the project and of an extra, those that it takes from other extras, too; with `--lowest` each at
exactly its lower bound, so that what we promise to work is what is tested.
"""

import argparse
import re
import sys
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROJECT = Path(__file__).parent.parent / "pyproject.toml"


def requirements(extra: str) -> list[str]:
    """Of the project with an extra."""
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    found, waiting = list(project["dependencies"]), [extra]
    for name in waiting:
        for line in project["optional-dependencies"][name]:
            own = re.fullmatch(rf"{project['name']}\[(.+)\]", line)
            if own:
                waiting += own[1].split(",")
            else:
                found.append(line)
    return list(dict.fromkeys(found))


def name_of(line: str) -> str:
    """The package of a requirement."""
    return re.match(r"[\w.-]+", line)[0]


def lowest(line: str) -> str:
    """A requirement at exactly its lower bound."""
    package, bound, marker = re.match(r"([\w.-]+(?:\[.+?\])?)>=([\w.]+)[^;]*(;.*)?$", line).groups()
    return f"{package}=={bound}{marker or ''}"


def main() -> None:
    """Print them, one a line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("extra")
    parser.add_argument("--lowest", action="store_true")
    parser.add_argument("--without", nargs="*", default=[])
    options = parser.parse_args()
    for line in requirements(options.extra):
        if name_of(line) not in options.without:
            print(lowest(line) if options.lowest else line)


if __name__ == "__main__":
    main()
