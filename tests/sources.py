"""Where the project lies, for tests that read its text.

`make check-release` runs the tests beside everything that the sdist brings but the packages, which are those
of the wheel: what reads their folders, or runs a tool on them, is skipped there.
"""

from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("quad_envs", "controllers", "baselines")

reads_sources = pytest.mark.skipif(
    not (ROOT / PACKAGES[0]).is_dir(),
    reason="reads the sources of the packages; here they are installed from a wheel",
)
