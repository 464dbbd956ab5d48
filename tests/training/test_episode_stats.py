"""Episode statistics, compared with a slow count."""

import itertools
import math
from types import SimpleNamespace

import pytest
import torch

from megastep.agents.algorithms.cuda_graph import CudaGraphUpdate
from megastep.agents.training import episode_stats
from megastep.agents.training.episode_stats import N_INTERVALS, EpisodeStats, lane_groups


def popped(episodes):
    """Returns the statistics of all episodes that have ended, as if no other were running."""
    episodes.is_whole[:] = False
    stats = episodes.pop()
    episodes.is_whole[:] = True
    return stats


def named(stats, group=""):
    """Returns the statistics of all episodes, or of a group's, as they are logged."""
    return {f"episode/{name}{group}": value for name, value in stats.items()}


@pytest.mark.parametrize("bad", [torch.nan, 1e30])
def test_nonfinite_reward_counts_as_zero(bad):
    episodes, none = EpisodeStats(2, "cpu"), torch.zeros(3, 2, dtype=torch.bool)
    episodes.add(torch.tensor([[1.0, 1.0], [bad, 2.0], [3.0, 3.0]]), none, none)
    done = torch.tensor([[True, True]])
    episodes.add(torch.full((1, 2), 4.0), none[:1], done)
    stats = popped(episodes)
    assert (stats["episode/count"], stats["episode/return"]) == (2, (8 + 10) / 2)
    assert not episodes.totals[0].any() and stats["episode/length"] == 4


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
    stats = popped(episodes)
    names = "count", "window", "return", "length", "laps", "falls"
    every = 4, 4, (1 + 7 + 9 + 11) / 4, 7 / 4, 10 * (1 + 5 + 6 + 7) / 4, 1
    assert stats == {
        **named(dict(zip(names, every), return_std=pytest.approx(14**0.5))),
        **named(dict(zip(names, (2, 2, (1 + 7) / 2, 3 / 2, 30, 1))), "/leader"),
        **named(dict(zip(names, (2, 2, (9 + 11) / 2, 2, 65, 1))), "/follower"),
    }
    names += ("return_std",)
    assert list(stats)[:7] == [f"episode/{name}" for name in names]
    done[:] = False
    done[1, 0] = True
    episodes.add(reward, torch.zeros_like(done), done, metrics=metrics)
    stats = popped(episodes)
    assert stats["episode/count/leader"] == 1 and stats["episode/return/leader"] == (8 + 1) / 3
    assert stats["episode/count/follower"] == 0 and stats["episode/return/follower"] == 10


def test_sources_are_those_of_the_layouts_where_episodes_end():
    """Lane 0 ends an episode in layout 2, a maze, and then one in layout 0; lane 1 in layout 7,
    which does not exist.
    """
    sources = ["homes", "homes", "maze", "all"]
    groups = {"all": torch.tensor([True, True])}
    episodes = EpisodeStats(2, "cpu", ["laps"], groups, sources=sources)
    layouts = torch.tensor([[2, 7], [0, 7]], dtype=torch.int32)
    done = torch.tensor([[True, False], [True, True]])
    reward = torch.tensor([[1.0, 10.0], [5.0, 20.0]])
    metrics = dict(laps=torch.tensor([[2.0, 0], [torch.nan, 8]]))
    episodes.add(reward, torch.zeros_like(done), done, True, metrics, layouts)
    stats = popped(episodes)
    assert (stats["episode/count"], stats["episode/return"]) == (3, (1 + 5 + 30) / 3)
    assert (stats["episode/count/maze"], stats["episode/return/maze"]) == (1, 1)
    assert (stats["episode/laps/maze"], stats["episode/length/maze"]) == (2, 1)
    assert (stats["episode/count/homes"], stats["episode/return/homes"]) == (1, 5)
    assert "episode/laps/homes" not in stats and "episode/return_std/maze" not in stats
    assert stats["episode/count/all"] == 3, "a group of the same name stays the group"
    assert popped(episodes)["episode/return/maze"] == 1, "a window of its own"


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
    expected = {"count": 2, "window": 2, "return": 3, "length": 1, "laps": 3, "return_std": 2}
    assert popped(episodes) == named(expected)
    assert not episodes.totals[0].any(), "the lane that does not learn is cleared too"


def add_episodes(episodes, *returns):
    """Adds episodes of one step, one after the other, in the only lane."""
    for value in returns:
        none = torch.tensor([[False]])
        episodes.add(torch.tensor([[float(value)]]), none, ~none)


def test_means_reach_back_over_100_episodes():
    """A lucky episode that ends alone is one of a hundred in its report's mean."""
    episodes = EpisodeStats(1, "cpu")
    for _ in range(4):
        add_episodes(episodes, *[1.0] * 30)
        popped(episodes)
    add_episodes(episodes, 101.0)
    stats = popped(episodes)
    # without the oldest report 91 would be left
    assert (stats["episode/count"], stats["episode/window"]) == (1, 121)
    assert stats["episode/return"] == pytest.approx(1 + 100 / 121)
    assert stats["episode/return_std"] == pytest.approx(100 / 121 * 120**0.5)
    add_episodes(episodes, *[1.0] * 9)
    assert popped(episodes)["episode/window"] == 100, "the oldest report is dropped"
    add_episodes(episodes, *[2.0] * 250)
    stats = popped(episodes)
    assert (stats["episode/window"], stats["episode/return"]) == (250, 2)


def test_first_episodes_are_left_out_where_they_are_cut():
    """Lane 0's first episode ends in the first rollout, lane 1's in the second."""
    episodes, none = EpisodeStats(2, "cpu", skip_first=True), torch.zeros(3, 2, dtype=torch.bool)
    done = none.clone()
    done[0, 0] = done[2, 0] = True
    episodes.add(torch.ones(3, 2), none, done)
    assert episodes.is_whole.tolist() == [True, False]
    episodes.add(torch.ones(3, 2), none, ~none)
    stats = popped(episodes)
    assert (stats["episode/count"], stats["episode/length"]) == (1 + 3 + 2, (2 + 5) / 6)


@pytest.mark.parametrize("bad", [torch.nan, -1e30])
def test_episode_with_a_nonfinite_metric_is_left_out_of_its_mean(bad):
    """Lanes 0 and 2 are group a, 1 and 3 group b. Of `laps`, lanes 1 and 3 have none."""
    groups = {"a": torch.tensor([True, False] * 2), "b": torch.tensor([False, True] * 2)}
    episodes = EpisodeStats(4, "cpu", ["laps", "hits"], groups)
    none = torch.zeros(1, 4, dtype=torch.bool)
    metrics = dict(laps=torch.tensor([[3.0, bad, 5, bad]]), hits=torch.tensor([[1.0, 2, 3, 4]]))
    episodes.add(torch.ones(1, 4), none, ~none, metrics=metrics)
    stats = popped(episodes)
    assert episodes.infinite == [] if bad != bad else ["laps"], "NaN stands for no such number"
    assert (stats["episode/laps"], stats["episode/hits"], stats["episode/window"]) == (4, 2.5, 4)
    assert stats["episode/laps/a"] == 4 and "episode/laps/b" not in stats
    assert (stats["episode/hits/a"], stats["episode/hits/b"]) == (2, 3)
    metrics["laps"][0, 1] = 10
    episodes.add(torch.ones(1, 4), none, ~none, metrics=metrics)
    stats = popped(episodes)  # the window holds both reports
    assert (stats["episode/laps"], stats["episode/laps/b"]) == ((3 + 5 + 3 + 5 + 10) / 5, 10)
    assert torch.isfinite(episodes.sums).all()


def test_sums_are_restored_only_for_the_same_metrics():
    done, none = torch.ones(1, 2, dtype=torch.bool), torch.zeros(1, 2, dtype=torch.bool)
    first, same, other = (EpisodeStats(2, "cpu", names) for names in (["a"], ["a"], []))
    first.add(torch.ones(1, 2), none, done, metrics=dict(a=torch.ones(1, 2)))
    for episodes in (same, other):
        episodes.load_state_dict(first.state_dict())
    assert popped(same) == popped(first) and popped(other) == {"episode/count": 0}
    add_episodes(rest := EpisodeStats(1, "cpu"), 1.0)
    popped(rest)
    resumed = EpisodeStats(1, "cpu")
    resumed.load_state_dict(rest.state_dict())
    assert popped(resumed) == popped(rest) and resumed.windows == rest.windows
    assert resumed.windows[0][0] == [1, 1, 1, 1]


def test_a_report_is_about_the_episodes_that_began_together():
    """Episode n of lane i lasts 1 + 5 i steps and more, and loses 1 in each: those that end first
    are the best. A slow count says which began in an interval, of which there are too many here.
    """
    torch.manual_seed(0)
    n_lanes, n_steps = 6, 4
    episodes, lasting = EpisodeStats(n_lanes, "cpu"), torch.arange(n_lanes) * 5
    left, began, ended = lasting + 1, [0] * n_lanes, {}
    age, reports, intervals = [0] * n_lanes, [], [0]
    for _ in range(60):
        done = torch.zeros(n_steps, n_lanes, dtype=torch.bool)
        for t in range(n_steps):
            left -= 1
            done[t] = left == 0
            for lane in range(n_lanes):
                age[lane] += 1
                if done[t, lane]:
                    ended.setdefault(began[lane], []).append(age[lane])
                    began[lane], age[lane] = intervals[-1], 0
            left = torch.where(done[t], lasting + torch.randint(1, 40, (n_lanes,)), left)
        episodes.add(-torch.ones(n_steps, n_lanes), torch.zeros_like(done), done)
        stats, lengths = episodes.pop(), []
        while intervals and intervals[0] not in began:
            lengths += ended.pop(intervals.pop(0), [])
        is_used = intervals and (intervals[-1] in began or intervals[-1] in ended)
        if not intervals or (is_used and len(intervals) < N_INTERVALS):
            intervals.append(max([-1, *began, *ended, *intervals]) + 1)
        assert stats["episode/count"] == len(lengths) and len(episodes.intervals) <= N_INTERVALS
        if lengths:
            reports.append((-stats["episode/return"], lengths))
    first, lengths = reports[0]
    assert first == pytest.approx(sum(lengths) / len(lengths)) and max(lengths) > 25 > min(lengths)
    counted = [n for _, lengths in reports for n in lengths]
    assert len(reports) > 10 and reports[-1][0] == pytest.approx(
        sum(counted[-(n := int(stats["episode/window"])) :]) / n
    )


def test_an_episode_without_an_end_holds_up_no_report(monkeypatch):
    monkeypatch.setattr(episode_stats, "LONGEST", 30)
    episodes, none = EpisodeStats(2, "cpu"), torch.zeros(10, 2, dtype=torch.bool)
    done = none.clone()
    done[4::5, 0] = True  # lane 1 goes on for ever
    counts = []
    for _ in range(8):
        episodes.add(torch.ones(10, 2), none, done)
        counts.append(episodes.pop()["episode/count"])
    assert counts == [0, 0, 0, 3 + 2 + 2, 2, 2, 2, 2]


@pytest.mark.cuda
def test_a_graph_on_a_gpu_counts_as_the_cpu_does():
    """Over several rollouts and reports, with a group, NaN rewards, infinite metrics, lanes that do
    not learn, sources, and layouts out of range.
    """
    shape, group = (32, 300), torch.arange(300) % 3 == 0
    sources, device = ["homes", "maze", "maze", "bench"], torch.device("cuda")
    plain, graphed = (
        EpisodeStats(300, at, ["laps"], {"some": group.to(at)}, True, sources)
        for at in ("cpu", device)
    )
    kept = []

    def add(rows):
        graphed.add(*rows[:4], {"laps": rows[4]}, rows[5])
        return {}

    count = CudaGraphUpdate(add, device, graph=True)
    for seed in range(8):
        torch.manual_seed(seed)
        reward, laps = torch.randn(2, *shape)
        reward[torch.rand(shape) < 0.01] = torch.nan
        laps[torch.rand(shape) < 0.01] = torch.inf
        flags = [torch.rand(shape) < p for p in (0.1, 0.1, 0.9)]
        rows = [reward, *flags, laps, torch.randint(-1, 6, shape, dtype=torch.int32)]
        plain.add(*rows[:4], {"laps": laps}, rows[5])
        kept[:] = kept or [row.to(device) for row in rows]
        for there, here in zip(kept, rows, strict=True):
            there.copy_(here)
        count(kept)
        torch.testing.assert_close(graphed.sums.cpu(), plain.sums)
        assert graphed.pop() == pytest.approx(plain.pop())
        assert graphed.intervals == plain.intervals
    assert plain.windows[0] and graphed.began.cpu().equal(plain.began)


@pytest.mark.parametrize("metrics, sources", [((), None), (("a", "b"), ("s", "t", "s"))])
def test_sums_are_those_of_a_slow_count(metrics, sources):
    random = torch.Generator().manual_seed(1)
    shape = 40, 50
    leads, n = torch.rand(50, generator=random) < 0.5, len(metrics)
    stats = EpisodeStats(50, "cpu", metrics, {"leader": leads}, True, sources)
    expected, running = torch.zeros_like(stats.sums[:, :, 0]), [(0.0, 0, False)] * 50
    for _ in range(3):
        reward, *others = torch.randn((1 + n, *shape), generator=random)
        for tensor, value in zip([reward, *others], (float("nan"), float("inf"), float("nan"))):
            tensor[torch.rand(shape, generator=random) < 0.1] = value
        done, late = torch.rand((2, *shape), generator=random) < torch.tensor([[[0.05]], [[0.7]]])
        reset = torch.cat([done[:1] & False, done[:-1] & late[1:]])
        learns = torch.rand(shape, generator=random) < 0.8
        layouts = torch.randint(-1, 4, shape, generator=random, dtype=torch.int32)
        stats.add(reward, reset, done, learns, dict(zip(metrics, others)), layouts)
        for t, lane in itertools.product(range(40), range(50)):
            total, length, is_whole = running[lane]
            total += float(reward[t, lane].nan_to_num(0.0))
            length += not reset[t, lane]
            if done[t, lane] and learns[t, lane] and is_whole:
                of_metrics = [float(one[t, lane]) for one in others]
                left_out = [not math.isfinite(x) for x in of_metrics]
                good = [0.0 if bad else x for x, bad in zip(of_metrics, left_out)]
                row = [1, total, total**2, length, *good, *left_out, *map(math.isinf, of_metrics)]
                where = int(layouts[t, lane])
                columns = [0, 1] if leads[lane] else [0]
                if sources and 0 <= where < 3:
                    columns.append(2 + stats.sources.index(sources[where]))
                expected[columns] += torch.tensor(row, dtype=torch.float64)
            running[lane] = (0.0, 0, True) if done[t, lane] else (total, length, is_whole)
    assert expected[0, 0] > 100
    assert torch.allclose(stats.sums.sum(2), expected)
    assert torch.allclose(stats.totals, torch.tensor([r[:2] for r in running]).double().T)
