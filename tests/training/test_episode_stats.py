"""Episode statistics, compared with a slow count."""

from types import SimpleNamespace

import pytest
import torch

from megastep.agents.training.episode_stats import EpisodeStats, lane_groups


def slow_episodes(reward, reset, done, partial):
    """Returns (return, length) of each finished episode. Updates `partial`, the return and length
    so far of each lane's current episode.
    """
    finished = []
    for t in range(len(reward)):
        for lane in range(reward.shape[1]):
            total, length = partial[lane]
            total, length = total + float(reward[t, lane]), length + (not reset[t, lane])
            if done[t, lane]:
                finished.append((total, length))
                total, length = 0.0, 0
            partial[lane] = total, length
    return finished


def test_two_steps_and_an_end_are_an_episode_of_length_two():
    episodes = EpisodeStats(1, "cpu")
    reset, done = (
        torch.tensor([[False], [False], [True], [False]]),
        torch.tensor([[False], [True], [False], [False]]),
    )
    episodes.add(torch.tensor([[1.0], [2.0], [0.0], [5.0]]), reset, done)
    assert episodes.pop() == {
        "episode/count": 1,
        "episode/return": 3.0,
        "episode/length": 2.0,
        "episode/return_std": 0.0,
    }
    assert episodes.returns.tolist() == [5.0] and episodes.lengths.tolist() == [1.0]
    assert episodes.pop() == {"episode/count": 0}


def test_episodes_across_rollouts_match_slow_count():
    torch.manual_seed(1)
    n_lanes, episodes, finished = 5, EpisodeStats(5, "cpu"), []
    partial = {lane: (0.0, 0) for lane in range(n_lanes)}
    ended = torch.zeros(n_lanes, dtype=torch.bool)
    for _ in range(6):
        done = torch.rand(7, n_lanes) < 0.2
        reset = torch.cat([ended[None], done[:-1]])
        done &= ~reset  # an episode cannot end on its first observation
        reset = torch.cat([ended[None], done[:-1]])
        ended = done[-1]
        reward = torch.rand(7, n_lanes) * ~reset
        episodes.add(reward, reset, done)
        finished += slow_episodes(reward, reset, done, partial)
    stats = episodes.pop()
    returns = torch.tensor([total for total, _ in finished])
    assert stats["episode/count"] == len(finished) > 20
    assert stats["episode/return"] == pytest.approx(float(returns.mean()), rel=1e-6)
    assert stats["episode/return_std"] == pytest.approx(float(returns.std(correction=0)), rel=1e-5)
    assert stats["episode/length"] == pytest.approx(
        sum(length for _, length in finished) / len(finished)
    )
    assert episodes.returns.tolist() == pytest.approx(
        [partial[lane][0] for lane in range(n_lanes)], rel=1e-6
    )


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e30])
def test_nonfinite_reward_counts_as_zero(bad):
    episodes, none = EpisodeStats(2, "cpu"), torch.zeros(3, 2, dtype=torch.bool)
    episodes.add(torch.tensor([[1.0, 1.0], [bad, 2.0], [3.0, 3.0]]), none, none)
    done = torch.tensor([[True, True]])
    episodes.add(torch.full((1, 2), 4.0), none[:1], done)
    stats = episodes.pop()
    assert (stats["episode/count"], stats["episode/return"]) == (2, (8 + 10) / 2)
    assert not episodes.returns.any() and stats["episode/length"] == 4


def test_metrics_are_read_at_episode_ends_and_split_by_role():
    """Two environments of three agents, one leader and two followers."""
    env = SimpleNamespace(n_envs=2, device="cpu", roles=("leader", "follower", "follower"))
    episodes = EpisodeStats(6, "cpu", ["laps", "falls"], lane_groups(env))
    done = torch.zeros(2, 6, dtype=torch.bool)
    done[0, 0] = done[1, 3] = done[1, 4] = done[1, 5] = True
    reward = torch.tensor([[1.0, 0, 0, 2, 3, 4], [0, 0, 0, 5, 6, 7]])
    laps = torch.where(done, 10.0 * reward, torch.nan)  # metrics are read only on the last step
    metrics = dict(laps=laps, falls=torch.ones(2, 6))
    episodes.add(reward, torch.zeros_like(done), done, metrics=metrics)
    stats = episodes.pop()
    assert stats == {
        "episode/count": 4,
        "episode/return": (1 + 7 + 9 + 11) / 4,
        "episode/length": 7 / 4,
        "episode/laps": 10 * (1 + 5 + 6 + 7) / 4,
        "episode/falls": 1,
        "episode/return_std": pytest.approx(14**0.5),
        "episode/return/leader": (1 + 7) / 2,
        "episode/length/leader": 3 / 2,
        "episode/laps/leader": 30,
        "episode/falls/leader": 1,
        "episode/return/follower": (9 + 11) / 2,
        "episode/length/follower": 2,
        "episode/laps/follower": 65,
        "episode/falls/follower": 1,
    }
    assert list(stats)[:6] == [
        f"episode/{name}" for name in ("count", "return", "length", "laps", "falls", "return_std")
    ]
    done[:] = False
    done[1, 0] = True
    episodes.add(reward, torch.zeros_like(done), done, metrics=metrics)
    stats = episodes.pop()
    assert stats["episode/return/leader"] == 1 and "episode/return/follower" not in stats


def test_lane_groups_by_role_and_matchup():
    past = torch.tensor([False, False, True, True])
    env = SimpleNamespace(n_envs=2, device="cpu", roles=("left", "right"), matchups={"past": past})
    groups = lane_groups(env, torch.tensor([True, True, False, True]))
    assert {name: lanes.tolist() for name, lanes in groups.items()} == {
        "left": [True, False, False],
        "right": [False, True, True],
        "past": [False, False, True],
    }
    assert lane_groups(SimpleNamespace(roles=None)) == {}


def test_only_episodes_of_learning_lanes_count():
    episodes = EpisodeStats(2, "cpu", ["laps"])
    done, none = torch.ones(1, 2, dtype=torch.bool), torch.zeros(1, 2, dtype=torch.bool)
    learns = torch.tensor([[True, False]])
    for reward in (1.0, 5.0):
        rewards = torch.tensor([[reward, torch.nan]])
        episodes.add(rewards, none, done, learns, dict(laps=rewards))
    assert episodes.pop() == {
        "episode/count": 2,
        "episode/return": 3,
        "episode/length": 1,
        "episode/laps": 3,
        "episode/return_std": 2,
    }
    assert not episodes.returns.any(), "the lane that does not learn is cleared too"


def test_sums_are_restored_only_for_the_same_metrics():
    done, none = torch.ones(1, 2, dtype=torch.bool), torch.zeros(1, 2, dtype=torch.bool)
    first, same, other = (
        EpisodeStats(2, "cpu", ["a"]),
        EpisodeStats(2, "cpu", ["a"]),
        EpisodeStats(2, "cpu"),
    )
    first.add(torch.ones(1, 2), none, done, metrics=dict(a=torch.ones(1, 2)))
    for episodes in (same, other):
        episodes.load_state_dict(first.state_dict())
    assert same.pop() == first.pop() and other.pop() == {"episode/count": 0}
