"""Compiled kernels are found again by content; no folder, file or version of numba stops a start."""

import importlib
import os
import subprocess
import sys
import textwrap
import warnings
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from quad_envs import _kernel_cache as cache
from quad_envs._numba import kernel

SOURCE = """
from typing import NamedTuple
GAIN = 3.0
TABLE = np.array([1.0, 2.0])

class Pair(NamedTuple):
    first: float
    second: float

def inner(x):
    "A docstring."
    return GAIN * x

def outer(x):
    pair = Pair(x, TABLE[0])
    return inner(pair.first) + pair.second
"""


def digest_of(source, name="outer"):
    module = {"__name__": "made_up", "np": np}
    exec(textwrap.dedent(source), module)
    return cache.digest(module[name])


@pytest.mark.parametrize(
    ("old", "new"),
    [("def inner", "\n\n# a comment\ndef inner"), ("A docstring.", "Another one."), ("x)", "x )")],
)
def test_comments_docstrings_and_lines_leave_a_compiled_kernel_valid(old, new):
    assert digest_of(SOURCE.replace(old, new)) == digest_of(SOURCE)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("return GAIN * x", "return GAIN + x"),
        ("GAIN = 3.0", "GAIN = 4.0"),
        ("1.0, 2.0", "1.0, 2.5"),
        ("    first: float\n    second: float", "    second: float\n    first: float"),
    ],
)
def test_whatever_a_kernel_reaches_voids_it_when_it_changes(old, new):
    assert digest_of(SOURCE.replace(old, new)) != digest_of(SOURCE)


def test_what_a_kernel_does_not_reach_leaves_it_valid():
    assert digest_of(SOURCE.replace("TABLE[0]", "TABLE[1]"), "inner") == digest_of(SOURCE, "inner")


def test_a_constant_read_through_a_module_and_one_in_a_closure_count():
    def make(module_gain, enclosed_gain):
        constants = ModuleType("quad_envs.made_up")
        constants.GAIN = module_gain
        module = {"__name__": "made_up", "constants": constants}
        exec("def make(gain):\n    return lambda x: constants.GAIN * gain * x", module)
        return cache.digest(module["make"](enclosed_gain))

    assert make(2.0, 3.0) == make(2.0, 3.0)
    assert len({make(2.0, 3.0), make(2.5, 3.0), make(2.0, 3.5)}) == 3


def fresh_kernel(folder, monkeypatch):
    """A kernel that no process has compiled, with its cache in a folder of the test's."""
    monkeypatch.setattr(cache, "folders", lambda: (folder,))
    monkeypatch.setattr(cache, "folder", lambda: folder)

    def double(x):
        return 2.0 * x

    return kernel(double)


def test_a_cut_or_foreign_file_is_deleted_and_compiled_anew(tmp_path, monkeypatch):
    assert fresh_kernel(tmp_path, monkeypatch)(1.5) == 3.0
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    for broken in (whole[:-100], b"", b"x" * 5000, whole[:40] + bytes([whole[40] ^ 1]) + whole[41:]):
        file.write_bytes(broken)
        again = fresh_kernel(tmp_path, monkeypatch)
        assert again(1.5) == 3.0
        assert sum(again.entry.stats.cache_misses.values()) == 1
        assert file.stat().st_size == len(whole)
    again = fresh_kernel(tmp_path, monkeypatch)
    assert again(1.5) == 3.0 and sum(again.entry.stats.cache_hits.values()) == 1


def test_where_no_folder_can_be_written_kernels_run_and_one_warning_says_so(tmp_path, monkeypatch):
    file = tmp_path / "a file"
    file.write_text("")
    monkeypatch.setattr(cache, "_places", lambda: iter([file / "below", file]))
    monkeypatch.setattr(cache, "folders", cache.folders.__wrapped__)
    with pytest.warns(RuntimeWarning, match="set NUMBA_CACHE_DIR to one that can"):
        assert cache.folder.__wrapped__() is None
    monkeypatch.setattr(cache, "folder", lambda: None)
    assert kernel(lambda x: 3.0 * x)(2.0) == 6.0


def test_a_read_only_folder_that_is_filled_is_read_and_another_one_written(tmp_path, monkeypatch):
    filled, own = tmp_path / "filled", tmp_path / "own"
    filled.mkdir()
    own.mkdir()
    assert fresh_kernel(filled, monkeypatch)(1.5) == 3.0
    again = fresh_kernel(own, monkeypatch)
    monkeypatch.setattr(cache, "folders", lambda: (filled, own))
    assert again(1.5) == 3.0 and sum(again.entry.stats.cache_hits.values()) == 1
    assert not list(own.iterdir())


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="permissions of POSIX")
def test_a_folder_into_which_others_can_write_is_not_trusted(tmp_path, monkeypatch):
    tmp_path.chmod(0o777)
    monkeypatch.setattr(cache, "_places", lambda: iter([tmp_path]))
    assert cache.folders.__wrapped__() == ()
    tmp_path.chmod(0o755)
    assert cache.folders.__wrapped__() == (tmp_path,)


def test_old_versions_of_a_kernel_and_unfinished_files_are_swept_after_a_while(tmp_path, monkeypatch):
    first = fresh_kernel(tmp_path, monkeypatch)
    name = first.entry._cache._name
    old, recent, unfinished = (tmp_path / f"{name}-{tail}" for tail in ("1-2.nbc", "3-4.nbc", "5-6.7.tmp"))
    for path in (old, recent, unfinished):
        path.write_bytes(b"")
    for path in (old, unfinished):
        os.utime(path, (0.0, 0.0))
    first(1.0)
    assert recent.exists() and not old.exists() and not unfinished.exists()


ONE_STEP = """
import gymnasium as gym, numpy as np, quad_envs
env = gym.make("quad/HelixTracking-v0")
env.reset(seed=0)
observation, reward, *_ = env.step(np.full(4, 0.1, np.float32))
print(float(reward).hex(), observation.tobytes().hex())
"""


@pytest.mark.slow  # compiles the environment's kernels in numba's plain way
@pytest.mark.parametrize("module", ["quad_envs._nested", "quad_envs._kernel_cache"])
def test_without_the_private_names_of_numba_a_step_is_the_same_and_one_warning_says_why(module):
    hide = f"import sys\nsys.modules[{module!r}] = None\n"
    run = [
        subprocess.run([sys.executable, "-c", code + ONE_STEP], capture_output=True, text=True, check=True)
        for code in ("", hide)
    ]
    assert run[0].stdout == run[1].stdout
    assert run[1].stderr.count("lacks what quad_envs uses to compile fast") == 1
    assert module in run[1].stderr and "RuntimeWarning" not in run[0].stderr


def test_a_private_name_that_is_missing_is_found_at_the_import_and_named(monkeypatch):
    from numba.core.codegen import CPUCodeLibrary

    monkeypatch.delattr(CPUCodeLibrary, "_finalize_dynamic_globals")
    monkeypatch.delitem(sys.modules, "quad_envs._nested")
    with pytest.raises(ImportError, match=r"no CPUCodeLibrary\._finalize_dynamic_globals"):
        importlib.import_module("quad_envs._nested")


def test_two_nested_kernels_give_the_same_nested_and_plain(monkeypatch):
    from quad_envs import _numba

    def build():
        inner = _numba.kernel(lambda x: x * x + 1.0)
        return _numba.kernel(lambda x: inner(x) / 3.0)

    nested = build()
    monkeypatch.setattr(_numba, "NestedKernel", None)
    plain = build()
    assert type(nested) is not type(plain)
    for x in (0.0, -2.5, np.inf):
        assert nested(x) == plain(x)


def test_the_kernels_of_the_package_lie_beside_it_and_nowhere_else():
    import quad_envs

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        place = cache.folder()
    if "NUMBA_CACHE_DIR" not in os.environ:
        assert place == Path(quad_envs.__file__).parent / "__pycache__" / "kernels"
