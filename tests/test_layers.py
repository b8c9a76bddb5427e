"""Imports go one way: quad_envs <- controllers <- baselines <- benchmarks and tests."""

import ast
import pathlib

import pytest

ROOT = pathlib.Path(__file__).parent.parent
LAYERS = ["quad_envs", "controllers", "baselines", "benchmarks"]
FILES = [path for layer in LAYERS for path in sorted((ROOT / layer).rglob("*.py"))]


def imported_packages(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.module.split(".")[0]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_file_imports_a_layer_above_its_own(path):
    rank = LAYERS.index(path.relative_to(ROOT).parts[0])
    above = {name for name in imported_packages(path) if name in LAYERS and LAYERS.index(name) > rank}
    assert not above
