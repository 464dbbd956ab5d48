"""The example that draws unseen views: its geometry, its measures, and a frozen core."""

import egomotion
import pytest
import torch

import megastep
from megastep import data
from megastep.agents.cli import dump
from megastep.agents.networks.policy import Policy
from megastep.arrdict import arrdict

WHERE = ["env=memory", "geometry=box", "env.objects=2", "env.res=64", "env.subsample=1"]


@pytest.fixture(scope="module")
def episodes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "data"
    words = ["bot=walker", "episodes=8", "max_steps=60", "truth=true", f"folder={folder}"]
    assert dump.main([*words, *WHERE, "device=cpu"]) == 0
    return [*data.load(folder)]


def test_what_is_felt_is_how_it_moved(episodes):
    for one in episodes:
        true = egomotion.true_poses(one)
        true = egomotion.relative(true[:1], true)
        felt = egomotion.felt_poses(one.obs["imu"])[:, 0]
        # float16: a millimetre per step at 2 m/s, a tenth of a degree per step
        assert (felt - true)[:, :2].norm(dim=1).max() < 0.06
        turn = (felt - true)[:, 2]
        assert torch.atan2(turn.sin(), turn.cos()).abs().max() < 0.06


def test_relative_poses_on_paper():
    """From (1, 1) facing up, (1, 3) facing left is two metres ahead, turned left by 90 degrees."""
    up, left = torch.pi / 2, torch.pi
    pose = egomotion.relative(torch.tensor([1.0, 1, up]), torch.tensor([1.0, 3, left]))
    torch.testing.assert_close(pose, torch.tensor([2.0, 0, up]))


def test_the_oracle_sees_the_walls(episodes):
    one = episodes[0]
    depth = egomotion.raycast(one["walls"], egomotion.true_poses(one))
    seen = egomotion.views(one.obs)[:, 0]
    # objects hide walls; elsewhere float16's millimetres
    is_wall = seen <= depth + 1e-3
    assert is_wall.float().mean() > 0.7 and (depth - seen)[is_wall].abs().max() < 2e-3


class Told:
    """A model whose features hold the answers, and that draws what there is to see."""

    def __init__(self, episodes):
        self.views = {id(one): egomotion.views(one.obs) for one in episodes}

    def features(self, one):
        self.one, poses = one, egomotion.true_poses(one)
        since = egomotion.relative(poses[:1], poses)
        walls = egomotion.wall_cells(one, poses).float()
        told = [since[:, :2], since[:, 2:].cos(), since[:, 2:].sin(), walls]
        return torch.cat([*told, one["targets_vec"].flatten(1), poses], 1)

    def draw(self, features, pose):
        known = egomotion.true_poses(self.one)
        away = egomotion.relative(features[:, None, -3:], known[None])
        turn = (away - pose[:, None])[..., 2]
        apart = (away - pose[:, None])[..., :2].norm(dim=-1) + 1 - turn.cos()
        return self.views[id(self.one)][apart.argmin(1)]


def test_a_model_that_is_told_makes_no_error(episodes):
    model = Told(episodes)
    errors = egomotion.draw_errors(model, episodes)
    depth, colour = errors["model"]
    assert depth < 0.02 and colour < 0.002, "where an agent stands still, any of its views"
    assert errors["repeat last view"][0] > errors["nearest seen view"][0] > 0.1
    found = egomotion.probe(model, 2 * episodes)  # fitted to those it is asked about
    assert found["walls, F1"] > 0.95 and found["position, m"] < 0.2
    assert found["heading, degrees"] < 10 and found["objects, m"] < 0.3


def test_a_frozen_core_stays_and_the_rest_learns():
    env = megastep.make("minimal", n_envs=4, geometry="box", res=8, device="cpu")
    policy = Policy(env, width=8)
    learner = egomotion.Frozen(policy, n_steps=8, n_minibatches=2)
    collect = learner.collector(env)
    before = arrdict({name: leaf.clone() for name, leaf in policy.named_parameters()})
    for _ in range(3):
        rollout = collect()
        rollout.reward.normal_()
        learner.update(rollout)
    changed = {name for name, leaf in policy.named_parameters() if not leaf.equal(before[name])}
    assert changed and all(name.startswith(("output.", "critic.")) for name in changed)
