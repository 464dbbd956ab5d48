"""Who copies whom, and with which settings."""

import math
import random
from collections import Counter

import pytest

from megastep.agents.generator import seed_of
from megastep.agents.population.decisions import decide, first, order
from megastep.agents.population.variation import Variation

VARY = {
    "learner.lr": Variation(min=3e-4, max=3e-3, log=True),
    "learner.entropy_coef": Variation(choices=(0.003, 0.01, 0.03)),
}
SETTINGS = [{"learner.lr": 1e-3 * (n + 1) / 4, "learner.entropy_coef": 0.01} for n in range(8)]
SCORES = [1.0, 7.0, 3.0, 8.0, 2.0, 5.0, 6.0, 4.0]


def test_truncation_copies_the_first_quarter_into_the_last():
    for generation in range(1, 40):
        made = decide(1, generation, SCORES, SETTINGS, VARY)
        assert [n for n, one in enumerate(made) if one.source != n] == [0, 4]
        for n in (0, 4):
            source = made[n].source
            assert source in (1, 3)
            ratio = made[n].settings["learner.lr"] / SETTINGS[source]["learner.lr"]
            assert ratio == pytest.approx(0.8) or ratio == pytest.approx(1.2)
            assert made[n].settings["learner.entropy_coef"] in (0.003, 0.03)
        assert all(made[n] == (n, SETTINGS[n]) for n in (1, 2, 3, 5, 6, 7))
    sources = Counter(decide(1, g, SCORES, SETTINGS, VARY)[0].source for g in range(1, 200))
    assert min(sources[1], sources[3]) > 70


def test_members_are_copied_before_they_copy():
    for generation in range(1, 40):
        made = decide(2, generation, SCORES, SETTINGS, VARY)
        weights = [*SCORES]
        for n in order(made, SCORES):
            weights[n] = weights[made[n].source]
        assert weights == [SCORES[one.source] for one in made]


def test_a_member_that_diverged_copies_and_one_without_a_score_is_left_alone():
    scores = [None, 1.0, -math.inf, 2.0, 2.0, -math.inf]
    for generation in range(1, 30):
        made = decide(1, generation, scores, SETTINGS[:6], VARY)
        assert made[0] == (0, SETTINGS[0])
        assert {made[2].source, made[5].source} <= {1, 3, 4}
        assert not {one.source for n, one in enumerate(made) if n not in (2, 5)} & {2, 5}
    nobody = decide(1, 1, [None] * 3, SETTINGS[:3], VARY)
    assert [one.source for one in nobody] == [0, 1, 2]


def test_draws_depend_on_seed_generation_and_member_alone():
    assert first(1, 3, VARY) == first(1, 3, VARY) != first(2, 3, VARY)
    assert decide(1, 5, SCORES, SETTINGS, VARY) == decide(1, 5, SCORES, SETTINGS, VARY)
    drawn = [math.log10(first(1, n, VARY)["learner.lr"]) for n in range(1000)]
    assert sum(drawn) / 1000 == pytest.approx((math.log10(3e-4) + math.log10(3e-3)) / 2, abs=0.03)
    seeds = [seed_of("member", n, 7) for n in range(1000)]
    assert seeds[0] == 7 and len({*seeds}) == 1000


def test_a_step_stays_within_the_bounds():
    generator = random.Random(1)
    near = {VARY["learner.lr"].near(2.9e-3, generator) for _ in range(20)}
    assert near == {2.9e-3 * 0.8, 3e-3}
    assert {VARY["learner.entropy_coef"].near(0.03, generator) for _ in range(20)} == {0.01, 0.03}
