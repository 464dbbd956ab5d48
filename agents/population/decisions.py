"""Who copies whom (Jaderberg et al. 2017), from seed, generation and scores alone."""

import math
import random
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from megastep.agents.generator import stream_seed
from megastep.agents.population.variation import Variation

#: Fraction of members at the end of the ranking that copy one at its top.
TRUNCATED = 0.25
Settings = dict[str, float]


class Decision(NamedTuple):
    """What a member does at a generation."""

    source: int  # the member that it copies; itself if none
    settings: Settings  # its settings from then on, by key


def first(seed: int, member: int, vary: Mapping[str, Variation]) -> Settings:
    """Returns the settings with which a member begins."""
    generator = _generator(seed, 0, member)
    return {key: one.draw(generator) for key, one in vary.items()}


def decide(
    seed: int,
    generation: int,
    scores: Sequence[float | None],
    settings: Sequence[Settings],
    vary: Mapping[str, Variation],
) -> list[Decision]:
    """Returns the decision of each member: the last quarter of the ranking copies members drawn
    from the first, with settings near theirs.

    Args:
        generation: 1 for the first.
        scores: of each member; higher is better. None: unknown, so it neither copies nor is copied.
            Minus infinity: it has diverged, so it copies another, and is never copied.
        settings: of each member, which `vary` says may be others.
    """
    known = [n for n, score in enumerate(scores) if score is not None]
    ranked = sorted(known, key=lambda n: (-_score(scores[n]), n))
    sound = [n for n in ranked if _score(scores[n]) > -math.inf]
    n_cut = max(1, int(TRUNCATED * len(ranked)))
    copying = {*ranked[max(n_cut, len(ranked) - n_cut) :], *ranked[len(sound) :]}
    decisions = []
    for member, own in enumerate(settings):
        generator, source = _generator(seed, generation, member), member
        if sound and member in copying:
            drawn = generator.choice(sound[:n_cut])
            source = drawn if _score(scores[drawn]) > _score(scores[member]) else member
        if source != member:
            own = {key: one.near(settings[source][key], generator) for key, one in vary.items()}
        decisions.append(Decision(source, dict(own)))
    return decisions


def order(decisions: Sequence[Decision], scores: Sequence[float | None]) -> list[int]:
    """Returns the members that copy, each copied before it copies: the worst first."""
    copying = [n for n, one in enumerate(decisions) if one.source != n]
    return sorted(copying, key=lambda n: (_score(scores[n]), n))


def _score(score: float | None) -> float:
    return -math.inf if score is None else score


def _generator(seed: int, generation: int, member: int) -> random.Random:
    return random.Random(stream_seed(seed, f"population {generation} {member}"))
