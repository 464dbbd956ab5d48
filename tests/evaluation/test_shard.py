"""Ranks share an evaluation: together they play what one process plays."""

import contextlib
from collections import Counter

import pytest
import torch

from megastep.agents.distributed import process_group
from megastep.agents.evaluation.eval_env import Shard
from megastep.arrdict import arrdict


@pytest.mark.parametrize("n_envs, n_homes, n_ranks", [(9, 1, 2), (12, 6, 4), (10, 7, 3), (8, 8, 3)])
def test_every_home_is_played_as_often_as_by_one_process(n_envs, n_homes, n_ranks):
    shards = [Shard(n_envs, n_homes, rank, n_ranks) for rank in range(n_ranks)]
    # a rank's environment i plays in the i-th of its homes, round and round
    played = [
        (env, one.homes[i % len(one.homes)]) for one in shards for i, env in enumerate(one.envs)
    ]
    assert sorted(played) == [(env, env % n_homes) for env in range(n_envs)]
    assert all(len(one.homes) <= len(one.envs) for one in shards)


def test_values_are_in_the_order_of_environments(monkeypatch):
    n_envs, n_homes, n_agents, n_ranks = 7, 3, 2, 2
    shards, parts = [Shard(n_envs, n_homes, rank, n_ranks) for rank in range(n_ranks)], []
    monkeypatch.setattr(process_group, "gather_objects", parts.append)
    for one in shards:
        local = torch.arange(len(one.envs)).repeat_interleave(n_agents)
        lanes = torch.tensor([*one.envs]).repeat_interleave(n_agents) * n_agents
        lanes += torch.arange(n_agents).repeat(len(one.envs))
        values = arrdict(envs=local, homes=(local % len(one.homes)).int(), lanes=lanes)
        values["metrics"] = arrdict(twice=2.0 * lanes)
        with contextlib.suppress(TypeError):  # of no parts
            one.with_others(values)
    monkeypatch.setattr(process_group, "gather_objects", lambda values: parts)
    whole = shards[1].with_others(values)
    assert whole.lanes.tolist() == [*range(n_envs * n_agents)]
    assert whole.metrics.twice.tolist() == [2.0 * lane for lane in range(n_envs * n_agents)]
    assert whole.envs.tolist() == [lane // n_agents for lane in range(n_envs * n_agents)]
    assert Counter(whole.homes.tolist()) == Counter(
        env % n_homes for env in range(n_envs) for _ in range(n_agents)
    )
    assert whole.homes.tolist() == [env % n_homes for env in whole.envs.tolist()]
    assert whole.homes.dtype == torch.int32


def test_one_process_plays_all():
    alone, values = Shard(9, 4), arrdict(homes=torch.zeros(9))
    assert [*alone.envs] == [*range(9)] and alone.homes == [0, 1, 2, 3]
    assert alone.with_others(values) is values and Shard(9, 0).homes == []
