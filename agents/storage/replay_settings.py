"""Settings of the replay buffer."""

import dataclasses
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field

from megastep.settings import frozen

Exponent = Annotated[float, Field(ge=0, le=10)]


@frozen
class ReplaySettings:
    """Settings of learners that have a replay buffer.

    Args:
        capacity: observations in the buffer, all lanes together. Rounded down to whole rollouts.
        images: storage of images with values from 0 to 1. fp16 stores them as they are; uint8 in
            steps of 1/255, in half the memory, and clips values outside 0 to 1.
        burn_in: steps at the start of a sequence that only warm up the hidden state. A sequence
            has `n_steps` more, so that every collected step is learned from in exactly one.
        ratio: samples replayed per sample collected.
        alpha: exponent of priorities; 0 draws uniformly (Schaul et al. 2016).
        beta: exponent of importance weights; 1 corrects fully for the priorities.
        start: samples to collect before the first is replayed.
    """

    capacity: Annotated[int, Field(ge=1, le=10**12)] = 1_000_000
    images: Literal["fp16", "uint8"] = "fp16"
    burn_in: Annotated[int, Field(ge=0, le=65_536)] = 0
    ratio: Annotated[float, Field(gt=0, le=1000)] = 1.0
    alpha: Exponent = 0.0
    beta: Exponent = 0.6
    start: Annotated[int, Field(ge=0, le=10**12)] = 0

    def rollouts_per_sequence(self, n_steps: int) -> int:
        """Returns how many rollouts a sequence and the observation after it overlap."""
        return (n_steps + self.burn_in) // n_steps + 1

    def n_rollouts(self, n_steps: int, n_lanes: int) -> int:
        """Returns how many rollouts (n_steps, n_lanes) fit into the capacity.

        Raises:
            ValueError: if not even one sequence per lane fits.
        """
        needed = self.rollouts_per_sequence(n_steps) * n_steps * n_lanes
        if self.capacity < needed:
            raise ValueError(
                f"replay.capacity={self.capacity:,} is too small for a sequence of "
                f"{n_steps + self.burn_in} steps of each of {n_lanes:,} lanes, stored "
                f"{n_steps} steps at a time: use at least {needed:,}, or fewer environments"
            )
        return self.capacity // (n_steps * n_lanes)


def defaults_from(settings: ReplaySettings) -> BeforeValidator:
    """Returns a validator for annotations: a dict of some settings takes the others from `settings`
    instead of from the class.
    """

    def complete(value) -> object:
        return dataclasses.asdict(settings) | value if isinstance(value, dict) else value

    return BeforeValidator(complete)
