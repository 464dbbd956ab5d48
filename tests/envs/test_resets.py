"""Resets by a mask and by a seed: lanes of the mask begin, the others are those of a twin that was
never reset, and a seed gives the same episodes each time.
"""

import copy

import pytest
import torch
from forage import Forage

from megastep import capture, contract, envs, geometries, toys
from megastep.arrdict import arrdict
from megastep.engine.state_tree import state_tree
from megastep.env_state import EnvState
from megastep.types import n_lanes, optional, takes_masks
from tests.helpers.synchronisation import no_synchronisation

N = 7  # as many as rows of PointGoal's progress, whose lanes are on its last axis
HOMES = geometries.sample("homes", N, seed=7)
ROOMS = geometries.sample("quadrant", N, seed=7)
MAZES = geometries.sample("memory_maze", N, seed=7)
SHORT = dict(resample=True, privileged=True, limit=9)
MAKERS = {
    "minimal": (envs.Minimal, dict(geometries=[toys.box()], shortest=5, longest=9)),
    "explorer": (
        envs.Explorer,
        dict(geometries=HOMES, patience=2, resample=True, privileged=True),
    ),
    "pointgoal": (envs.PointGoal, dict(geometries=HOMES, **SHORT)),
    "deathmatch": (envs.Deathmatch, dict(geometries=HOMES, n_agents=4, **SHORT, hearing=5.0)),
    "search": (envs.Deathmatch, dict(geometries=HOMES, n_agents=2, limit=9, search_reward=1.0)),
    "pong": (envs.Pong, dict(limit=30, points=3)),
    "self_play": (envs.Pong, dict(limit=30, self_play=True, pixels=True)),
    "minatar": (envs.MinAtar, dict(id="seaquest", limit=9)),
    "memory": (envs.Memory, dict(geometries=MAZES, **SHORT)),
    "keys": (envs.Keys, dict(geometries=HOMES, **SHORT)),
    "hideandseek": (envs.HideAndSeek, dict(geometries=ROOMS, prep=3, **SHORT)),
    "forage": (Forage, dict(geometries=HOMES, limit=9)),
}
every_env = pytest.mark.parametrize("name", MAKERS)


def make(name, device="cpu", n=N):
    kind, settings = MAKERS[name]
    return kind(n, device=device, **settings)


def decisions(env, n_steps, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return [arrdict(actions=contract.random_actions(env, generator)) for _ in range(n_steps)]


def is_same(a, b):
    return contract.same({"": a}, {"": b}) or torch.equal(_bytes(a), _bytes(b))  # NaN in tables


def _bytes(leaf):
    return leaf.contiguous().view(-1).view(torch.uint8)


def state_of(env, lanes):
    """The rows of some lanes in all tensors of an environment that have lanes."""
    found, n = {}, n_lanes(env)
    whole = lanes.view(env.n_envs, -1).all(1)
    for path, leaf in state_tree(env).items():
        leaf = leaf.movedim(-1, 0) if path[1:] in env._resets.lanes_last else leaf
        if leaf.ndim and len(leaf) in (n, env.n_envs):
            found[path] = leaf[lanes if len(leaf) == n else whole]
    return found


@every_env
def test_lanes_outside_the_mask_go_on_as_in_a_twin(name, device):
    env, twin = make(name, device), make(name, device)
    n, n_agents = n_lanes(env), optional(env, "n_agents")
    generator = torch.Generator().manual_seed(3)
    env.reset()
    twin.reset()
    is_reset, n_resets = torch.zeros(n, dtype=torch.bool, device=device), 0
    for t, decision in enumerate(decisions(env, 24)):
        world, other = env.step(decision), twin.step(decision)
        if t % 6 == 2:  # of three environments that no reset has touched one or none is
            of_env = torch.rand(N, generator=generator) < 0.15
            mask = of_env.repeat_interleave(n_agents).to(device)
            before = world.clone()
            world = env.reset(mask=mask)
            assert contract.same(world[~mask], before[~mask])
            assert world.reset[mask].all() and not world.reward[mask].any()
            assert not (world.terminal | world.truncated)[mask].any()
            is_reset |= mask
            n_resets += int(mask.sum())
        assert contract.same(world[~is_reset], other[~is_reset])
        mine, others = state_of(env, ~is_reset), state_of(twin, ~is_reset)
        wrong = [path for path in mine if not is_same(mine[path], others[path])]
        assert not wrong
    assert n_resets and not is_reset.all()
    env.check()


@every_env
def test_a_seed_repeats_all_episodes(name):
    env, other = make(name), make(name)
    actions = decisions(env, 12)
    env.reset()
    for decision in decisions(env, 15, seed=2):
        env.step(decision)

    def play(env, seed):
        return [env.reset(seed=seed).clone(), *(env.step(action).clone() for action in actions)]

    first, again = play(env, 5), play(other, 5)
    assert all(map(contract.same, first, again))
    assert not all(map(contract.same, play(env, 6), first))
    seeds = torch.full((n_lanes(env),), 5)
    assert contract.same(env.reset(seed=seeds), first[0])


@every_env
def test_masked_lanes_begin_the_episodes_of_their_seed(name):
    env = make(name)
    n, n_agents = n_lanes(env), optional(env, "n_agents")
    first = env.reset(seed=5).clone()
    for decision in decisions(env, 4):
        env.step(decision)
    mask = (torch.arange(N) % 3 == 0).repeat_interleave(n_agents)
    world = env.reset(seed=torch.where(mask, 5, 6), mask=mask)
    assert contract.same(world[mask].obs, first[mask].obs)
    if "privileged" in world:
        assert contract.same(world[mask].privileged, first[mask].privileged)
    assert n == len(world.reward)


def test_one_of_several_agents_begins():
    """In Deathmatch each agent has episodes of its own, and its round goes on."""
    env, twin = make("deathmatch"), make("deathmatch")
    env.reset()
    twin.reset()
    for decision in decisions(env, 5):
        before = env.step(decision).clone()
        twin.step(decision)
    mask = torch.arange(n_lanes(env)) % 4 == 1
    world = env.reset(mask=mask)
    assert contract.same(world[~mask], before[~mask])
    assert (env.ages[mask] == 0).all() and torch.equal(env.ages[~mask], twin.ages[~mask])
    assert torch.equal(env.round_ages, twin.round_ages)
    assert torch.equal(env.health[~mask], twin.health[~mask])
    assert torch.equal(env.layout, twin.layout)


def test_a_game_of_pong_begins_with_both_lanes():
    env = make("self_play")
    env.reset()
    env.step(decisions(env, 1)[0])
    world = env.reset(mask=torch.arange(2 * N) == 3)
    assert world.reset.nonzero().flatten().tolist() == [2, 3]


@every_env
def test_a_restored_state_has_the_last_world_too(name):
    env, other = make(name), make(name)
    env.reset()
    saver, loader = EnvState(env), EnvState(other)
    for decision in decisions(env, 3):
        env.step(decision)
    mask = (torch.arange(N) % 2 == 0).repeat_interleave(optional(env, "n_agents"))
    env.reset(mask=mask)
    loader.load_state_dict(copy.deepcopy(saver.state_dict()))
    assert contract.same(env.reset(seed=9, mask=~mask), other.reset(seed=9, mask=~mask))
    for decision in decisions(env, 12):
        assert contract.same(env.step(decision), other.step(decision))


def test_what_does_not_fit_is_named():
    env = make("pong")
    with pytest.raises(ValueError, match="there is none: call reset"):
        env.reset(mask=torch.ones(N, dtype=torch.bool))
    env.reset()
    with pytest.raises(ValueError, match=r"mask must be a torch.bool tensor of shape \(7,\)"):
        env.reset(mask=torch.ones(N))
    env._resets.last["terminal"] = torch.zeros(1, dtype=torch.bool).expand(N)
    with pytest.raises(ValueError, match=r"world\['terminal'\] has one number in memory"):
        env.reset(mask=torch.ones(N, dtype=torch.bool))
    env.reset()
    with pytest.raises(ValueError, match="seed must be an integer from 0"):
        env.reset(seed=-1)
    state = EnvState(env)  # a mask was never given, so the last world is not saved
    state.load_state_dict(state.state_dict())
    with pytest.raises(ValueError, match="there is none"):
        env.reset(mask=torch.ones(N, dtype=torch.bool))
    assert takes_masks(env) and not takes_masks(capture.Captured(Bare()))


class Bare:
    device = "cpu"

    def reset(self):
        """An environment of somebody else."""


def test_a_reset_that_moves_other_lanes_or_draws_anew_breaks_the_contract(monkeypatch):
    def begin_all(self, seed=None, mask=None):
        return self._begin(torch.ones(n_lanes(self), dtype=torch.bool))

    monkeypatch.setattr(envs.Pong, "reset", begin_all)
    with pytest.raises(contract.ContractError, match="leave other lanes as they are"):
        contract.rollout(make("pong"), 2)
    monkeypatch.undo()
    call = envs.Pong.reset
    monkeypatch.setattr(
        envs.Pong, "reset", lambda self, seed=None, mask=None: call(self, mask=mask)
    )
    with pytest.raises(contract.ContractError, match="a seed must give the same first world"):
        contract.rollout(make("pong"), 2)


@pytest.mark.cuda
@every_env
def test_captured_resets_are_resets_and_do_not_synchronise(name):
    """A graph of a step and the reset of a mask, whose lanes and seeds change between replays."""
    env, twin = make(name, "cuda"), make(name, "cuda")
    n, n_agents = n_lanes(env), optional(env, "n_agents")
    actions = decisions(env, 12)
    env.reset()
    twin.reset()

    def step(decision, seed, mask):
        env.step(decision)
        return env.reset(seed=seed, mask=mask)

    generator = torch.Generator().manual_seed(1)
    inputs = [
        (
            decision,
            torch.randint(2**40, (n,), generator=generator).cuda(),
            (torch.rand(N, generator=generator) < 0.3).repeat_interleave(n_agents).cuda(),
        )
        for decision in actions
    ]
    graph = capture.Graph(step, inputs[0], (env,))
    for decision, seed, mask in inputs:
        with no_synchronisation():
            world = graph(decision, seed, mask)
        twin.step(decision)
        assert contract.same(world, twin.reset(seed=seed, mask=mask))
    captured = capture.Captured(env)  # steps are replayed, resets are not
    for decision, seed, mask in inputs:
        world = captured.step(decision)
        assert contract.same(world, twin.step(decision))
        for _ in range(2):
            world = captured.reset(seed=seed, mask=mask)
            assert contract.same(world, twin.reset(seed=seed, mask=mask))
            seed, mask = seed + 1, ~mask


@pytest.mark.parametrize(
    "on", ["cpu", "cuda kernels", pytest.param("cuda", marks=pytest.mark.cuda)]
)
@pytest.mark.parametrize("name", ["explorer", "memory", "keys", "pointgoal"])
def test_lanes_that_begin_in_place_begin_as_elsewhere(name, on, request, monkeypatch):
    """A subclass computes a new world, of which it takes the rows of the lanes that begin. After
    each reset the state is equal too, of these lanes and of the others.
    """
    kind, settings = MAKERS[name]
    device, kinds = "cuda" if on == "cuda" else "cpu", (kind, type("Other", (kind,), {}))
    own, other = (one(N, device=device, **settings) for one in kinds)
    if on == "cuda kernels":
        request.getfixturevalue("cuda_on_cpu").install(monkeypatch)
    assert contract.same(own.reset(), other.reset())
    for decision in decisions(own, 3 if on == "cuda kernels" else 20):
        worlds = [env.step(decision).clone() for env in (own, other)]
        assert contract.same(*worlds)
        mask = worlds[0].terminal | worlds[0].truncated | (torch.arange(N, device=device) == 3)
        mask = torch.stack([mask, ~mask], 1)[:, 0]  # not contiguous
        address = own._resets.last.obs.rgb.data_ptr()
        worlds = [env.reset(mask=mask) for env in (own, other)]
        assert contract.same(*worlds) and worlds[0].obs.rgb.data_ptr() == address
        worlds = [
            env.reset(mask=world.truncated.logical_not_())
            for env, world in zip((own, other), worlds)
        ]
        assert contract.same(*worlds)
        states = [state_tree(env) for env in (own, other)]
        assert all(is_same(leaf, states[1][path]) for path, leaf in states[0].items())
    nobody = torch.zeros(N, dtype=torch.bool, device=device)
    assert own._begin_in_place(nobody) and not other._begin_in_place(nobody)
