"""A random generator that gives equal bits on every machine and Python version.

The k-th number of a seed is a hash of (seed, k): SplitMix64 (Steele, Lea and Flood, "Fast
splittable pseudorandom number generators", OOPSLA 2014) on Python integers. Floats are computed
with +, -, * and / only, which IEEE 754 defines to the last bit: `exp` replaces the C library's, and
`sum`, whose rounding changed in Python 3.12, is avoided.
"""

from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")

MASK = 2**64 - 1
GOLDEN = 0x9E3779B97F4A7C15


def exp(x: float) -> float:
    """Returns e^x for |x| < 20, to 1e-12: a Taylor series at x / 1024, squared ten times."""
    x, term, total = x / 1024, 1.0, 1.0
    for k in range(1, 7):
        term = term * x / k
        total += term
    for _ in range(10):
        total *= total
    return total


def mixed(value: int) -> int:
    """Returns a 64-bit hash of a 64-bit integer."""
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) & MASK
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) & MASK
    return value ^ (value >> 31)


class PortableGenerator:
    """The generator of a seed, any integer."""

    def __init__(self, seed: int):
        self._key = mixed((seed * GOLDEN + 1) & MASK)
        self._count = 0

    def bits(self) -> int:
        """Returns an integer of 64 random bits."""
        self._count += 1
        return mixed((self._key + self._count * GOLDEN) & MASK)

    def below(self, n: int) -> int:
        """Returns an integer from 0 to n - 1."""
        return self.bits() * n >> 64

    def between(self, low: int, high: int, step: int = 1) -> int:
        """Returns a multiple of `step` from low to high, both included."""
        low, high = low // step, high // step
        return (low + self.below(high - low + 1)) * step

    def uniform(self, low: float = 0.0, high: float = 1.0) -> float:
        return low + (high - low) * ((self.bits() >> 11) / 2**53)

    def chance(self, probability: float) -> bool:
        """Returns True with this probability."""
        return self.uniform() < probability

    def normal(self, mean: float = 0.0, std: float = 1.0) -> float:
        """Returns a nearly normal number: the sum of twelve 16-bit uniforms has variance 1."""
        total = 0
        for _ in range(3):
            word = self.bits()
            total += (word & 0xFFFF) + (word >> 16 & 0xFFFF) + (word >> 32 & 0xFFFF) + (word >> 48)
        return mean + std * (total / 65_536 - 6)

    def lognormal(self, median: float, sigma: float) -> float:
        """Returns median * e^(sigma z), where z is nearly normal."""
        return median * exp(sigma * self.normal())

    def shuffled(self, items: Iterable[T]) -> Iterator[T]:
        """Yields items in a random order, each drawn when it is taken."""
        rest = [*items]
        for k in range(len(rest)):
            at = k + self.below(len(rest) - k)
            rest[k], rest[at] = rest[at], rest[k]
            yield rest[k]

    def pick(self, weights: Iterable[float]) -> int:
        """Returns the index of one of `weights`, with probability proportional to it."""
        total, sums = 0.0, []
        for weight in weights:
            total += weight
            sums.append(total)
        point = self.uniform() * total
        return next((index for index, end in enumerate(sums) if point < end), len(sums) - 1)
