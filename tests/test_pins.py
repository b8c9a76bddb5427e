"""The versions of constraints.txt fit together and the ranges of the suite; messages name what there is."""

import re
import sys
from importlib import metadata

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from sources import ROOT, reads_sources

from baselines.cli.doctor import EXTRAS
from quad_envs.arguments.extras import install_command

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
OPTIONAL = PROJECT["optional-dependencies"]
NEWEST = {"python_version": "3.13", "python_full_version": "3.13.0"}  # where every pin holds


def pins(here=NEWEST):
    """Version of each package that is pinned in an environment."""
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    found = [Requirement(line) for line in lines if line and not line.startswith("#")]
    held = [pin for pin in found if pin.marker is None or pin.marker.evaluate(here)]
    return {canonicalize_name(pin.name): next(iter(pin.specifier)).version for pin in held}


def asked_of(name, extras=frozenset()):
    """What an installed package requires, with these of its own extras."""
    for text in metadata.requires(name) or ():
        asked = Requirement(text)
        marker = asked.marker
        if marker is None or any(marker.evaluate(NEWEST | {"extra": extra}) for extra in ("", *extras)):
            yield asked


def is_installed(name):
    try:
        metadata.version(name)
    except metadata.PackageNotFoundError:
        return False
    return True


def is_as_pinned(name):
    """Whether it is installed here as the pins say, or without one: what others ask for is another matter."""
    pin = pins().get(canonicalize_name(name))
    return is_installed(name) and pin in (None, metadata.version(name).partition("+")[0])


def all_requirements():
    """(who asks, what) for the suite with all extras and for whatever of that is here as pinned."""
    own = [Requirement(text) for group in ([PROJECT["dependencies"], *OPTIONAL.values()]) for text in group]
    waiting = [("quad-envs", asked) for asked in own if asked.name != "quad-envs"]
    met = set()
    while waiting:
        owner, asked = waiting.pop()
        yield owner, asked
        key = canonicalize_name(asked.name), frozenset(asked.extras)
        if key not in met and is_as_pinned(asked.name):
            met.add(key)
            waiting += [(asked.name, more) for more in asked_of(*key)]


def test_every_pin_is_inside_the_ranges_of_all_that_need_it():
    # Pillow 13 stood beside moviepy, which wants less than 12: nobody could install [video].
    found, asking = pins(), list(all_requirements())
    asks = {"moviepy", "matplotlib"} & pins(here={}).keys() | {
        "quad-envs"
    }  # of old Pythons nothing is pinned
    assert asks <= {owner for owner, _ in asking}, "install .[dev] first"
    wrong = [
        f"{owner} asks for {asked}, the pin is {found[name]}"
        for owner, asked in asking
        if (name := canonicalize_name(asked.name)) in found
        and not asked.specifier.contains(found[name], prereleases=True)
    ]
    assert wrong == []


def test_what_is_installed_here_is_what_the_pins_say():
    differing = {
        name: (metadata.version(name), pin)
        for name, pin in pins(here={}).items()
        if is_installed(name) and metadata.version(name).partition("+")[0] != pin
    }
    assert differing == {}, "tests run with other versions than constraints.txt claims"


def test_no_message_and_no_page_names_a_package_that_is_not_published():
    # The suite is on no index; whoever takes its name there would be installed by our own hints.
    texts = [
        path
        for folder in ("quad_envs", "controllers", "baselines", "docs", "examples", ".github", "benchmarks")
        for path in (ROOT / folder).rglob("*")
        if path.suffix in (".py", ".md", ".toml", ".yml", ".html")
    ]
    texts += [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "Makefile")]
    wrong = re.compile(r"pip install[^\n`]*[ \"']quad[-_]envs|quad-envs\[\w")
    assert [str(path) for path in texts if wrong.search(path.read_text(encoding="utf-8"))] == []


@reads_sources
def test_every_extra_that_a_message_names_exists():
    text = "".join(
        path.read_text(encoding="utf-8")
        for folder in ("quad_envs", "controllers", "baselines")
        for path in (ROOT / folder).rglob("*.py")
    )
    named = set(re.findall(r"install_command\([\"'](\w+)[\"']\)", text))
    assert named and named | EXTRAS.keys() <= OPTIONAL.keys()
    assert '".[rl]"' in install_command("rl")


def test_requires_python_the_classifiers_and_the_workflow_name_the_same_versions():
    listed = re.findall(r":: Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
    workflow = (ROOT / ".github" / "workflows" / "test.yml").read_text(encoding="utf-8")
    assert re.findall(r'"(3\.\d+)"', re.search(r"python: \[(.*)\]", workflow)[1]) == listed
    allowed = SpecifierSet(PROJECT["requires-python"])
    oldest = int(listed[0].split(".")[1])
    assert all(version in allowed for version in listed) and f"3.{oldest - 1}" not in allowed
