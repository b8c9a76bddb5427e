"""Normal numbers that follow from a key: against published words, readable equations and statistics."""

import numpy as np
import pytest
from drawn import normal_numbers
from scipy import stats

from quad_envs.compilation.decorators import kernel
from quad_envs.compilation.normals import draw, drawn_size, key_of, log, philox, sincos_of_double


@kernel
def _philox(c, k):
    c[0], c[1], c[2], c[3] = philox((c[0], c[1], c[2], c[3]), k[0], k[1])


@kernel
def _log(x):
    for i in range(x.size):
        x[i] = log(x[i])


@kernel
def _sincos(x, out):
    for i in range(x.size):
        out[0, i], out[1, i] = sincos_of_double(x[i])


@pytest.mark.parametrize(
    ("counter", "key", "words"),
    [  # kat_vectors of Random123
        ([0] * 4, [0] * 2, "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        ([0xFFFFFFFF] * 4, [0xFFFFFFFF] * 2, "408f276d 41c83b0e a20bc7c6 6d5451fd"),
        (
            [0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344],
            [0xA4093822, 0x299F31D0],
            "d16cfe09 94fdcceb 5001e420 24126ea1",
        ),
    ],
)
def test_philox_gives_the_words_that_its_authors_publish(counter, key, words):
    found = np.array(counter, dtype=np.uint64)
    _philox(found, np.array(key, dtype=np.uint64))
    assert " ".join(f"{int(word):08x}" for word in found) == words


def test_numbers_are_those_of_the_readable_twin():
    for key, step, what, size in ((0, 0, 0, 16), (2**53 - 1, 20_000, 2, 64), (123456789, 7, 1, 80)):
        found = np.empty(size)
        draw(key, step, what, found)
        np.testing.assert_allclose(found, normal_numbers(key, step, what, size), rtol=1e-9, atol=1e-9)


def test_logarithm_and_sine_are_as_exact_as_they_say():
    x = np.concatenate([np.geomspace(0.5, 2.0**32, 10_001), np.linspace(0.5, 3.0, 10_001)])
    found, half = x.copy(), np.linspace(-np.pi / 2, np.pi / 2, 10_001)
    _log(found)
    np.testing.assert_allclose(found, np.log(x), rtol=0.0, atol=4e-11)
    out = np.empty((2, half.size))
    _sincos(half, out)
    np.testing.assert_allclose(out, [np.sin(2.0 * half), np.cos(2.0 * half)], atol=1e-10)


def test_numbers_are_standard_normal_and_independent():
    numbers = np.empty((20_000, 16))
    for step, row in enumerate(numbers):
        draw(5, step, 1, row)
    assert stats.kstest(numbers.ravel(), "norm").pvalue > 0.01
    apart = np.corrcoef(numbers.T) - np.eye(16)
    assert np.abs(apart).max() < 4.0 / np.sqrt(len(numbers))  # of 120 pairs
    following = np.mean(numbers[1:] * numbers[:-1], axis=0)
    assert np.abs(following).max() < 4.0 / np.sqrt(len(numbers))


def test_keys_are_whole_numbers_below_2_to_53():
    keys = key_of(np.array([0.0, 0.5, np.nextafter(1.0, 0.0)]))
    assert keys.tolist() == [0, 2**52, 2**53 - 1] and keys.dtype == np.int64


def test_lengths_are_whole_vectors():
    assert [drawn_size(count) for count in (1, 16, 17, 60)] == [16, 16, 32, 64]
