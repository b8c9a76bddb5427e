"""What a wheel holds: every file of the packages, by the lists of pyproject.toml."""

import re
import sys
from fnmatch import fnmatch
from pathlib import Path

from sources import PACKAGES, ROOT, reads_sources

import quad_envs
from quad_envs.compilation.portable import SHIPPED

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SETUPTOOLS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]
FILES = [
    path.relative_to(ROOT)
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*"))
    if path.is_file() and "__pycache__" not in path.parts and path.suffix != ".nbc"
]


@reads_sources
def test_every_folder_is_listed_so_that_setuptools_neither_warns_nor_leaves_it_out():
    folders = {path.parent for path in FILES} | {path.parent.parent for path in FILES} - {Path()}
    # Folders with other names, as those of the shipped policies, cannot be packages; they are data.
    wanted = {".".join(folder.parts) for folder in folders if all(map(str.isidentifier, folder.parts))}
    assert wanted == set(SETUPTOOLS["packages"])


@reads_sources
def test_every_file_that_is_no_code_is_named_as_data():
    data = {
        path
        for package, patterns in SETUPTOOLS["package-data"].items()
        for pattern in patterns
        for path in (ROOT / package.replace(".", "/")).glob(pattern)
    }
    assert [path for path in FILES if path.suffix != ".py" and ROOT / path not in data] == []


@reads_sources
def test_a_wheel_holds_the_kernels_that_make_wheel_compiles():
    place = SHIPPED.relative_to(ROOT)
    assert f"cp build/portable/quad-envs/*.nbc {place.as_posix()}" in (ROOT / "Makefile").read_text()
    file = (place / "a.nbc").relative_to("quad_envs").as_posix()
    assert any(fnmatch(file, pattern) for pattern in SETUPTOOLS["package-data"]["quad_envs"])


def test_the_sdist_holds_whatever_the_project_holds():
    """Packages, pyproject.toml, README and licence come by themselves; all else by MANIFEST.in."""
    lines = (ROOT / "MANIFEST.in").read_text(encoding="utf-8").splitlines()
    named = {word for line in lines if line.split()[0] in ("graft", "include") for word in line.split()[1:]}
    named |= {*PACKAGES, "pyproject.toml", "README.md", "LICENSE", "MANIFEST.in"}
    ignored = {line.strip("/") for line in (ROOT / ".gitignore").read_text(encoding="utf-8").splitlines()}
    there = {path.name for path in ROOT.iterdir() if path.name not in (".git", "PKG-INFO", "setup.cfg")}
    assert {name for name in there if not any(fnmatch(name, ours) for ours in ignored)} <= named


def test_the_image_is_made_and_runs_with_one_python_that_is_supported_and_tested():
    """Kernels of a wheel are those of one Python: another one would compile its own."""
    lines = (ROOT / "Dockerfile").read_text(encoding="utf-8").splitlines()
    images = [line.split()[1] for line in lines if line.startswith("FROM")]
    assert len(images) == 2 and len(set(images)) == 1
    version = images[0].removeprefix("python:").removesuffix("-slim")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert f"Programming Language :: Python :: {version}" in project["classifiers"]
    assert 'ENTRYPOINT ["quad-envs"]' in lines and "quad-envs" in project["scripts"]


def test_the_citation_and_the_changelog_name_this_version_and_its_day():
    """Both are read by people without a build, so they cannot be computed; the package's is computed."""
    table = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    assert table["tool"]["setuptools"]["dynamic"]["version"] == {"attr": "quad_envs.__version__"}
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    license_name, version = table["project"]["license"], quad_envs.__version__
    assert f"\nversion: {version}\n" in citation and f"\nlicense: {license_name}\n" in citation
    (day,) = re.findall(r"^date-released: (\S+)$", citation, re.MULTILINE)
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    newest = next(head for head in re.findall(r"^## (.+)$", changelog, re.MULTILINE) if head != "Unreleased")
    assert newest == f"{version} - {day}"
