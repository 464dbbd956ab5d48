"""Hide and seek: its rules by hand and against a twin, starts, and quadrant rooms."""

import collections
import hashlib

import numpy as np
import pytest
import torch

from megastep import contract, envs, geometry, modules, toys
from megastep.arrdict import arrdict
from megastep.envs.hideandseek import starts
from megastep.geometries import sample
from tests.helpers import hideandseek_twin
from tests.helpers.outputs import Poison

GRAB, LOCK, AHEAD, LEFT = 7, 8, 3, 5


def make_env(device="cpu", n_envs=1, variant="quadrant", n_plans=3, **settings):
    plans = sample(variant, n_plans)
    small = dict(res=16, subsample=1)
    return envs.HideAndSeek(n_envs, plans, variant=variant, device=device, **small | settings)


def act(env, *actions):
    """Takes a step with one environment's actions, 0 for those that are not given."""
    actions = [*actions, *[0] * (env.n_agents - len(actions))]
    actions = torch.tensor(actions, device=env.device)[:, None].repeat(env.n_envs, 1)
    return env.step(arrdict(actions=actions))


def put(env, agent, x, y, degrees):
    agents = env.core.agents
    agents.positions[:, agent] = torch.tensor([x, y], device=env.device)
    agents.angles[:, agent] = degrees
    agents.velocity[:, agent] = 0


def put_body(env, kind, k, x, y, degrees=0.0):
    kind = env.objects[kind]
    kind.positions[:, k] = torch.tensor([x, y], device=env.device)
    kind.angles[:, k] = degrees


# ---- Rules ----


def arranged(device="cpu", **settings):
    """Two hiders and two seekers in rows, and a box before the first hider, 10 cm away; all else is
    far from them. No preparation.
    """
    env = make_env(device, **{"prep": 0, "n_long": 0, **settings})
    env.reset()
    for a in range(env.n_agents):
        put(env, a, 1.5, (5.0, 6.5, 4.3, 6.0)[a], 0.0)
    put_body(env, "box", 0, 1.5 + 0.106 + 0.1 + 0.3, 5.0)
    put_body(env, "box", 1, 6.0, 6.0)
    if "ramp" in env.objects.kinds:
        put_body(env, "ramp", 0, 6.3, 4.7)
    return env


def test_what_is_grabbed_follows_until_its_holder_lets_go(device):
    env = arranged(device)
    box = env.objects["box"]
    before = box.positions[0, 0].clone()
    world = act(env, GRAB)
    assert box.holders[0].tolist() == [0, -1] and world.obs["state"][0, 0, 4:6].tolist() == [1, 1]
    for _ in range(8):
        act(env, 4)  # backs off
    assert box.positions[0, 0, 0] < before[0] - 0.1, "it was pulled"
    act(env, GRAB)
    assert (box.holders < 0).all()
    for _ in range(8):
        act(env, AHEAD)
    assert box.positions[0, 0, 0] > before[0], "it was pushed"


def test_only_a_team_unlocks_what_it_locked(device):
    env = arranged(device)
    box, colour = env.objects["box"], env.objects["box"].colours
    put(env, 2, 2.3 + 0.2, 5.0, 180.0)  # a seeker on the other side
    world = act(env, GRAB, 0, LOCK)
    assert box.locked[0, 0] and box.owners[0, 0] == 1 and box.holders[0, 0] == -1
    assert colour[0].tolist() == [4, 0], "what seekers locked is red"
    assert world.obs["state"][0, 0, 6:8].tolist() == [0, 1]
    before = box.positions[0].clone()
    for actions in ((LOCK,), (GRAB,), (AHEAD,), (AHEAD,), (AHEAD,)):
        act(env, *actions)
    assert box.locked[0, 0] and (box.holders < 0).all() and torch.equal(box.positions[0], before)
    act(env, 0, 0, LOCK)
    assert not box.locked[0, 0] and box.owners[0, 0] == -1
    act(env, LOCK)
    assert box.owners[0, 0] == 0 and colour[0].tolist() == [3, 0]


def test_hands_reach_25_cm_ahead_and_not_through_walls(device):
    env = arranged(device, n_hiders=1, n_seekers=1)
    box = env.objects["box"]
    for x, degrees, holds in ((1.7 - 0.26, 0, 0), (1.7 - 0.24, 64, 1), (1.7 - 0.24, 66, 0)):
        put(env, 0, x, 5.0, float(degrees))
        put_body(env, "box", 0, 2.0, 5.0)
        act(env, GRAB)
        assert (box.holders[0, 0] == 0) == holds, (x, degrees)
        box.holders.fill_(-1)
    put(env, 0, 3.88, 1.2, 0.0)  # the wall of the inner room is from 4 to 4.1
    put_body(env, "box", 0, 4.41, 1.2)
    assert env.objects["box"].touching(0.14)[0, 0, 0]
    act(env, GRAB)
    assert box.holders[0, 0] == -1


def test_seekers_wait_in_the_preparation_and_the_teams_have_opposite_rewards(device):
    env = arranged(device, prep=6, limit=12)
    for a in (2, 3):
        put(env, a, 2.5, 4.3 + (a - 2), 180.0)
    at = env.core.agents.positions[0].clone()
    for step in range(1, 13):
        world = act(env, AHEAD, 0, AHEAD, GRAB)
        waits = step < 6
        assert bool(env.is_prep[0]) == waits and int(env.steps[0]) == step
        images = torch.cat([world.obs.rgb.flatten(1), world.obs.d.flatten(1)], 1)
        assert images.any(1).tolist() == [True, True, not waits, not waits]
        moved = (env.core.agents.positions[0] != at).any(1)
        assert moved.tolist()[1:3] == [False, step > 6]
        expected = [0, 0, 0, 0] if waits else [-1, -1, 1, 1]
        assert world.reward.tolist() == expected and env.seen[0].any() == (not waits)
        assert world.obs["state"][:, 0, 1].tolist() == [waits] * 4
        assert world.terminal.tolist() == [step == 12] * 4
    assert act(env).reset.all() and env.is_prep.all()


def test_nobody_sees_when_a_preparation_of_random_length_ends(device):
    env = make_env(device, 64, prep=8, min_prep=3, limit=10)
    env.reset()
    ends = env.preps.tolist()
    assert {*ends} == {*range(3, 9)}
    for step in range(1, 11):
        world = act(env)
        is_prep = torch.tensor([step < end for end in ends])
        assert torch.equal(env.is_prep.cpu(), is_prep)
        state, reward = (
            values.cpu().view(64, 4, -1) for values in (world.obs["state"], world.reward)
        )
        assert (state[:, 0, 1] == (step < 8)).all()
        assert (state[:, 0, 2] == ((8 - step) / 8 if step < 8 else (10 - step) / 2)).all()
        assert torch.equal(reward[:, 0, 0] == 0, is_prep)
    act(env)
    assert env.preps.tolist() != ends


def test_a_seeker_sees_what_is_in_its_view_and_behind_nothing(device):
    env = arranged(device, n_hiders=1, n_seekers=1, n_ramps=0)
    cases = [
        ((5.0, 5.0, 180), (2.0, 5.0), True),
        ((5.0, 5.0, 180 + 64), (2.0, 5.0), True),
        ((5.0, 5.0, 180 + 66), (2.0, 5.0), False),
        ((3.7, 1.3, 0), (4.4, 1.3), False),  # a wall
        ((3.9, 1.3, 90), (3.9, 3.8), True),  # along it
    ]
    for seeker, hider, is_seen in cases:
        put(env, 1, *map(float, seeker))
        put(env, 0, *hider, 0.0)
        put_body(env, "box", 0, 1.5, 6.5)
        world = act(env)
        assert env.seen[0].tolist() == [is_seen] * 2, seeker
        assert world.reward.tolist() == ([-1, 1] if is_seen else [1, -1])
    for shift, is_seen in ((0.0, False), (0.25, False), (0.29, True)):  # of the box between them
        put(env, 1, 5.0, 5.0, 180.0)
        put(env, 0, 2.5, 5.0, 0.0)
        put_body(env, "box", 0, 3.7, 5.0 + shift)
        act(env)
        assert bool(env.seen[0, 0]) == is_seen


def test_a_shelter_hides(device):
    """Boxes close the openings of the inner room. Seekers who walk into them get in, unless they
    are locked.
    """
    plans, is_inside = sample("quadrant", 8), {}
    for locks in (True, False):
        env = make_env(device, 8, n_plans=8, prep=0, n_long=0, n_ramps=0)
        env.reset()
        box, agents = env.objects["box"], env.core.agents
        agents.positions[:, :2] = torch.tensor([[5.6, 2.2], [5.9, 2.2]], device=device)
        box.positions[:] = torch.tensor([6.5, 1.5], device=device)
        box.angles.zero_()
        for e, g in enumerate(plans):
            for k in range(2):
                x, y = g.doors.mean(1)[k % len(g.doors)].tolist()
                ways = (4.405, y, x - 0.5, y, 0.0) if x < 4.1 else (x, 3.595, x, y + 0.5, -90.0)
                ways = torch.tensor(ways, device=device)
                box.positions[e, k % len(g.doors)] = ways[:2]
                agents.positions[e, 2 + k] = ways[2:4] if k < len(g.doors) else ways[2:4] * 0 + 2
                agents.angles[e, 2 + k] = ways[4]
        box.lock(torch.full((8,), locks, device=device), team=0)
        n_seen = torch.zeros(8, device=device)
        for _ in range(40):
            act(env, 0, 0, AHEAD, AHEAD)
            n_seen += env.seen[:, :2].any(1)
        inner = (agents.positions[..., 0] > 4.15) & (agents.positions[..., 1] < 3.85)
        is_inside[locks] = inner[:, 2:].any(1)
        assert not n_seen.any() or not locks
    assert not is_inside[True].any() and is_inside[False].all()


def test_step_matches_twin(device, monkeypatch):
    """Agents are put beside bodies at random, heading anywhere, and use their hands."""
    env = make_env(
        device, 16, n_boxes=3, n_seekers=3, limit=14, prep=4, min_prep=2, seed=5, resample=True
    )
    agents, objects, random = env.core.agents, env.objects.all, np.random.default_rng(1)
    env.reset()
    counts = collections.Counter()
    for t in range(30):
        if t % 5:
            k = random.integers(objects.n_bodies, size=(16, env.n_agents))
            beside = objects.positions.cpu()[torch.arange(16)[:, None], torch.as_tensor(k)]
            beside += torch.as_tensor(random.normal(0, 0.4, (16, env.n_agents, 2))).float()
            agents.positions.copy_(beside)
            agents.angles.copy_(torch.as_tensor(random.uniform(-180, 180, (16, env.n_agents))))
            objects.elevated.copy_(torch.as_tensor(random.integers(-1, 2, (16, env.n_agents))))
        actions = torch.as_tensor(random.choice([0, 3, 7, 8], (16, env.n_agents)))
        expected, state, done = hideandseek_twin.step(env, actions)
        counts.update(done)
        poison = Poison(torch.empty)
        with monkeypatch.context() as patch:
            patch.setattr(torch, "empty", poison.allocate)
            out = env._judge(actions.to(device).flatten().contiguous())
        poison.check(**{name: out[name] for name in ("reward", "metrics", "state")})
        counts["seen"] += int(env.seen.sum())
        counts["ended"] += int(out["terminal"].sum())
        for name, value in expected.items():
            given = out[name].cpu()
            given = given.T if name == "metrics" else given.reshape(value.shape)
            close = dict(rtol=1e-3, atol=1e-6) if name in ("metrics", "state") else {}
            torch.testing.assert_close(given.to(value.dtype), value, **close, msg=name)
        after = hideandseek_twin.snapshot(env)
        for name, value in state.items():
            torch.testing.assert_close(after[name].reshape(value.shape), value, msg=name)
    assert min(counts[name] for name in ("let go", "grabbed", "locked", "unlocked", "refused")) > 9
    assert counts["seen"] > 100 and counts["ended"] > 100


def test_a_critic_sees_where_all_are_and_who_locked_what(device):
    env = make_env(device, 3, n_seekers=3, n_boxes=1, privileged=True, prep=0)
    generator = torch.Generator().manual_seed(2)
    env.reset()
    env.objects["box"].lock(torch.tensor([True, False, False], device=device), team=1)
    for _ in range(12):
        world = env.step(arrdict(actions=contract.random_actions(env, generator).to(device)))
    agents, objects = env.core.agents, env.objects.all
    assert objects.locked.any() and env.seen.any()
    others = [[1, 2, 3, 4], [0, 2, 3, 4], [3, 4, 0, 1], [4, 2, 0, 1], [2, 3, 0, 1]]
    for a, order in enumerate(others):
        angle, own = agents.angles[:, a, None], a >= 2

        def pose(positions, angles, angle=angle, at=agents.positions[:, a, None]):
            turn = torch.deg2rad(angles - angle)[..., None]
            return [modules.to_local(angle, positions - at) / 10, turn.cos(), turn.sin()]

        mates = pose(agents.positions[:, order], agents.angles[:, order])
        mates = torch.cat([*mates, env.seen[:, order, None]], -1)
        flags = [objects.locked & (objects.owners == team) for team in (int(own), int(not own))]
        flags = torch.stack([*flags, objects.holders >= 0], -1)
        bodies = torch.cat([*pose(objects.positions, objects.angles), flags], -1)
        expected = torch.cat([env.seen[:, a, None], mates.flatten(1), bodies.flatten(1)], -1)
        given = world.privileged.view(3, 5, -1)[:, a]
        torch.testing.assert_close(given, expected, rtol=0, atol=1e-5)


# ---- Starts and rooms ----


@pytest.mark.parametrize("variant", ["quadrant", "homes"])
def test_episodes_start_with_room_for_all(variant):
    env = make_env(n_envs=64, variant=variant, n_plans=8, limit=3, prep=1, resample=True)
    objects, radii = env.objects.all, [env.core.agents.radius] * 4
    radii = torch.tensor(radii + [0.18**0.5] * 2 + [0.37**0.5, 0.13**0.5])
    for _ in range(3):
        env.reset()
        at = torch.cat([env.core.agents.positions, objects.positions], 1)
        gaps = torch.cdist(at, at) - radii - radii[:, None]
        assert gaps[:, ~torch.eye(len(radii), dtype=torch.bool)].min() > 0.049
        if variant == "quadrant":
            inner = (at[..., 0] > 4.05) & (at[..., 1] < 3.95)
            assert not inner[:, 2:4].any() and inner[:, 4:7].all() and 0 < inner[:, :2].sum() < 100
    assert len(env.core.agents.positions[:, 0].unique(dim=0)) > 40
    contract.rollout(env, 8)  # nothing overlaps, so physics raises nothing


@pytest.mark.parametrize(
    "settings, message",
    [
        (dict(n_boxes=9, n_long=9, n_ramps=2), "at most 16 movable objects, but 20 were given"),
        (dict(n_boxes=16), "at most 16 movable objects, but 18"),
        (dict(n_boxes=7, n_long=8), "no room for 20 agents and objects of up to 1.2 m: use fewer"),
        (dict(geometries=[toys.box()]), "no inner room, which variant=quadrant needs: use geom"),
        (dict(geometries=[toys.box(1.2)], variant="homes"), "has no .*room"),
        (dict(geometries=[toys.box(1)], variant="homes", n_long=0, n_ramps=1), "has no .*room"),
        (dict(limit=20, prep=20), "prep=20 leaves nothing of limit=20 steps to play"),
        (dict(limit=20, prep=9, min_prep=10), "min_prep=10 is above prep=9"),
        (dict(n_boxes=0, n_long=0, n_ramps=0), "at least one"),
        (dict(n_hiders=4), "n_hiders"),
    ],
)
def test_what_does_not_fit_is_named(settings, message):
    plans = dict(geometries=sample("quadrant", 1, width=4.0))
    with pytest.raises(ValueError, match=message):
        envs.HideAndSeek(2, **plans | settings, device="cpu")


def test_quadrants_have_openings_that_an_agent_passes_and_a_box_closes():
    rooms = sample("quadrant", 200)
    n_doors = [len(g.doors) for g in rooms]
    assert 70 < n_doors.count(1) < 130 and n_doors.count(1) + n_doors.count(2) == 200
    upright = [bool(g.doors[0, 0, 0] == g.doors[0, 1, 0]) for g in rooms if len(g.doors) == 1]
    assert 0.3 < np.mean(upright) < 0.7
    for g in rooms[:20]:
        np.testing.assert_allclose(
            np.linalg.norm(g.doors[:, 1] - g.doors[:, 0], axis=-1), 0.45, 1e-5
        )
        for walls, n_parts in ((g.walls, 1), (np.concatenate([g.walls, g.doors]), 2)):
            free = geometry.masks(walls, [], 0.02)[::-1] >= 0
            labels, _ = geometry.components(free)
            inside = {int(labels[int(y / 0.02), int(x / 0.02)]) for x, y in g.lights}
            assert len(inside) == n_parts
    digest = hashlib.sha256(b"".join(g.walls.tobytes() + g.masks.tobytes() for g in rooms[:9]))
    assert digest.hexdigest()[:16] == "7337cd17322144a6", (
        "a seed gives the same bytes on every machine"
    )


def test_cached_starts_are_those_that_were_drawn(tmp_path, monkeypatch):
    monkeypatch.setenv("MEGASTEP_CACHE", str(tmp_path))
    arguments = sample("quadrant", 32), 2, (0.1, 0.1, 0.4), (0, 1, 2), 3
    made, read = starts.starts(*arguments), starts.starts(*arguments)
    np.testing.assert_array_equal(read, made, strict=True)
    assert len([*tmp_path.glob("hideandseek-*")]) == 1


def test_environments_keep_one_age(device):
    env = make_env(device, 64, limit=50)
    env.reset()
    env.desync()
    ages = env.ages.view(64, -1)
    assert (ages == ages[:, :1]).all() and len(ages.unique()) > 20 and ages.max() < 50
