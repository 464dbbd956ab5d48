"""The contract checker accepts a valid environment and names each clause that another breaks."""

import pytest
import torch

from megastep import arrdict, contract, dotdict, spaces


class TinyEnv:
    """Two environments whose episodes last three steps and whose worlds have every optional key.
    The optional attributes `n_agents`, `fps`, `check` and `layout` have their defaults.

    ``fault`` names a change that breaks one clause of the contract.
    """

    n_envs, device = 2, "cpu"
    obs_space = dotdict.dotdict(
        age=spaces.MultiVector(1, 1),
        sky=spaces.MultiImage(1, 3, 1, 2, dtype=torch.uint8),
        body=dotdict.dotdict(hands=spaces.MultiDiscrete(2, 4)),
    )
    action_space, roles = spaces.MultiDiscrete(1, 2), ("runner",)
    privileged_space = dotdict.dotdict(left=spaces.MultiVector(1, 1), lane=spaces.MultiVector(1, 2))

    def __init__(self, fault=None):
        self.fault, self.age = fault, torch.tensor([0, 1])

    def _world(self, reset):
        ended = (self.age == 3) & ~reset
        world = arrdict.arrdict(
            obs=arrdict.arrdict(
                age=self.age.float().view(2, 1, 1),
                sky=torch.full((2, 1, 3, 1, 2), 255, dtype=torch.uint8),
                body=arrdict.arrdict(hands=self.age[:, None] + torch.zeros(2, dtype=torch.int64)),
            ),
            privileged=arrdict.arrdict(
                left=3.0 - self.age.view(2, 1, 1), lane=torch.eye(2).view(2, 1, 2)
            ),
            reward=torch.where(reset, 0.0, 1.0),
            reset=reset,
            terminal=ended & torch.tensor([True, False]),
            truncated=ended & torch.tensor([False, True]),
            learns=torch.tensor([True, False]),
            metrics=arrdict.arrdict(laps=torch.where(ended, 3.0, torch.nan)),
        )
        world.update(self._faulty_items(world, ended))
        for key in self._missing_keys():
            del world[key]
        return world

    def _faulty_items(self, world, ended):
        obs, privileged, reset = world.obs, world.privileged, world.reset
        later = self.age.max() > 1
        items = {
            "reset late": dict(reset=torch.zeros_like(reset)),
            "terminal and truncated": dict(terminal=ended, truncated=ended),
            "ends at first observation": dict(
                terminal=reset | world.terminal, truncated=world.truncated & False
            ),
            "reward at reset": dict(reward=torch.ones(2)),
            "reward nan": dict(reward=world.reward / 0 * 0),
            "obs missing": dict(obs=arrdict.arrdict(age=obs.age, sky=obs.sky)),
            "obs shape": dict(obs=arrdict.arrdict(obs, age=obs.age[:, 0])),
            "obs other dtype": dict(obs=arrdict.arrdict(obs, sky=obs.sky.half())),
            "obs nan": dict(obs=arrdict.arrdict(obs, age=obs.age / 0 * 0)),
            "obs out of range": dict(obs=arrdict.arrdict(obs, body=dict(hands=obs.body.hands + 1))),
            "learns float": dict(learns=torch.ones(2)),
            "metric integer": dict(metrics=dict(laps=torch.zeros(2, dtype=torch.int64))),
            "metric reserved": dict(metrics={"return": torch.zeros(2)}),
            "metric nan": dict(metrics=dict(laps=torch.full((2,), torch.nan))),
            "metric added": dict(metrics=dict(world.metrics, more=torch.zeros(2))) if later else {},
            "privileged missing": dict(privileged=dict(left=privileged.left)),
            "privileged half": dict(privileged=dict(privileged, lane=privileged.lane.half())),
            "privileged shape": dict(privileged=dict(privileged, lane=privileged.lane[..., :1])),
        }
        return items.get(self.fault, {})

    def _missing_keys(self):
        later = bool(self.age.max() > 1)
        missing = {
            "no reward": ["reward"],
            "no privileged": ["privileged"],
            "learns removed": ["learns"] if later else [],
        }
        return missing.get(self.fault, [])

    def reset(self):
        self.age = torch.tensor([0, 1])
        return self._world(torch.ones(2, dtype=torch.bool))

    def step(self, decision):
        reset = self.age == 3
        self.age = torch.where(reset, 0, self.age + 1)
        return self._world(reset)


def test_a_valid_environment_passes():
    assert len(contract.rollout(TinyEnv(), 9)) == 10


def test_a_world_that_is_no_arrdict_is_refused():
    env = TinyEnv()
    env.reset = lambda: (torch.zeros(2), {})
    with pytest.raises(contract.ContractError, match="megastep.arrdict, not a tuple"):
        contract.rollout(env, 0)


@pytest.mark.parametrize("name", contract.ATTRIBUTES)
def test_a_missing_attribute_is_named(name):
    class Incomplete:
        def __getattr__(self, attribute):
            if attribute == name:
                raise AttributeError(attribute)
            return getattr(TinyEnv(), attribute)

    with pytest.raises(contract.ContractError, match=f"^Incomplete .*has no {name}: "):
        contract.check_environment(Incomplete())


@pytest.mark.parametrize(
    "name, value, clause",
    [
        ("fps", 0, "fps .*positive.*not 0"),
        ("n_agents", 0, "n_agents .*positive integer, not 0"),
        ("check", True, "check must be a method .*not True"),
        ("layout", torch.zeros(3, dtype=torch.int32), r"layout .*integer.*\(2,\)"),
        ("roles", ("leader", "follower"), "roles .*one name per agent, 1 in all, not .*'follower'"),
        ("roles", ("red team",), "roles must be identifiers, such as red_team, .*not .*red team"),
    ],
)
def test_a_wrong_attribute_is_named(name, value, clause):
    env = TinyEnv()
    setattr(env, name, value)
    with pytest.raises(contract.ContractError, match=clause):
        contract.check_environment(env)


@pytest.mark.parametrize(
    "fault, clause",
    [
        ("reset late", "reset must be True after"),
        ("terminal and truncated", "terminal and truncated exclude"),
        ("ends at first observation", "must not end at its first observation"),
        ("reward at reset", "reward must be 0 at the first observation"),
        ("reward nan", "reward must be finite"),
        ("no reward", "has no reward"),
        ("obs missing", "obs.body.hands, as obs_space has, not obs.age, obs.sky$"),
        ("obs shape", r"obs.age must be .*\(2, 1, 1\).*not torch.float32 \(2, 1\)"),
        ("obs other dtype", "obs.sky must be torch.uint8 .*not torch.float16"),
        ("obs nan", "obs.age must be finite"),
        ("obs out of range", "obs.body.hands must be from 0 to 3"),
        ("learns float", r"learns must be torch.bool .*not torch.float32"),
        ("learns removed", "learns must be in every world or in none"),
        ("metric integer", r"metrics.laps .*not torch.int64 \(2,\)"),
        ("metric reserved", "name of a metric .*not 'return'"),
        ("metric added", "metrics must have the same keys"),
        ("no privileged", "privileged .*if, and only if"),
        ("privileged missing", "privileged.lane, as privileged_space has, not privileged.left$"),
        ("privileged half", "privileged.lane must be torch.float32 .*not torch.float16"),
        ("privileged shape", r"privileged.lane must be torch.float32 \(2, 1, 2\)"),
    ],
)
def test_a_broken_clause_is_named(fault, clause):
    with pytest.raises(contract.ContractError, match=f"^TinyEnv breaks the contract: .*{clause}"):
        contract.rollout(TinyEnv(fault), 9)


def test_nan_metric_is_an_episode_without_that_number():
    contract.rollout(TinyEnv("metric nan"), 9)


@pytest.mark.parametrize("space", [None, spaces.MultiVector(1, 1)])
def test_privileged_is_optional_and_may_be_one_tensor(space):
    class Env(TinyEnv):
        privileged_space = space

        def _world(self, reset):
            world = super()._world(reset)
            privileged = world.pop("privileged")
            if space is not None:
                world["privileged"] = privileged.left
            return world

    contract.rollout(Env(), 9)
