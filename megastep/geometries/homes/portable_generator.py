"""Random numbers that are the same on every machine.

The k-th number of a seed is a hash of (seed, k): SplitMix64 (Steele, Lea and Flood, "Fast
splittable pseudorandom number generators", OOPSLA 2014), on Python integers. What is made of them
uses only +, -, *, / on Python floats, each of which IEEE 754 rounds in one way; exponentials come
from `exp` below and not from the C library, whose last bit differs between systems, and nothing
calls `sum` on floats, which Python 3.12 taught to round otherwise.
"""

from collections.abc import Iterable

MASK = 2**64 - 1
GOLDEN = 0x9E3779B97F4A7C15


def exp(x: float) -> float:
    """e^x for |x| < 20 from multiplications alone: a Taylor series at x/1024, squared ten times;
    good to 1e-12.
    """
    x, term, total = x / 1024, 1.0, 1.0
    for k in range(1, 7):
        term = term * x / k
        total += term
    for _ in range(10):
        total *= total
    return total


def mixed(value: int) -> int:
    """A 64-bit hash of a 64-bit integer."""
    value = ((value ^ (value >> 30)) * 0xBF58476D1CE4E5B9) & MASK
    value = ((value ^ (value >> 27)) * 0x94D049BB133111EB) & MASK
    return value ^ (value >> 31)


class PortableGenerator:
    """The random numbers of one seed, any integer."""

    def __init__(self, seed: int):
        self._key = mixed((seed * GOLDEN + 1) & MASK)
        self._count = 0

    def bits(self) -> int:
        """An integer of 64 random bits."""
        self._count += 1
        return mixed((self._key + self._count * GOLDEN) & MASK)

    def below(self, n: int) -> int:
        """An integer in 0..n-1."""
        return self.bits() * n >> 64

    def between(self, low: int, high: int) -> int:
        """An integer in low..high, both included."""
        return low + self.below(high - low + 1)

    def uniform(self, low: float = 0.0, high: float = 1.0) -> float:
        """A float in low..high."""
        return low + (high - low) * ((self.bits() >> 11) / 2**53)

    def chance(self, probability: float) -> bool:
        """True with this probability."""
        return self.uniform() < probability

    def normal(self, mean: float = 0.0, std: float = 1.0) -> float:
        """Nearly normal: the sum of twelve 16-bit uniforms, whose variance is one."""
        total = 0
        for _ in range(3):
            word = self.bits()
            total += (word & 0xFFFF) + (word >> 16 & 0xFFFF) + (word >> 32 & 0xFFFF) + (word >> 48)
        return mean + std * (total / 65_536 - 6)

    def lognormal(self, median: float, sigma: float) -> float:
        """median * e^(sigma z), z nearly normal."""
        return median * exp(sigma * self.normal())

    def pick(self, weights: Iterable[float]) -> int:
        """The index of one of `weights`, with probability in proportion to it."""
        total, sums = 0.0, []
        for weight in weights:
            total += weight
            sums.append(total)
        at = self.uniform() * total
        return next((index for index, below in enumerate(sums) if at < below), len(sums) - 1)
