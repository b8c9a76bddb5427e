"""Values of many arrays behind one array of words."""

from __future__ import annotations

from typing import Annotated, NamedTuple, get_type_hints

import numpy as np
import pytest

from controllers.qp.ocp import IntArray
from quad_envs.compilation import packed
from quad_envs.compilation.decorators import kernel
from quad_envs.compilation.packed import pack, unpacker
from quad_envs.parameters import Array


class Inner(NamedTuple):
    counts: Annotated[IntArray, "K"]
    counted: bool


class Outer(NamedTuple):
    pairs: Annotated[Array, "1 or N, 12, 12"]
    scale: float
    inner: Inner
    limit: int
    force: Annotated[Array, "4"]


_unpack = unpacker(Outer)


@kernel
def read_and_write(words):
    value = _unpack(words)
    value.force[1] = value.scale
    total = value.inner.counts.sum() if value.inner.counted else -1
    return value.pairs.shape, value.pairs[-1].sum(), total, value.limit


def value_of(pairs):
    return Outer(
        np.ones((pairs, 12, 12)), -2.5, Inner(np.arange(4), True), -7, np.array([1.0, 2.0, 3.0, 4.0])
    )


@pytest.mark.parametrize("pairs", [1, 5])
def test_a_kernel_reads_and_writes_what_was_packed(pairs):
    value = value_of(pairs)
    assert read_and_write(pack(value)) == ((pairs, 12, 12), 144.0, 6, -7)
    np.testing.assert_array_equal(value.force, [1.0, -2.5, 3.0, 4.0])


def test_the_hints_of_a_type_are_read_once(monkeypatch):
    class Fresh(NamedTuple):
        force: Annotated[Array, "4"]

    read = []
    monkeypatch.setattr(
        packed, "get_type_hints", lambda kind, **how: read.append(kind) or get_type_hints(kind, **how)
    )
    for _ in range(3):
        pack(Fresh(np.zeros(4)))
    assert read == [Fresh]


@pytest.mark.parametrize(
    "force",
    [
        np.zeros(5),
        np.zeros((1, 4)),
        np.zeros(4, np.float32),
        np.zeros(8)[::2],
        np.broadcast_to(0.0, 4),
        [0.0] * 4,
    ],
    ids=["size", "axes", "type", "strides", "read-only", "list"],
)
def test_what_is_not_as_the_annotation_says_is_refused_by_name(force):
    with pytest.raises(TypeError, match=r"Outer.force must be a writeable C-contiguous array of float64"):
        pack(value_of(1)._replace(force=force))
