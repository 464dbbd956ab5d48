"""Two ranks, each with some of the lanes, learn what one process learns from all of them."""

import itertools

import pytest
import torch

from megastep.agents.algorithms.masked_stats import pooled_mean, pooled_normalise
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.algorithms.vtrace import VTrace
from megastep.agents.distributed import pooling, process_group
from megastep.agents.distributed.ranks import world
from megastep.agents.networks.running_norm import masked_moments
from megastep.agents.storage.rollout import Rollout
from tests.helpers import ranks
from tests.helpers.made_up import MOVES, OBS, PRIVILEGED, T, made_up, weights

LEARNERS = {
    "ppo": lambda policy: PPO(policy, n_minibatches=1, n_epochs=3),
    "stops": lambda policy: PPO(policy, n_minibatches=1, n_epochs=9, lr=0.01, target_kl=0.01),
    "options": lambda policy: PPO(
        policy,
        n_minibatches=1,
        n_epochs=3,
        normalise_advantage="minibatch",
        value_clip=0.1,
        critic_lr=3e-3,
        weight_decay=0.1,
    ),
    "vtrace": lambda policy: VTrace(policy, n_minibatches=1, n_epochs=2),
}
#: Of each rank. They have different numbers of valid steps.
LANES = [0, 4], [1, 2, 3, 5]


def some_lanes(rollout, lanes):
    """Returns a rollout of some of the lanes."""
    part = Rollout(T, len(lanes), OBS, MOVES, rollout.state[lanes], None, PRIVILEGED)
    for name in "obs privileged starts learns actions logprobs values reward".split():
        getattr(part, name)[:] = getattr(rollout, name)[:, lanes]
    part.terminal[:], part.truncated[:] = rollout.terminal[:, lanes], rollout.truncated[:, lanes]
    return part


def learnt(name, is_bad):
    """Returns weights, statistics, the metrics of the first update and the counts after two."""
    policy, rollout = made_up(privileged=PRIVILEGED)
    rollout.learns[:, 2] = False
    if is_bad:
        rollout.reward[1, 4] = torch.nan  # a lane of rank 0
    before = weights(policy)
    if process_group.n_ranks() > 1:
        rollout = some_lanes(rollout, LANES[process_group.rank()])
    learner = LEARNERS[name](policy)
    metrics = learner.update(rollout)
    learner.update(rollout)
    return dict(
        has_changed=bool((weights(policy) != before).any()),
        weights=weights(policy),
        statistics=dict(policy.named_buffers()),
        metrics=metrics,
        n_steps=learner.optimizer.n_steps,
        n_skipped=learner.check.record[1],
    )


def all_learnt():
    cases = itertools.product(LEARNERS, (False, True))
    return {case: learnt(*case) for case in cases}


@pytest.fixture(scope="module")
def on_ranks():
    """What the ranks learnt."""
    return ranks.call(all_learnt)


def every(device="cpu"):
    """Returns what this rank gets from each operation on numbers of its own."""
    rank = process_group.rank()
    x = torch.tensor([[1.0, 2.0, 30.0], [4.0, torch.nan, 60.0]])[rank].to(device)
    valid = torch.tensor([[True, True, False], [True, False, False]])[rank].to(device)
    parameters = [torch.nn.Parameter(torch.zeros(3, device=device)) for _ in range(2)]
    parameters[1].grad = torch.full((3,), 1.0 + rank, device=device)
    n, (mean,) = pooling.average_gradients(parameters, valid.sum(), [x[0]])
    several = [  # a vector, a number without an entry on rank 0, and a matrix
        (torch.tensor(1 + 2 * rank), torch.tensor([1.0, 5.0 + rank]), torch.tensor([0.5, 0.0])),
        (torch.tensor(3 * rank), torch.tensor(7.0 * rank), torch.tensor(2.0 * rank)),
        (torch.tensor(1), torch.full((2, 1), rank * 4.0), torch.zeros(2, 1)),
    ]
    several = [tuple(number.to(device) for number in moments) for moments in several]
    are_small, pooled = zip(
        *(
            pooling.pool_with_condition(torch.tensor(rank < n, device=device), *several)
            for n in (1, 2)
        )
    )
    third = torch.tensor(1), torch.tensor([1 / 3], dtype=torch.float64)
    third = [number.to(device) for number in third]
    return dict(
        are_small=are_small,
        pooled=pooled[0],
        doubles=pooling.pool_moments(several[0], (*third, torch.zeros_like(third[1])))[1],
        nothing=pooling.pool_moments(),
        total=world().sum(x[:1]),
        needed=world().gather_if_any(rank, rank == 1),
        not_needed=world().gather_if_any(rank, False),
        sum=pooling.all_reduce(x[:1].clone()),
        gathered=pooling.all_gather(x[0]),
        mean=pooled_mean(x, valid),
        normalised=pooled_normalise(x, valid),
        gradient=parameters[1].grad,
        no_gradient=parameters[0].grad,
        averages=torch.stack([n, mean]),
    )


def test_one_process_pools_nothing():
    x, valid = torch.tensor([1.0, 3.0, torch.nan]), torch.tensor([True, True, False])
    assert pooled_mean(x, valid) == 2
    assert pooled_normalise(x, valid).tolist() == pytest.approx([-1, 1, 0])
    ((n, mean, variance),) = pooling.pool_moments(*masked_moments(valid, x))
    assert (n, mean, variance) == (2, 2, 1)
    parameter = torch.nn.Parameter(torch.zeros(2))
    parameter.grad = torch.ones(2)
    n, means = pooling.average_gradients([parameter], valid.sum(), [x[0]])
    assert n == 2 and means == [1] and parameter.grad.tolist() == [1, 1]
    assert process_group.exchange([1.5]) == [[1.5]] and process_group.gather_objects("a") == ["a"]


@pytest.mark.slow
def test_operations():
    for rank, found in enumerate(ranks.call(every)):
        assert found["sum"].tolist() == [5] and found["gathered"].tolist() == [1, 4]
        assert found["mean"] == pytest.approx(7 / 3)
        std = (((1 - 7 / 3) ** 2 + (2 - 7 / 3) ** 2 + (4 - 7 / 3) ** 2) / 3) ** 0.5
        expected = [[1, 2], [4]][rank]
        normalised = found["normalised"].tolist()
        assert normalised[: len(expected)] == pytest.approx([(x - 7 / 3) / std for x in expected])
        assert not any(normalised[len(expected) :])
        # rank 0 has two valid entries, rank 1 has one
        assert found["gradient"].tolist() == pytest.approx([4 / 3] * 3)
        assert found["no_gradient"] is None
        assert found["averages"].tolist() == pytest.approx([3, (2 * 1 + 4) / 3])
        assert found["total"].tolist() == [5] and found["total"].dtype == torch.float64
        assert found["needed"] == [0, 1] and found["not_needed"] == [rank]
        assert not found["are_small"][0] and found["are_small"][1]
        n, mean, variance = found["doubles"]
        assert (n, mean.dtype, mean, variance) == (2, torch.float64, 1 / 3, 0)
        assert found["nothing"] == []
        vector, number, matrix = found["pooled"]
        # one entry 5 and three of mean 6: 5.75; variance (0.75^2 + 3 * 0.25^2) / 4
        assert vector[0] == 4 and vector[1].tolist() == [1, 5.75]
        assert vector[2].tolist() == pytest.approx([0.5, 0.1875])
        assert [part.item() for part in number] == [3, 7, 2] and number[0].dtype == torch.int64
        assert matrix[1].tolist() == [[2], [2]] and matrix[2].tolist() == [[4], [4]]


@pytest.mark.slow
@pytest.mark.parametrize("name", LEARNERS)
def test_ranks_learn_what_one_process_does(name, on_ranks):
    first, second = (found[name, False] for found in on_ranks)
    alone = learnt(name, False)
    assert torch.equal(first["weights"], second["weights"]) and alone["has_changed"]
    torch.testing.assert_close(first["weights"], alone["weights"], rtol=1e-4, atol=1e-5)
    for key, value in alone["statistics"].items():
        assert torch.equal(first["statistics"][key], second["statistics"][key])
        torch.testing.assert_close(first["statistics"][key], value, rtol=1e-4, atol=1e-5)
    for key in ("loss/policy", "loss/value", "loss/entropy", "loss/kl", "loss/grad_norm"):
        values = [found["metrics"][key] for found in (first, second, alone)]
        assert values[0] == values[1]
        torch.testing.assert_close(values[0], values[2], rtol=1e-3, atol=1e-5)
    assert first["n_steps"] == second["n_steps"] == alone["n_steps"]
    assert (first["n_steps"] < 18) if name == "stops" else first["n_steps"] > 3


@pytest.mark.slow
@pytest.mark.parametrize("name", LEARNERS)
def test_all_ranks_skip_a_rollout_that_is_bad_on_one(name, on_ranks):
    for found in on_ranks:
        assert not found[name, True]["has_changed"] and found[name, True]["n_skipped"] == 2
