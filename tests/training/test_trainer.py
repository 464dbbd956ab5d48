"""The training loop: what it counts, logs and saves, and what it does on NaN, out of memory and
other errors.
"""

import contextlib
import dataclasses
import re
from types import SimpleNamespace

import pytest
import torch

from megastep import spaces
from megastep.agents.algorithms import nonfinite
from megastep.agents.algorithms.nonfinite import NonFiniteError
from megastep.agents.algorithms.ppo import PPO
from megastep.agents.evaluation.in_training import Evaluations
from megastep.agents.networks.policy import Policy
from megastep.agents.runs import checkpoint
from megastep.agents.runs.json_lines import AppendedFile
from megastep.agents.runs.saver import Saver
from megastep.agents.training import performance
from megastep.agents.training.budget import AnnealingRecord, Budget
from megastep.agents.training.callbacks import MAX_SKIPPED
from megastep.agents.training.loggers import Loggers
from megastep.agents.training.performance import MAX_AHEAD
from megastep.agents.training.trainer import Trainer
from megastep.arrdict import arrdict
from tests.helpers.logged import Rows
from tests.helpers.synchronisation import no_synchronisation
from tests.helpers.weights import copied, same

B, T, UPDATE = 6, 4, 24  # lanes, steps of a rollout, samples of an update


class Numbers:
    """Observes two random numbers. Each step gives reward 1; episodes are truncated after 7 steps.

    Args:
        faults: {(tensor, step, lane): value}; the first step after `reset` is 1.
    """

    obs_space, action_space = spaces.MultiVector(1, 2), spaces.MultiDiscrete(1, 3)
    n_envs, n_agents, device = B, 1, torch.device("cpu")

    def __init__(self, faults=()):
        self.faults, self.generator = dict(faults), torch.Generator().manual_seed(1)
        self.steps, self.n_checks = 0, 0
        self.age = torch.zeros(B, dtype=torch.int64)

    def reset(self):
        return self._world(torch.ones(B, dtype=torch.bool))

    def step(self, decision):
        self.steps += 1
        return self._world(self.age == 7)

    def _world(self, reset):
        self.age = (self.age + 1).masked_fill(reset, 0)
        none = torch.zeros(B, dtype=torch.bool)
        obs = torch.randn(B, 1, 2, generator=self.generator)
        reward = torch.ones(B).masked_fill(reset, 0.0)
        world = dict(obs=obs, reward=reward, reset=reset, terminal=none, truncated=self.age == 7)
        for (name, step, lane), value in self.faults.items():
            if self.steps == step:
                world[name][lane] = value
        return arrdict(world)

    def check(self):
        self.n_checks += 1


class Pairs(Numbers):
    """The same lanes as three environments of a leader and a follower. The follower's episodes end
    one step later. The metric `age` is ten times the length.
    """

    n_envs, n_agents, roles = B // 2, 2, ("leader", "follower")

    def step(self, decision):
        self.steps += 1
        return self._world(self.age == 7 + torch.arange(B) % 2)

    def _world(self, reset):
        world = super()._world(reset)
        ends = self.age == 7 + torch.arange(B) % 2
        age = torch.where(ends, 10.0 * self.age, torch.nan)
        return arrdict(world, truncated=ends, learns=torch.arange(B) < 4, metrics=arrdict(age=age))


def make_trainer(
    folder, faults=(), samples=None, every=1, lr=1e-3, env=None, callbacks=(), **options
):
    """A trainer in `Numbers` that saves into a folder."""
    env = env or Numbers(faults)
    policy = Policy(env.obs_space, env.action_space, width=8)
    learner = PPO(policy, n_steps=T, n_minibatches=2, lr=lr)
    callbacks = [*callbacks, rows := Rows()]
    options |= {"saver": Saver(folder, {}), "callbacks": callbacks, "log_every": every}
    trainer = Trainer(env, policy, learner, Budget(samples), **options)
    trainer.rows = rows
    return trainer


def always(name, lane, value, n=1000):
    return {(name, step, lane): value for step in range(1, n)}


def test_trainer_collects_updates_logs_and_saves(tmp_path):
    run = make_trainer(tmp_path, samples=5 * UPDATE, every=2)
    run.train()
    # the last report is of the update since the second
    assert [row["samples"] for row in run.rows] == [2 * UPDATE, 4 * UPDATE, 5 * UPDATE]
    assert [row["updates"] for row in run.rows] == [2, 4, 5]
    assert run.env.steps == 5 * T and run.env.n_checks == 3
    assert checkpoint.load_latest(tmp_path).step == 5 * UPDATE
    # episodes of 7 steps and one for the reset: the first ends in step 7, and the second, which
    # began in the same interval, in step 15
    assert [row["episode/count"] for row in run.rows] == [0, 2 * B, 0]
    assert [row.get("episode/return") for row in run.rows] == [None, 7, 7]
    assert run.score is None and run.fraction_left == 0


def test_score_waits_for_100_episodes(tmp_path):
    """Six episodes of 8 steps end at a time: 96 that have ended after 128 steps."""
    run = make_trainer(tmp_path, samples=33 * UPDATE, every=1)
    run.train()
    assert run.rows[-1]["episode/window"] == 96 and run.score is None
    run.budget = Budget(34 * UPDATE)
    run.train()
    assert run.rows[-1]["episode/window"] == 102 and run.score == 7


def test_cut_first_episodes_are_no_statistics(tmp_path):
    class Desynced(Numbers):
        def desync(self):
            self.age = torch.arange(B)  # a first episode of 7 to 2 steps

    assert make_trainer(tmp_path, env=Desynced()).env.age.tolist() == [0] * B
    run = make_trainer(tmp_path, samples=8 * UPDATE, every=4, env=Desynced())
    run.episodes.begin(run, desync=True)
    run.train()
    first, row = run.rows
    # lane i is truncated at step 7 - i and, one step for the reset later, at 15 - i and 23 - i
    assert first["episode/count"] == 0
    assert (row["episode/count"], row["episode/length"], row["episode/return"]) == (2 * B, 7, 7)


def test_seconds_of_each_phase_and_the_rest_add_up(tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(performance.time, "perf_counter", lambda: now[0])
    perf = []

    class Slow:
        def on_update(self, trainer, losses):
            now[0] += 1

        def on_report(self, trainer, metrics):
            perf.append(metrics)

    run = make_trainer(tmp_path, samples=5 * UPDATE, every=2, callbacks=[Slow()])
    collect, update = run.collect, run.learner.update

    def taking(seconds, function):
        def call(*args):
            now[0] += seconds
            return function(*args)

        return call

    run.collect, run.learner.update = taking(3, collect), taking(5, update)
    run.train()
    phases = [{name: row[f"perf/{name}"] for name in ("collect", "update", "rest")} for row in perf]
    # the first update compiles, so the first report counts from its end
    assert phases == [
        {"collect": 3, "update": 5, "rest": 1},
        {"collect": 6, "update": 10, "rest": 2},
        {"collect": 3, "update": 5, "rest": 1},
    ]


def test_the_host_is_at_most_some_updates_ahead_of_a_gpu(tmp_path, monkeypatch):
    events, n_behind = [], []

    class Event:
        """Is reached only while the host waits, as on a GPU that is slower than any host."""

        def __init__(self):
            self.is_reached = False
            events.append(self)

        def query(self):
            return self.is_reached

        def elapsed_time(self, end):
            return 1.0

    def reach(until=None):
        for event in [event for event in events if not event.is_reached][:until]:
            event.is_reached = True

    run = make_trainer(tmp_path, samples=40 * UPDATE, every=100)
    run.timing.device, run.timing._now = torch.device("cuda"), Event
    monkeypatch.setattr(torch.cuda, "memory_stats", lambda device: {})
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: reach())
    monkeypatch.setattr(performance.time, "sleep", lambda seconds: reach(1))
    collect = run.collect

    def counted():
        n_behind.append(sum(not event.is_reached for event in events) / 3)
        return collect()

    run.collect = counted
    run.train()
    assert len(n_behind) == 40
    assert MAX_AHEAD <= max(n_behind) <= MAX_AHEAD + 1


@pytest.mark.cuda
def test_phases_are_timed_on_a_gpu_without_waiting_for_it():
    timer, matrix = performance.Timing("cuda"), torch.rand(2048, 2048, device="cuda")
    torch.cuda.synchronize()
    with no_synchronisation():
        for _ in range(20):
            timer.start("work")
            matrix @ matrix
            timer.start("rest")
    seconds = timer.pop()
    assert set(seconds) == {"work", "rest"} and seconds["work"] > seconds["rest"] >= 0
    assert set(timer.pop()) == {"rest"}


def test_loss_without_a_gradient_step_is_left_out(tmp_path):
    run = make_trainer(tmp_path, always("reward", 2, torch.nan, n=5), samples=2 * UPDATE)
    with pytest.warns(UserWarning, match="reward of lane 2"):
        run.train()
    first, second = run.rows
    assert "loss/value" not in first and first["loss/skipped_steps"] == 2
    assert second["loss/value"] > 0


def test_failed_saves_are_one_warning_also_where_the_run_folder_is_gone(tmp_path, monkeypatch):
    def failing(*_):
        raise OSError(5, "other bytes")

    monkeypatch.setattr(checkpoint, "save", failing)
    saver = Saver(tmp_path / "gone" / "checkpoints", {})
    with pytest.warns(UserWarning, match=r"\(other bytes\).*gone, which cannot be read") as caught:
        for step in (1, 2):
            saver(step, {})
            saver.wait()
    assert len(caught) == 1 and "at 2 samples" in saver.error


def test_losses_may_be_numbers_or_none_at_all(tmp_path):
    run = make_trainer(tmp_path, samples=2 * UPDATE)
    losses = iter([{"loss/a": 0.5, "loss/b": torch.tensor(2), "loss/c": 3}, {}])
    run.learner.update = lambda rollout: next(losses)
    run.train()
    first, second = run.rows
    assert [first[f"loss/{name}"] for name in "abc"] == [0.5, 2, 3]
    assert not any(name.startswith("loss/") for name in second)


def test_metrics_are_logged_by_name_and_role_for_lanes_that_learn(tmp_path):
    run = make_trainer(tmp_path, samples=6 * UPDATE, every=3, env=Pairs())
    run.train()
    row = run.rows[-1]
    assert row["episode/count"] == 8 and row["episode/age"] == 75
    assert row["episode/return"] == 7.5
    assert (row["episode/age/leader"], row["episode/age/follower"]) == (70, 80)
    assert (row["episode/return/leader"], row["episode/return/follower"]) == (7, 8)
    assert run.latest_stats["episode/age"] == 75


def test_trainer_stops_on_request(tmp_path):
    run = make_trainer(tmp_path, every=5)
    run.train(lambda: run.updates == 2)
    assert [row["updates"] for row in run.rows] == [2], "what was not reported yet is reported"
    assert run.samples == checkpoint.load_latest(tmp_path).step == 2 * UPDATE


def test_resumed_trainer_continues_and_does_not_save_again(tmp_path):
    first = make_trainer(tmp_path, samples=2 * UPDATE)
    first.train()
    second = make_trainer(tmp_path / "second", samples=2 * UPDATE, lr=0.5)
    second.run_state.load_state_dict(checkpoint.load_latest(tmp_path).state)
    assert same(copied(second.policy), copied(first.policy))
    assert (second.samples, second.updates) == (2 * UPDATE, 2)
    assert second.clock.seconds == pytest.approx(first.clock.seconds, abs=1)
    second.train()
    assert second.env.steps == first.env.steps and not (tmp_path / "second").exists()


def test_state_of_another_environment_begins_new_episodes_and_says_so(tmp_path):
    first, second = (make_trainer(tmp_path) for _ in range(2))
    for _ in range(3):  # 12 steps: an episode ended after 7
        first.update()
    state = first.run_state.state_dict()
    state["env"] = {}
    second.run_state.load_state_dict(state)
    assert [lost.endswith("new episodes start") for lost in second.lost] == [True]
    assert first.episodes.stats.totals.all() and not second.episodes.stats.totals.any()
    assert not second.episodes.stats.sums.any(), "of all that began, the short ones are left"


@pytest.mark.parametrize("seconds, steps", [(0.9, [1, 2, 3, 4]), (1.0, [4])])
def test_slow_disk_delays_checkpoints_of_a_second_or_more(tmp_path, seconds, steps):
    """An update takes two seconds, and the disk is never done."""
    saved = []

    class Clock:
        def on_start(self, trainer):
            trainer.clock.seconds += 2

        def on_update(self, trainer, losses):
            trainer.clock.seconds += 2

    options = {"checkpoint_seconds": seconds, "callbacks": [Clock()]}
    run = make_trainer(tmp_path, samples=4 * UPDATE, **options)

    class SlowDisk(Saver):
        is_writing = True

        def __call__(self, step, *_):
            saved.append(step // UPDATE)

    run.saver = SlowDisk(tmp_path, {})
    run.clock = SimpleNamespace(seconds=-2.0, is_running=True, paused=contextlib.nullcontext)
    run.train()
    assert saved == steps


@pytest.mark.parametrize("of", ["metrics", "annealing"])
def test_checkpoint_reaches_no_further_than_the_files_on_disk(tmp_path, monkeypatch, of):
    def full_disk(file):
        raise OSError(28, "full")

    writer = Loggers(tmp_path) if of == "metrics" else AnnealingRecord(tmp_path)
    run = make_trainer(tmp_path / "checkpoints", callbacks=[writer])
    monkeypatch.setattr(AppendedFile, "sync", full_disk)
    for options in ({}, {"is_last": True}):  # the last one is worth more than the files
        run.save(**options)
        run.saver.wait()
        assert len(checkpoint.list_checkpoints(tmp_path / "checkpoints")) == len(options)
    writer.close()


def test_budget_ends_at_the_nearer_limit():
    budget = Budget(samples=100, seconds=10.0)
    assert budget.fraction_left(1, 50, 2.0) == 0.5
    assert budget.fraction_left(1, 20, 9.0) == pytest.approx(0.1)
    assert Budget().fraction_left(1, 10**9, 1e9) == 1 and not Budget().is_limited
    assert Budget(100, 10.0, "samples").lr_fraction(1, 50, 9.0) == 0.5
    assert Budget(100, 10.0, "seconds").lr_fraction(1, 50, 9.0) == pytest.approx(0.1)
    assert Budget(100, 10.0, "samples").lr_fraction(1, 120, 9.0) == 0


def test_recorded_factors_replace_the_clocks():
    budget = Budget(100, 10.0, "seconds", recorded=[0.9, 0.7])
    factors = [budget.lr_fraction(updates, 50, 4.0) for updates in range(3)]
    assert factors == [0.9, 0.7, 0.6] and budget.fraction_left(1, 50, 4.0) == 0.5
    assert budget.fraction_left(1, 50, 99.0) > 0 > budget.fraction_left(2, 50, 99.0)
    assert budget.fraction_left(1, 100, 1.0) == 0
    again = dataclasses.replace(budget, is_rerun=True)
    assert again.fraction_left(1, 50, 99.0) == 0.5 and again.fraction_left(2, 50, 1.0) == 0


@pytest.mark.parametrize("name, value", [("reward", 1e30), ("obs", torch.nan)])
def test_one_nonfinite_number_skips_its_rollout_and_changes_nothing_else(tmp_path, name, value):
    step, lane = 6, 3  # in the second rollout
    run = make_trainer(tmp_path, {(name, step, lane): value}, samples=8 * UPDATE)
    run.update()
    before = copied(run.policy), [m.clone() for m in run.learner.optimizer.means]
    run.update()
    assert same(copied(run.policy), before[0])
    assert all(map(torch.equal, run.learner.optimizer.means, before[1]))
    with pytest.warns(UserWarning, match=rf"{name} of lane 3 was (nan|inf|1e\+30) at step"):
        run.train()
    first = run.nonfinite_guard.value
    assert (first.name, first.lane, first.step) == (name, lane, step)
    assert first.is_from_env
    assert not same(copied(run.policy), before[0])
    skipped = [row["loss/skipped_steps"] for row in run.rows]
    assert skipped == [0] * 6  # of the third and later updates
    state = checkpoint.load_latest(tmp_path).state
    assert nonfinite.nonfinite_leaf([state[name] for name in ("policy", "learner")]) is None
    returns = [row["episode/return"] for row in run.rows if row["episode/count"]]
    assert all(0 < r <= 7 for r in returns)


@pytest.mark.filterwarnings("error::UserWarning")
@pytest.mark.parametrize("bad", [torch.nan, torch.inf])
def test_nonfinite_metric_is_left_out_and_an_infinite_one_named_once(bad, tmp_path):
    """The metric of lane 2, a leader, is never finite; that of lane 3, a follower, is 80."""

    class BadMetric(Pairs):
        def _world(self, reset):
            world = super()._world(reset)
            world.metrics.age[2] = bad
            return world

    run = make_trainer(tmp_path, env=BadMetric(), samples=50 * UPDATE, every=5)
    sentence = "metrics.age was infinite or beyond 1e+12 at the end of an episode"
    warns = pytest.warns(UserWarning, match=re.escape(sentence))
    with warns if bad == torch.inf else contextlib.nullcontext() as said:
        run.train()
    assert said is None or len(said) == 1
    assert run.nonfinite_guard.value is None and run.is_saved
    loaded = checkpoint.load_latest(tmp_path).state
    assert loaded["samples"] == 50 * UPDATE
    assert nonfinite.nonfinite_leaf(loaded["episode_stats"]) is None
    row = [row for row in run.rows if "episode/age" in row][-1]
    assert (row["episode/age/leader"], row["episode/age/follower"]) == (70, 80)
    n_followers = row["episode/window/follower"]
    n_leaders = row["episode/window/leader"] / 2  # those of lane 0
    mean = (70 * n_leaders + 80 * n_followers) / (n_leaders + n_followers)
    assert row["episode/age"] == pytest.approx(mean)


def test_what_is_not_learnt_may_be_nonfinite_in_a_checkpoint(tmp_path):
    run = make_trainer(tmp_path)
    run.saver(UPDATE, {**run.run_state.state_dict(), "env": {"x": torch.tensor([torch.nan])}})
    run.saver.wait()
    assert checkpoint.load_latest(tmp_path).state["env"]["x"].isnan().any()


@pytest.mark.parametrize("every", [1, 7])
def test_environment_of_only_nan_ends_the_run(tmp_path, every):
    run = make_trainer(tmp_path, always("reward", 2, float("nan")), every=every)
    before = copied(run.policy)
    with pytest.warns(UserWarning, match="lane 2"), pytest.raises(NonFiniteError) as error:
        run.train()
    assert "reward of lane 2 was nan" in str(error.value)
    assert "environment" in str(error.value)
    next_report = -(-MAX_SKIPPED // every) * every
    assert run.updates == next_report
    assert same(copied(run.policy), before)
    assert same(checkpoint.load_latest(tmp_path).state["policy"], before)


def test_nonfinite_gradients_end_the_run_with_advice(tmp_path):
    run = make_trainer(tmp_path, lr=0.25)
    next(run.policy.parameters()).register_hook(lambda grad: grad * torch.nan)
    with pytest.raises(NonFiniteError, match=r"\(gradients\).*learning rate smaller than 0.25"):
        run.train()
    assert run.updates == MAX_SKIPPED
    assert [row["loss/skipped_steps"] for row in run.rows] == [2] * MAX_SKIPPED
    assert nonfinite.nonfinite_leaf(run.run_state.state_dict()) is None


def test_finite_gradient_restarts_the_count_of_skipped_updates(tmp_path):
    run = make_trainer(tmp_path, samples=50 * UPDATE)
    is_bad = lambda: run.updates % 25 < MAX_SKIPPED - 1  # noqa: E731
    next(run.policy.parameters()).register_hook(lambda grad: grad * torch.nan if is_bad() else grad)
    run.train()
    assert run.updates == 50


@pytest.mark.filterwarnings("ignore:value of lane")
def test_divergence_ends_the_run_and_keeps_the_last_good_checkpoint(tmp_path):
    run = make_trainer(tmp_path, lr=1e3, checkpoint_seconds=0.0)
    with pytest.raises(NonFiniteError, match="learning rate smaller than 1000"):
        run.train()
    assert run.updates < 200
    loaded = checkpoint.load_latest(tmp_path)
    assert nonfinite.nonfinite_leaf(loaded.state) is None
    assert loaded.step <= (run.updates - MAX_SKIPPED) * UPDATE


@pytest.mark.parametrize(
    "path, leaf",
    [
        ("policy.critic.output.scale", lambda run: run.policy.critic.output.scale),
        ("policy.intake.norms.0.mean", lambda run: run.policy.intake.norms[0].mean),
        ("learner.optimizer.squares.0", lambda run: run.learner.optimizer.squares[0]),
    ],
)
def test_nonfinite_state_is_never_saved(tmp_path, path, leaf):
    run = make_trainer(tmp_path)
    run.train(lambda: run.updates == 1)
    leaf(run).fill_(torch.inf)
    run.updates += 1
    with pytest.raises(NonFiniteError, match=f"{path} is not finite"):
        run.save()
    assert [path.name for path in checkpoint.list_checkpoints(tmp_path)] == [f"step_{UPDATE}"]


def test_out_of_memory_ends_the_run_with_a_checkpoint(tmp_path, monkeypatch):
    run = make_trainer(tmp_path)
    real = run.learner.update

    def fails_later(*args):
        if run.updates == 3:
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")
        return real(*args)

    monkeypatch.setattr(run.learner, "update", fails_later)
    with pytest.raises(torch.OutOfMemoryError):
        run.train()
    assert checkpoint.load_latest(tmp_path).step == 3 * UPDATE


def test_first_error_is_raised_if_saving_fails_too(tmp_path, monkeypatch):
    def fails(message):
        def method(*args):
            raise RuntimeError(message)

        return method

    run = make_trainer(tmp_path)
    monkeypatch.setattr(run, "collect", fails("the device is lost"))
    monkeypatch.setattr(run.policy, "state_dict", fails("the state cannot be read"))
    with pytest.raises(RuntimeError, match="lost"):
        run.train()


def test_reports_have_what_evaluations_measure(tmp_path):
    seen = []

    class Measured(Evaluations):
        every, unit, stop, gpus = 1, "samples", {}, ()

        def __init__(self):
            pass

        def measure(self, policy):
            seen.append(policy)
            return {"answer": 42.0, "unknown": torch.nan}

    run = make_trainer(tmp_path, samples=2 * T * B, callbacks=[Measured()])
    run.train()
    assert seen == [run.policy] * 2
    assert all(row["eval/answer"] == 42 and "eval/unknown" not in row for row in run.rows)


def test_a_graph_counts_episodes_only_where_rollouts_keep_their_memory(tmp_path):
    by_graph = []

    class Changing:
        def on_rollout(self, trainer, rollout):
            if trainer.updates == 2:
                rollout.reward = rollout.reward.clone()
            if trainer.updates == 3:
                rollout.reward = trainer.episodes.counted_tensors[0]
            if trainer.updates == 5:
                trainer.rollout = SimpleNamespace(**vars(rollout), reset=rollout.reset)
                trainer.learner.update = lambda rollout: {}

    run = make_trainer(tmp_path, callbacks=[Changing()])

    def graph(rollout):  # stands for the CUDA graph, which reads the memory of the first update
        by_graph.append(run.updates)
        return run.episodes.count(rollout)

    run.episodes.graph = graph
    for _ in range(6):
        run.update()
    assert by_graph == [1, 2, 4, 5]
    assert run.episodes.stats.sums.any()
