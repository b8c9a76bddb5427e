"""Compiled kernels are found again by content; no folder, file or version of numba stops a start."""

import cProfile
import importlib
import os
import subprocess
import sys
import textwrap
import warnings
from pathlib import Path
from types import ModuleType

import numba
import numpy as np
import pytest
from numba import float32, float64, njit
from numba.core import config
from numba.core.registry import cpu_target
from processes import printed_with_kernels_in

from quad_envs.compilation import cache
from quad_envs.compilation.decorators import kernel

SOURCE = """
from enum import IntEnum
from typing import NamedTuple
GAIN = 3.0
TABLE = np.array([1.0, 2.0])

class Pair(NamedTuple):
    first: float
    second: float

class Place(IntEnum):
    START = 0

def deepest(x, gain=1.0, *, offset=0.0):
    return gain * x + offset + DEEP[1][0]

def deeper(x):
    return deepest(x)

def inner(x):
    "A docstring."
    return GAIN * deeper(x)

def outer(x):
    pair = Pair(x, TABLE[Place.START])
    return inner(pair.first) + pair.second + sum(make(g)(x) for g in (1, 2))

def make(gain):
    return lambda x: gain * x

triple, double = make(3.0), make(2.0)

def both(x):
    return triple(x) + double(x)

DEEP = (1.0, np.array([5.0]))
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
        ("return GAIN * deeper(x)", "return GAIN + deeper(x)"),
        ("gain * x + offset", "gain * x - offset"),
        ("gain=1.0", "gain=2.0"),
        ("offset=0.0", "offset=1.0"),
        ("np.array([5.0])", "np.array([6.0])"),
        ("START = 0", "START = 1"),
        ("GAIN = 3.0", "GAIN = 4.0"),
        ("1.0, 2.0", "1.0, 2.5"),
        ("    first: float\n    second: float", "    second: float\n    first: float"),
    ],
)
def test_whatever_a_kernel_reaches_voids_it_when_it_changes(old, new):
    assert digest_of(SOURCE.replace(old, new)) != digest_of(SOURCE)


def test_what_a_kernel_does_not_reach_leaves_it_valid():
    assert digest_of(SOURCE.replace("+ pair.second", "- pair.second"), "inner") == digest_of(SOURCE, "inner")


def test_a_constant_read_through_a_module_and_one_in_a_closure_count():
    def make(module_gain, enclosed_gain):
        constants = ModuleType("quad_envs.made_up")
        constants.GAIN = module_gain
        module = {"__name__": "made_up", "constants": constants}
        exec("def make(gain):\n    return lambda x: constants.GAIN * gain * x", module)
        return cache.digest(module["make"](enclosed_gain))

    assert make(2.0, 3.0) == make(2.0, 3.0)
    assert len({make(2.0, 3.0), make(2.5, 3.0), make(2.0, 3.5)}) == 3


def test_kernels_of_one_factory_are_told_apart():
    assert digest_of(SOURCE.replace("make(2.0)", "make(4.0)"), "both") != digest_of(SOURCE, "both")
    swapped = SOURCE.replace("make(3.0), make(2.0)", "make(2.0), make(3.0)")
    assert digest_of(swapped, "both") != digest_of(SOURCE, "both")


def test_a_constant_read_through_two_modules_counts():
    def of(gain):
        outer, inner = ModuleType("quad_envs.outer"), ModuleType("quad_envs.inner")
        outer.inner, inner.GAIN, inner.outer = inner, gain, outer
        module = {"__name__": "made_up", "outer": outer}
        exec("def read(x):\n    return outer.inner.GAIN * x", module)
        return cache.digest(module["read"])

    assert of(2.0) == of(2.0) != of(3.0)


def test_options_of_compilation_count_at_every_depth():
    def of(**options):
        module = {"__name__": "made_up", "inner": njit(**options)(lambda x: 2.0 * x)}
        exec("def outer(x):\n    return inner(x)", module)
        return cache.digest(module["outer"]), cache.digest(module["inner"])

    for once, again, other in zip(of(), of(), of(fastmath={"contract"}), strict=True):
        assert once == again != other


def test_a_profiler_leaves_a_kernel_valid():
    compiled = kernel(lambda x: 2.0 * x)
    before = cache.digest(compiled)
    with cProfile.Profile():
        assert compiled(1.5) == compiled(1.5) == 3.0
    assert cache.digest(compiled) == before


def identity(x):
    return x


def file_name(signature=(float64,)):
    """Under which a kernel is kept."""
    processor = cpu_target.target_context.codegen().magic_tuple()
    return cache.KernelCache(kernel(identity)).name(signature, processor)


@pytest.mark.parametrize(
    ("owner", "name", "value"),
    [
        (numba, "__version__", "0.1"),
        (np, "__version__", "1.0"),
        (config, "OPT", 0),
        (config, "BOUNDSCHECK", 1),
        (type(cpu_target.target_context.codegen()), "magic_tuple", lambda codegen: ("another processor",)),
    ],
)
def test_another_version_setting_or_processor_voids_a_kernel(monkeypatch, owner, name, value):
    here = file_name()
    assert here == file_name() != file_name((float32,))
    monkeypatch.setattr(owner, name, value)
    assert file_name() != here and file_name().split("-")[:2] == here.split("-")[:2]


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
        assert file.read_bytes() != broken
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


def shipped_kernel(tmp_path, monkeypatch):
    """A kernel that came with a wheel, for a user who has compiled nothing; its file, the user's folder."""
    made, shipped, own = (tmp_path / name for name in ("made", "shipped", "own"))
    for folder in (made, shipped, own):
        folder.mkdir()
    compiled = fresh_kernel(made, monkeypatch)
    compiled(1.5)
    processor = (cpu_target.target_context.codegen().magic_tuple()[0], cache.CPU, "")
    file = shipped / f"{compiled.entry._cache.name((float64,), processor)}.nbc"
    next(made.iterdir()).rename(file)
    monkeypatch.setattr(cache, "SHIPPED", shipped)
    monkeypatch.setattr(cache, "runs_shipped", cache.runs_shipped.__wrapped__)
    monkeypatch.setattr(cache.llvm, "get_host_cpu_features", lambda: dict.fromkeys(cache.NEEDED, True))
    return fresh_kernel(own, monkeypatch), file, own


def test_a_kernel_that_came_with_a_wheel_is_loaded_and_not_compiled(tmp_path, monkeypatch):
    compiled, _, own = shipped_kernel(tmp_path, monkeypatch)
    assert compiled(1.5) == 3.0 and sum(compiled.entry.stats.cache_hits.values()) == 1
    assert not list(own.iterdir())


@pytest.mark.parametrize(
    ("owner", "name", "value"),
    [
        (cache.llvm, "get_host_cpu_features", lambda: {**dict.fromkeys(cache.NEEDED, True), "avx2": False}),
        (config, "CPU_NAME", "generic"),
    ],
    ids=["older", "chosen"],
)
def test_on_another_processor_than_the_wheels_a_kernel_is_compiled(tmp_path, monkeypatch, owner, name, value):
    compiled, _, own = shipped_kernel(tmp_path, monkeypatch)
    monkeypatch.setattr(owner, name, value)
    assert compiled(1.5) == 3.0 and sum(compiled.entry.stats.cache_misses.values()) == 1
    assert len(list(own.iterdir())) == 1


def test_a_cut_file_of_a_wheel_that_cannot_be_deleted_is_compiled_and_kept_elsewhere(tmp_path, monkeypatch):
    compiled, file, own = shipped_kernel(tmp_path, monkeypatch)
    file.write_bytes(file.read_bytes()[:-1])
    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", fails_to_write)
        assert compiled(1.5) == 3.0
    assert file.exists() and sum(compiled.entry.stats.cache_misses.values()) == 1
    again = fresh_kernel(own, monkeypatch)
    assert again(1.5) == 3.0 and sum(again.entry.stats.cache_hits.values()) == 1


def fails_to_write(*arguments, **keywords):
    raise PermissionError("read-only")


EVERYTHING = """
import sys
from typing import NamedTuple
import numpy as np
from quad_envs.compilation.decorators import kernel

class Pair(NamedTuple):
    table: np.ndarray
    total: float

class Found(NamedTuple):
    first: float
    total: float

@kernel
def inner(n, gain, table):
    if n > 9:
        raise ValueError("n must be at most 9")
    for k in range(n):
        table[k] = k * gain
    return table[::-1]

@kernel
def outer(n, pair):
    table, total = inner(n, pair.total, pair.table), 0.0
    for k in range(n):
        total += np.sin(table[k])
    return Found(table[0] + 1.0, total)

@kernel
def other(x):
    return np.dot(x, x) - x[0]

print(outer(3, Pair(np.ones(3), 2.0)))
try:
    outer(12, Pair(np.ones(12), 2.0))
except ValueError as error:
    print(error)
print("compiler loaded:", "numba.np.arraymath" in sys.modules, "scipy.linalg" in sys.modules)
if len(sys.argv) > 1:
    print(other(np.ones(4)))
"""


def test_kernels_found_again_need_no_compiler_and_others_compile_beside_them(tmp_path):
    script = tmp_path / "everything.py"
    script.write_text(EVERYTHING)

    def run(*arguments):
        return printed_with_kernels_in(tmp_path, script, *arguments)

    cold, warm, mixed = run(), run(), run("more")
    said = "Found(first=5.0, total=0.1524949"
    assert cold.startswith(said) and "n must be at most 9" in cold
    assert "compiler loaded: True True" in cold
    assert warm == cold.replace("True True", "False False")
    assert mixed == warm + "3.0\n"


def test_kernels_are_compiled_where_no_c_compiler_can_be_found(tmp_path):
    script, empty = tmp_path / "everything.py", tmp_path / "empty"
    script.write_text(EVERYTHING)
    empty.mkdir()
    environment = {key: value for key, value in os.environ.items() if key not in ("CC", "CXX")}
    environment |= {"NUMBA_CACHE_DIR": str(tmp_path), "PATH": str(empty)}
    done = subprocess.run(
        [sys.executable, str(script)], env=environment, capture_output=True, text=True, check=True
    )
    assert "Found(first" in done.stdout and list((tmp_path / "quad-envs").glob("*.nbc"))


def test_two_processes_that_compile_at_once_leave_whole_files(tmp_path):
    script = tmp_path / "everything.py"
    script.write_text(EVERYTHING)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    both = [
        subprocess.Popen([sys.executable, str(script)], env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    said = [process.communicate()[0] for process in both]
    assert said[0] == said[1] and "Found(first" in said[0] and "True True" in said[0]
    assert [path.suffix for path in (tmp_path / "quad-envs").iterdir()] == [".nbc"]
    third = subprocess.run(
        [sys.executable, str(script)], env=environment, capture_output=True, text=True, check=True
    )
    assert "compiler loaded: False False" in third.stdout


def test_a_kernel_that_calls_what_is_not_there_is_compiled_anew(tmp_path, monkeypatch):
    from quad_envs.compilation import kernel_file

    assert fresh_kernel(tmp_path, monkeypatch)(1.5) == 3.0
    (file,) = tmp_path.iterdir()
    packed = file.read_bytes()[cache._HEADER :]
    with pytest.raises(ValueError, match="needs no_such_function"):
        monkeypatch.setattr(kernel_file, "_missing", lambda needed: ["no_such_function"])
        kernel_file.unpack(packed, cpu_target.target_context, load=lambda name: None)
    again = fresh_kernel(tmp_path, monkeypatch)
    assert again(1.5) == 3.0 and sum(again.entry.stats.cache_misses.values()) == 1


ONE_STEP = """
import gymnasium as gym, numpy as np, quad_envs
env = gym.make("quad/HelixTracking-v0")
env.reset(seed=0)
observation, reward, *_ = env.step(np.full(4, 0.1, np.float32))
print(float(reward).hex(), observation.tobytes().hex())
"""


@pytest.mark.slow  # compiles the environment's kernels in numba's plain way
@pytest.mark.parametrize("module", ["quad_envs.compilation.nested", "quad_envs.compilation.kernel_file"])
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
    monkeypatch.delitem(sys.modules, "quad_envs.compilation.nested")
    with pytest.raises(ImportError, match=r"no CPUCodeLibrary\._finalize_dynamic_globals"):
        importlib.import_module("quad_envs.compilation.nested")


def test_two_nested_kernels_give_the_same_nested_and_plain(monkeypatch):
    from quad_envs.compilation import decorators

    def build():
        inner = decorators.kernel(lambda x: x * x + 1.0)
        return decorators.kernel(lambda x: inner(x) / 3.0)

    nested = build()
    monkeypatch.setattr(decorators, "NestedKernel", None)
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
