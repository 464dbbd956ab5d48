"""What may differ between the members of a population: ranges of numbers. Knows no PyTorch."""

import math
import random

from megastep.settings import frozen

#: Factors by which a number is explored (Jaderberg et al. 2017).
FACTORS = 0.8, 1.2


@frozen
class Variation:
    """The numbers that a setting may have: a range, or a few choices.

    Args:
        min, max: bounds of a range.
        log: numbers are drawn evenly by their logarithm.
        choices: the numbers, in place of a range.
    """

    min: float | None = None
    max: float | None = None
    log: bool = False
    choices: tuple[float, ...] = ()

    def problem(self) -> str | None:
        """Returns what is wrong, as a clause; None if nothing is."""
        if self.choices:
            is_range = self.min is not None or self.max is not None or self.log
            return "has choices and a range; give one of them" if is_range else None
        if self.min is None or self.max is None:
            return "needs min and max, or choices: {min: 3e-4, max: 3e-3, log: true}"
        if not self.min < self.max:
            return f"has min={self.min:g}, which is not below max={self.max:g}; swap them"
        if self.log and self.min <= 0:
            return f"has log=true and min={self.min:g}; a logarithm needs a min above 0"
        return None

    def ends(self) -> tuple[float, ...]:
        """Returns the numbers that bound all others, or the choices."""
        return self.choices or tuple(x for x in (self.min, self.max) if x is not None)

    def draw(self, generator: random.Random) -> float:
        """Returns one of the numbers at random."""
        if self.choices:
            return float(generator.choice(self.choices))
        least, most = self.ends()
        if self.log:
            number = math.exp(generator.uniform(math.log(least), math.log(most)))
            return min(max(number, least), most)
        return generator.uniform(least, most)

    def near(self, number: float, generator: random.Random) -> float:
        """Returns one of `FACTORS` times a number, within the bounds; of choices a neighbour."""
        if self.choices:
            place = self.choices.index(number) + generator.choice((-1, 1))
            return float(self.choices[min(max(place, 0), len(self.choices) - 1)])
        least, most = self.ends()
        return min(max(number * generator.choice(FACTORS), least), most)
