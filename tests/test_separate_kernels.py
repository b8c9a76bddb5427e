"""A separate kernel is compiled once for all that call it, in whatever process."""

from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
from processes import printed_with_kernels_in

from quad_envs.compilation import cache
from quad_envs.compilation.decorators import kernel, separate_kernel

SHARED = """
import sys
import numpy as np
from quad_envs.compilation.decorators import kernel, separate_kernel

@kernel
def twice(x):
    return 2.0 * x

@separate_kernel
def total(x):
    if x.size > 3:
        raise ValueError("at most three")
    found = 0.0
    for k in range(x.size):
        found += twice(x[k])
    return found

@kernel
def first(x):
    return total(x) + 1.0

@kernel
def second(x):
    return total(x) - 1.0

print([{"first": first, "second": second, "total": total}[name](np.ones(3)) for name in sys.argv[1:]])
try:
    first(np.ones(4))
except ValueError as error:
    print(error)
print("compiler loaded:", "numba.np.arraymath" in sys.modules)
"""


@pytest.fixture
def shared(tmp_path):
    """Runs `SHARED` with names of kernels to call; the folder of their files."""
    script = tmp_path / "shared.py"
    script.write_text(SHARED)

    def run(*names):
        return printed_with_kernels_in(tmp_path, script, *names)

    return run, tmp_path / "quad-envs"


def test_a_separate_kernel_is_compiled_once_for_all_that_call_it_in_any_process(shared):
    run, folder = shared
    assert run("first") == "[7.0]\nat most three\ncompiler loaded: True\n"
    (separate,) = folder.glob("__main__.total-*.nbc")
    made = separate.stat().st_mtime_ns
    assert run("second", "total").startswith("[5.0, 6.0]\nat most three")
    assert separate.stat().st_mtime_ns == made
    assert {path.name.split("-")[0] for path in folder.iterdir()} == {
        "__main__.first", "__main__.second", "__main__.total"
    }  # fmt: skip
    assert run("second", "first") == "[5.0, 7.0]\nat most three\ncompiler loaded: False\n"


def test_without_the_file_of_a_separate_kernel_all_that_call_it_are_compiled_anew(shared):
    run, folder = shared
    run("first", "second")
    (separate,) = folder.glob("__main__.total-*.nbc")
    for damage in (separate.unlink, lambda: separate.write_bytes(b"cut")):
        damage()
        assert run("first") == "[7.0]\nat most three\ncompiler loaded: True\n"
        assert separate.exists()
        assert run("first", "second").startswith("[7.0, 5.0]")
        assert run("first", "second").endswith("compiler loaded: False\n")


def test_of_two_processes_that_need_the_same_separate_kernel_one_compiles_it(shared):
    run, folder = shared
    script = SHARED + "print('misses', sum(total.stats.cache_misses.values()))\n"
    (folder.parent / "shared.py").write_text(script)
    with ThreadPoolExecutor() as pool:
        said = list(pool.map(run, ["first", "second"]))
    assert sorted(text.splitlines()[-1] for text in said) == ["misses 0", "misses 1"]
    assert [path.suffix for path in folder.iterdir()] == [".nbc"] * 3


def cannot_lock(*arguments):
    raise OSError("no locks")


def test_where_files_cannot_be_locked_a_separate_kernel_is_compiled_all_the_same(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "folder", lambda: tmp_path)
    monkeypatch.setattr(cache, "folders", lambda: (tmp_path,))
    for locks in (None, SimpleNamespace(flock=cannot_lock, LOCK_EX=0)):
        monkeypatch.setattr(cache, "fcntl", locks)
        compiled = separate_kernel(lambda x: 2.0 * x)
        assert compiled(1.5) == 3.0
    assert {path.suffix for path in tmp_path.iterdir()} == {".nbc"}


def test_a_separate_kernel_gives_the_same_as_one_that_is_part_of_its_caller(tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "folder", lambda: tmp_path)
    monkeypatch.setattr(cache, "folders", lambda: (tmp_path,))

    def build(compiled):
        inner = compiled(lambda x, gain: np.sin(x) * gain)
        return kernel(lambda x: inner(x, 3.0) + inner(2.0 * x, 0.1))

    separate, nested = build(separate_kernel), build(kernel)
    for x in (0.0, -2.5, 1e-3, np.inf):
        np.testing.assert_equal(separate(x), nested(x))
