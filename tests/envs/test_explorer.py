"""Explorer's step as one operation, against its twin in plain PyTorch."""

from types import SimpleNamespace

import pytest
import torch

from megastep import contract, core, engine, envs, modules, scene, toys
from megastep.arrdict import arrdict
from megastep.envs.explorer import texel_runs
from megastep.geometries import sample
from tests.helpers import explorer_twin, random_scenery
from tests.helpers.outputs import Poison
from tests.helpers.texels import packed, seen_of, unpacked

STATE = "ages", "limits", "ended"


def random_state(c, seed, density):
    """Returns a core's bitmaps ``seen`` and ``visible``, and the tensors of its episodes: some
    start, some end, some go on.
    """
    random = torch.Generator().manual_seed(seed)
    layouts, lanes = c.scenery.layouts, (c.n_envs, c.n_agents)
    n_words = seen_of(c).shape[-1] + seed % 2
    is_visible, is_seen = (
        torch.rand((*axes, 32 * n_words), generator=random) < chance
        for axes, chance in (((len(layouts),), density), (lanes, 0.5))
    )
    visible, seen = packed(is_visible).to(c.device), packed(is_seen).to(c.device)
    n = c.n_envs * c.n_agents

    def integers(low, high):
        return torch.randint(low, high, (n,), generator=random, dtype=torch.int32).to(c.device)

    ended = (torch.rand(n, generator=random) < 0.3).to(c.device)
    state = dict(ages=integers(0, 300), limits=integers(100, 400), ended=ended)
    return seen, visible, integers(0, 90).view(lanes), state


def judge(c, newly_seen, seen, runs, state, coverage=False, privileged=False):
    """Returns Explorer's outcome for a core in any scenery."""
    env = SimpleNamespace(
        **dict(core=c, n_envs=c.n_envs, n_agents=c.n_agents, device=c.device),
        **dict(seen=seen, runs=runs, **state, patience=7),
        **dict(has_metrics=coverage, privileged_space=privileged or None, _resets=engine.Resets()),
    )
    out = envs.Explorer._judge(env, newly_seen)
    metrics = out.pop("metrics")
    return out | dict(coverage=None if metrics is None else metrics[0])


def check_step(c, seed, density, monkeypatch):
    """Compares all outputs and the new state with the twin, bit by bit, and counts of unseen texels
    with its bounds. Returns how many episodes start and end.
    """
    seen, visible, newly_seen, state = random_state(c, seed, density)
    expected = explorer_twin.explorer_step(
        c.scenery, newly_seen, seen, visible, **state, patience=7
    )
    runs, poison = texel_runs(c.scenery, visible), Poison(torch.empty)
    for wanted in ((True, True), (True, False), (False, True), (False, False)):
        coverage, privileged = wanted
        now = {name: tensor.clone() for name, tensor in state.items()}
        with monkeypatch.context() as patch:
            patch.setattr(torch, "empty", poison.allocate)
            args = c, newly_seen, seen, runs if any(wanted) else None, now
            out = judge(*args, coverage, privileged)
        assert (out["coverage"] is None, out["unseen"] is None) == (not coverage, not privileged)
        unseen = out.pop("unseen")
        if privileged:
            poison.check(unseen=unseen)
            certain = explorer_twin.check_unseen(c.scenery, c.agents, seen, visible, unseen)
            assert certain > 0.95 or not density, "few are close to a border of bins"
        for name, tensor in (out | now).items():
            if tensor is not None:
                ours, theirs = tensor.cpu(), expected[name]
                assert ours.dtype == theirs.dtype and torch.equal(ours, theirs), (name, wanted)
    return int(expected["reset"].sum()), int(expected["truncated"].sum())


@pytest.mark.parametrize("n_agents", [1, 3])
@pytest.mark.parametrize("degenerate", [(), random_scenery.EVERYTHING], ids=["plain", "degenerate"])
def test_step_matches_twin_on_every_bit(n_agents, degenerate, device, monkeypatch):
    """Walls begin anywhere in a word, have hundreds of words or none. Environments share layouts,
    and a layout has no environment. Densities 0 and 1 leave no run, and all. `visible` has bits
    beyond a layout's texels.
    """
    n_starts = n_ends = 0
    for seed, density in enumerate((0.0, 0.02, 0.5, 1.0)):
        scenery = random_scenery.random_environments(
            seed, n_agents=n_agents, degenerate=degenerate, origin=190.0 if seed % 2 else 1.0
        )
        c = core.Core(scenery.scenery(device), res=8)
        c.agents.positions.copy_(scenery.positions)
        c.agents.angles.copy_(scenery.angles)
        c.scenery.layout.copy_(torch.tensor([1, 3, 0, 1]))
        starts, ends = check_step(c, seed, density, monkeypatch)
        n_starts, n_ends = n_starts + starts, n_ends + ends
    assert n_starts and n_ends


@pytest.mark.parametrize("n_envs", [1, 77])
def test_step_matches_twin_in_homes(n_envs, device, monkeypatch):
    """77 environments fill no whole number of warps or blocks."""
    homes = sample("bench", 3)
    c = core.Core(scene.scenery(homes, 1, n_envs, device=device), res=8)
    modules.RandomSpawns(homes, c)(c.agent_full(True))
    check_step(c, 1, 0.7, monkeypatch)


def explorer(device, **settings):
    """Nine environments with short episodes."""
    settings = dict(patience=1, res=1, subsample=1) | settings
    return envs.Explorer(9, sample("bench", 3), device=device, **settings)


@pytest.mark.parametrize("settings", [dict(), dict(resample=True, privileged=True)])
def test_episodes_match_twin(settings, device):
    """Every world of many short episodes is that of the twin, from the state before it."""
    env = explorer(device, **settings)
    life, generator, n_ends = env, torch.Generator().manual_seed(1), 0
    world, before = env.reset(), None
    for _ in range(20):
        if before is not None:
            newly_seen = (64 * world.reward).int()
            # the reward of a first observation is 0, whatever it shows
            newly_seen = torch.where(world.reset, life.limits - env.patience, newly_seen)
            expected = explorer_twin.explorer_step(
                env.core.scenery, newly_seen, env.seen, env.visible, **before, patience=env.patience
            )
            values = dict(world, **world.metrics, **world.get("privileged", {}))
            values |= {name: getattr(life, name) for name in STATE}
            for name in expected.keys() & values.keys():
                assert torch.equal(values[name].cpu(), expected[name]), name
            n_seen = unpacked(env.seen[:, 0]).sum(-1)
            assert torch.equal((life.limits - env.patience).cpu(), n_seen.int())
            if "privileged" in world:
                scenery, agents, unseen = env.core.scenery, env.core.agents, world.privileged.unseen
                explorer_twin.check_unseen(scenery, agents, env.seen, env.visible, unseen)
            n_ends += int(world.truncated.sum())
        before = {name: getattr(life, name).clone() for name in STATE}
        world = env.step(arrdict(actions=contract.random_actions(env, generator)))
    assert n_ends > 3


# ---- The privileged observation by hand ----

AHEAD, LEFT, BEHIND, RIGHT = 0, 4, 8, 12  # sectors


def square(device):
    """A room of 1.6 m around (1.8, 1.8), whose four walls have one word of 32 texels each: its
    core, the index of its eastern wall, and bitmaps in which nothing is seen and all is visible.
    """
    c = core.Core(scene.scenery([toys.box(1.6)], 1, device=device))
    c.agents.positions[:] = 1.8
    east = (c.scenery.layouts.lines.vals[..., 0] > 2).all(-1).nonzero().item()
    return c, east, seen_of(c), torch.full((1, 4), -1, dtype=torch.int32, device=device)


def counts_of(c, seen, visible):
    """The unseen texels in each (band, sector)."""
    lane = torch.zeros(1, dtype=torch.int32, device=c.device)
    state = dict(ages=lane, limits=lane + 1, ended=lane.bool())
    runs = texel_runs(c.scenery, visible)
    unseen = judge(c, lane[:, None], seen, runs, state, privileged=True)["unseen"]
    return (64 * unseen.square()).round().int().view(3, 16)


@pytest.mark.parametrize(
    "angle, sector", [(0, AHEAD), (90, RIGHT), (180, BEHIND), (-90, LEFT), (-60, 3), (45, 14)]
)
def test_sectors_follow_the_heading(angle, sector, device):
    """Only the eastern wall is unseen. Sectors are 22.5 degrees wide: 60 degrees to the left is
    closest to sector 3 at 67.5, and 45 to the right to sector 14 at 315.
    """
    c, east, seen, visible = square(device)
    c.agents.angles[:] = angle
    seen.fill_(-1)[..., east] = 0
    counts = counts_of(c, seen, visible)
    assert counts[0, sector] == counts.sum() == 32


# ---- Runs of texels by hand ----


def test_runs_of_a_box():
    """Four walls of 1.6 m have one word of 32 texels each."""
    scenery = scene.scenery([toys.box(1.6)], 1, device="cpu")
    runs = texel_runs(scenery, torch.tensor([[-1, 0b1101, 0, 1 << 31 - 31]], dtype=torch.int32))
    middles = scenery.layouts.lines.vals.mean(1)
    assert torch.equal(runs.runs[:, :2], middles[[0, 1, 3]])
    assert runs.runs[:, 2:].contiguous().view(torch.int32).tolist() == [[0, -1], [1, 13], [3, 1]]
    assert runs.run_starts.tolist() == [0, 3] and runs.n_visible.tolist() == [36]


def test_a_run_never_crosses_a_wall_or_a_word():
    """Walls of 2 m have 40 texels: a word and a quarter, a half and a half, ..."""
    scenery = scene.scenery([toys.box(2)], 1, device="cpu")
    runs = texel_runs(scenery, torch.full((1, 5), -1, dtype=torch.int32))
    words, bits = runs.runs[:, 2:].contiguous().view(torch.int32).T.tolist()
    counts = [bin(word & 0xFFFFFFFF).count("1") for word in bits]
    assert words == [0, 1, 1, 2, 2, 3, 3, 4] and counts == [32, 8, 24, 16, 16, 24, 8, 32]
    assert runs.n_visible.tolist() == [160]
