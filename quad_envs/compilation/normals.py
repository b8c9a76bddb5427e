"""Standard normal numbers that follow from a key and a place, four at a time in vector instructions.

Philox4x32-10 (Salmon et al. 2011) makes four random words of a counter and a key, and Box and Muller's
formula (1958) two normal numbers of two words. Nothing is kept from number to number: a flight draws what it
needs when it needs it, on any thread.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..plant import Array
from .decorators import inline_lane_kernel, lane_kernel
from .intrinsics import bits_of, number_of

PER_BLOCK = 4  # numbers of a counter
_TOGETHER = 16  # a multiple of which is drawn: four counters side by side
Word = np.uint64  # of which the lower 32 bits are used
Words = tuple[Word, Word, Word, Word]

_0, _2, _3, _4, _5 = (Word(k) for k in (0, 2, 3, 4, 5))
_HALF, _LOW = Word(32), Word(2**32 - 1)
_FACTOR_0, _FACTOR_1 = Word(0xD2511F53), Word(0xCD9E8D57)
_WEYL_0, _WEYL_1 = Word(0x9E3779B9), Word(0xBB67AE85)  # by which the key goes on from round to round
# A double has a sign, 11 bits of its exponent + 1023, and 52 of its mantissa.
_MANTISSA_BITS, _MANTISSA = Word(52), Word(2**52 - 1)
_BITS_OF_1, _BITS_OF_2_52 = Word(1023 << 52), Word((1023 + 52) << 52)
_LOG_2 = math.log(2.0)
# Coefficients of the series of sine and cosine.
_S3, _S5, _S7, _S9, _S11, _S13, _S15 = ((-1.0) ** (k // 2) / math.factorial(k) for k in range(3, 17, 2))
_C2, _C4, _C6, _C8, _C10, _C12, _C14, _C16 = ((-1.0) ** (k // 2) / math.factorial(k) for k in range(2, 18, 2))


def drawn_size(count: int) -> int:
    """Length of an array in which `draw` writes at least so many numbers."""
    return -(-count // _TOGETHER) * _TOGETHER


def key_of(uniform: float | NDArray[np.float64]) -> NDArray[np.int64]:
    """Keys that follow from uniform numbers in [0, 1)."""
    return np.asarray(np.multiply(uniform, 2.0**53)).astype(np.int64)


@inline_lane_kernel
def _round(c: Words, k_0: Word, k_1: Word) -> Words:
    """Two products of words, whose halves change places and are mixed with the key."""
    first, second = _FACTOR_0 * c[0], _FACTOR_1 * c[2]
    return (second >> _HALF) ^ c[1] ^ k_0, second & _LOW, (first >> _HALF) ^ c[3] ^ k_1, first & _LOW


@inline_lane_kernel
def _five_rounds(c: Words, k_0: Word, k_1: Word) -> Words:
    c = _round(c, k_0 & _LOW, k_1 & _LOW)
    c = _round(c, (k_0 + _WEYL_0) & _LOW, (k_1 + _WEYL_1) & _LOW)
    c = _round(c, (k_0 + _2 * _WEYL_0) & _LOW, (k_1 + _2 * _WEYL_1) & _LOW)
    c = _round(c, (k_0 + _3 * _WEYL_0) & _LOW, (k_1 + _3 * _WEYL_1) & _LOW)
    return _round(c, (k_0 + _4 * _WEYL_0) & _LOW, (k_1 + _4 * _WEYL_1) & _LOW)


@inline_lane_kernel
def philox(c: Words, k_0: Word, k_1: Word) -> Words:
    """Four random words of a counter of four words and a key of two."""
    return _five_rounds(_five_rounds(c, k_0, k_1), k_0 + _5 * _WEYL_0, k_1 + _5 * _WEYL_1)


@inline_lane_kernel
def _as_number(word: Word) -> float:
    """A word below 2^52 as a double: 2^52 + word has it for its mantissa."""
    return float(number_of(word | _BITS_OF_2_52)) - 2.0**52


@inline_lane_kernel
def log(x: float) -> float:
    """Natural logarithm of x > 0 without branches, to 4e-11: x = 2^e m, ln m = 2 artanh of s below."""
    bits = bits_of(x)
    e, m = _as_number(bits >> _MANTISSA_BITS) - 1023.0, number_of((bits & _MANTISSA) | _BITS_OF_1)
    above = m > math.sqrt(2.0)
    m, e = 0.5 * m if above else m, e + 1.0 if above else e
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    series = 2.0 + z * (2.0 / 3.0 + z * (2.0 / 5.0 + z * (2.0 / 7.0 + z * (2.0 / 9.0 + z * (2.0 / 11.0)))))
    return float(e * _LOG_2 + s * series)


@inline_lane_kernel
def sincos_of_double(a: float) -> tuple[float, float]:
    """Sine and cosine of 2 a for |a| <= pi / 2, by series to 1e-11."""
    z = a * a
    sine = a + a * z * (_S3 + z * (_S5 + z * (_S7 + z * (_S9 + z * (_S11 + z * (_S13 + z * _S15))))))
    high = _C8 + z * (_C10 + z * (_C12 + z * (_C14 + z * _C16)))
    cosine = 1.0 + z * (_C2 + z * (_C4 + z * (_C6 + z * high)))
    return 2.0 * sine * cosine, 1.0 - 2.0 * sine * sine


@inline_lane_kernel
def _pair(first: Word, second: Word) -> tuple[float, float]:
    """Two independent standard normal numbers of two words."""
    u = _as_number(first) + 0.5  # (0, 1) 2^32
    radius = math.sqrt(2.0 * 32.0 * _LOG_2 - 2.0 * log(u))
    sine, cosine = sincos_of_double(_as_number(second) * (math.pi * 2.0**-32) - 0.5 * math.pi)
    return radius * cosine, radius * sine


@lane_kernel
def draw(key: int, step: int, what: int, out: Array) -> None:
    """Standard normal numbers, independent from key to key, step to step and `what` to `what`.

    Args:
        key: Of an episode, in [0, 2^53).
        step: Control step.
        what: What they are for, a small number.
        out: Result; its length is one of `drawn_size`.
    """
    k_0, k_1 = Word(key) & _LOW, Word(key) >> _HALF
    quarter = out.size // PER_BLOCK
    for i in range(quarter):
        words = philox((Word(i), Word(step), Word(what), _0), k_0, k_1)
        out[i], out[quarter + i] = _pair(words[0], words[1])
        out[2 * quarter + i], out[3 * quarter + i] = _pair(words[2], words[3])
