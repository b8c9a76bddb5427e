"""Where the project lies, for tests that read its text.

`make check-release` runs the tests beside everything that the sdist brings but the packages, which are those
of the wheel: what reads their folders, or runs a tool on them, is skipped there.
"""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("quad_envs", "controllers", "baselines")

reads_sources = pytest.mark.skipif(
    not (ROOT / PACKAGES[0]).is_dir(),
    reason="reads the sources of the packages; here they are installed from a wheel",
)


def script(name: str) -> ModuleType:
    """One of the scripts that write pages, which lie beside them and are in no package."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
