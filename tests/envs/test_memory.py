"""Memory's rules by hand, and its step against its twin."""

import numpy as np
import pytest
import torch

from megastep import envs, toys
from megastep.arrdict import arrdict
from megastep.envs.first_person import images
from megastep.envs.memory import arrangements
from megastep.geometries import sample
from megastep.modules.kinds import REACH
from tests.helpers import memory_twin
from tests.helpers.outputs import Poison

STATE = "cue", "found", "n_draws", "ages", "ended"


def make_env(device="cpu", n_envs=6, size=9, **settings):
    mazes = sample("memory_maze", 3, size=size)
    return envs.Memory(n_envs, mazes, device=device, res=8, subsample=1, **settings)


def still(env):
    return arrdict(actions=torch.zeros((env.n_envs, 1), dtype=torch.long, device=env.device))


def put(env, k):
    """Puts each agent onto its object k, at rest. k is a number or (N,)."""
    k = torch.as_tensor(k, device=env.device).expand(env.n_envs).long()
    lanes = torch.arange(env.n_envs, device=env.device)
    env.core.agents.positions[:, 0] = env.objects.all.positions[lanes, k]
    env.core.agents.velocity.zero_()


def test_touching_the_object_to_find_earns_1_and_draws_another(device):
    env = make_env(device, objects=4)
    cue = env.reset().obs.cue.clone()
    assert torch.equal(cue[:, 0], env.objects.all.palette[env.cue.long()].half())
    for _ in range(5):
        wanted = env.cue.clone()
        put(env, wanted)
        world = env.step(still(env))
        assert (world.reward == 1).all() and (env.cue != wanted).all()
        assert torch.equal(world.obs.cue[:, 0], env.objects.all.palette[env.cue.long()].half())
        assert not env.step(still(env)).reward.any(), "it still touches the one that it found"
    assert (env.found == 5).all()


def test_maze_and_objects_stay_for_an_episode_and_change_with_the_next():
    env = make_env(n_envs=32, limit=4, resample=True)
    env.reset()
    mazes, at = env.layout.clone(), env.objects.all.positions.clone()
    for _ in range(4):
        put(env, env.cue)
        world = env.step(still(env))
        assert torch.equal(env.layout, mazes) and torch.equal(env.objects.all.positions, at)
    assert world.truncated.all() and not world.terminal.any() and (world.metrics.found == 4).all()
    world = env.step(still(env))
    assert world.reset.all() and not world.reward.any() and not world.metrics.found.any()
    assert (env.layout != mazes).any() and not env.found.any()
    assert (env.objects.all.positions != at).any((1, 2)).all()


def test_no_episode_starts_with_an_object_that_is_touched():
    """Agents respawn at a point where an arrangement has an object."""
    env = make_env(n_envs=200)
    env.spawner.points[:] = env.arrangements[:, :1, :1].flatten(1, 2)
    env.arrangements[:] = env.arrangements[:, :1].clone()
    env.reset()
    away = (env.objects.all.positions - env.core.agents.positions).norm(dim=-1)
    assert (away.argmin(1) == 0).all() and (away[:, 0] == 0).all()
    assert (env.cue != 0).all() and (env.cue.bincount()[1:] > 60).all()


def test_cameras_see_the_cue_s_colour():
    """An agent that faces the object to find, half a metre away. Slanted sides are darker."""
    env = make_env()
    world = env.reset()
    put(env, env.cue)
    env.core.agents.positions[:, 0, 0] -= 0.5
    env.core.agents.angles.zero_()
    pixels, cue = (
        images(env._view()).rgb[:, 0, :, 0, 3:5].float(),
        world.obs.cue[:, 0, :, None].float(),
    )
    hues, expected = (x / x.sum(1, keepdim=True) for x in (pixels, cue))
    torch.testing.assert_close(hues, expected.expand_as(hues), atol=2e-3, rtol=0)


@pytest.mark.parametrize("n_agents_seed", range(2))
def test_step_matches_twin_on_every_bit(n_agents_seed, device, monkeypatch):
    """Some environments start an episode, some end one; agents stand on any object, or on none."""
    random = torch.Generator().manual_seed(n_agents_seed)
    env = make_env(device, n_envs=77, objects=3 + n_agents_seed, privileged=True, limit=10)
    env.reset()
    n_hits = 0
    for step in range(8):
        env.ended.copy_(torch.rand(77, generator=random) < 0.2)
        env.ages.copy_(torch.randint(0, 12, (77,), generator=random))
        on = torch.rand(77, generator=random) < 0.6
        before = env.core.agents.positions.clone()
        put(env, torch.randint(0, 3, (77,), generator=random))
        env.core.agents.positions[~on.to(device)] = before[~on.to(device)]
        env.core.agents.positions.add_(0.5 * torch.rand(77, 1, 2, generator=random).to(device))
        state = {name: getattr(env, name).cpu().clone() for name in STATE}
        objects = env.objects.all
        expected, after, at = memory_twin.memory_step(
            env.core.agents.positions[:, 0].cpu(), torch.tensor(env.core.agents.radius),
            objects.positions.cpu(), objects.sizes.cpu(), env.layout.cpu(),
            env.arrangements.cpu(), state, seed=env.seed, limit=10, reach=REACH,
        )  # fmt: skip
        poison = Poison(torch.empty)
        with monkeypatch.context() as patch:
            patch.setattr(torch, "empty", poison.allocate)
            out = env._judge()
        poison.check(**{name: x for name, x in out.items() if x.dtype != torch.bool})
        ours = {name: getattr(env, name) for name in STATE} | dict(at=objects.positions)
        ours |= {name: out[name].view_as(expected[name]) for name in expected}
        for name, tensor in (expected | after | dict(at=at)).items():
            assert torch.equal(ours[name].cpu(), tensor), (name, step)
        n_hits += int(expected["reward"].sum())
        wanted = objects.palette[env.cue.long()].half()
        assert torch.equal(out["cue_obs"][:, 0], wanted)
        check_privileged(env, out)
    assert n_hits > 20


def check_privileged(env, out):
    offsets = (env.objects.all.positions - env.core.agents.positions).cpu()
    angles = torch.deg2rad(env.core.agents.angles).cpu()
    cosine, sine = angles.cos(), angles.sin()
    ahead = cosine * offsets[..., 0] + sine * offsets[..., 1]
    left = cosine * offsets[..., 1] - sine * offsets[..., 0]
    places = torch.stack([ahead, left], -1) / 10
    torch.testing.assert_close(out["places"].cpu(), places.flatten(1)[:, None])
    cue = env.cue.cpu().long()[:, None, None].expand(-1, 1, 2)
    goal = places.gather(1, cue)
    left = (10 - env.ages.cpu().float()) / 10
    expected = torch.cat([goal, goal.norm(dim=-1, keepdim=True), left[:, None, None]], -1)
    torch.testing.assert_close(out["goal"].cpu(), expected)


# ---- Where objects lie ----


def test_each_object_is_in_a_room_of_its_own_if_there_are_as_many():
    for size, n in ((9, 3), (15, 6)):
        mazes = sample("memory_maze", 4, size=size)
        points = arrangements(mazes, 20, n, 0.2, 0.7, seed=1)
        assert points.shape == (4, 20, n, 2) and points.dtype == np.float32
        for g, of_maze in zip(mazes, points):
            rooms = np.sort(room_of(g, of_maze), -1)
            assert (rooms > 0).all() and (np.diff(rooms, axis=-1) > 0).all()
            assert len(np.unique(of_maze[:, 0], axis=0)) > 15, "places vary"


def room_of(g, points):
    column, row = np.floor(points / g.res).astype(int).transpose(2, 0, 1)
    return g.masks[len(g.masks) - 1 - row, column]


def test_objects_that_do_not_fit_are_told():
    with pytest.raises(ValueError, match="room for 8 objects, 0.71 m apart: take fewer objects"):
        envs.Memory(1, [toys.box(1.2)], objects=8, device="cpu")
    with pytest.raises(ValueError, match="objects"):
        envs.Memory(1, [toys.box()], objects=9, device="cpu")
