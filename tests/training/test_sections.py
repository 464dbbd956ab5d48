"""Where the time of an iteration goes."""

import time

import pytest
import torch

from megastep import capture
from megastep.agents import sections
from megastep.agents.runs.saver import Saver
from megastep.agents.sections import section
from megastep.agents.training import performance
from megastep.agents.training.budget import Budget
from megastep.agents.training.performance import SECTIONS
from megastep.agents.training.trainer import Trainer
from tests.helpers.learners import LEARNERS
from tests.helpers.made_up import B, Numbers

T = 5
UPDATE = T * B


class Perf(list):
    """A logger that keeps what is logged of speed."""

    def write(self, samples, metrics, perf):
        self.append(perf)

    def sync(self):
        pass


def make_trainer(folder, name="ppo", device="cpu", n_updates=6, **settings):
    env = Numbers(device)
    settings = {"width": 8, "n_steps": T, "n_minibatches": 2, "lr": 1e-2, **settings}
    policy, learner = LEARNERS[name].make(env, **settings)
    budget = Budget(n_updates * UPDATE)
    return Trainer(env, policy, learner, Perf(), Saver(folder, {}), budget, log_every=2)


@pytest.fixture
def clock(monkeypatch):
    """The seconds that the host's clock shows; `clock[0] += 1` has a second pass."""
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    sections.pop()
    return now


def test_a_section_has_the_time_that_sections_inside_it_have_not(clock):
    with section("forward"):
        clock[0] += 1
        with section("returns"):
            clock[0] += 10
            with section("forward"):
                clock[0] += 100
        clock[0] += 1000
    assert sections.pop() == {"forward": 1101, "returns": 10}
    assert sections.pop() == {}


def test_an_exception_ends_sections(clock):
    @section("env")
    def fails():
        clock[0] += 1
        with section("store"):
            clock[0] += 10
            raise KeyError("from the environment")

    for _ in range(2):
        with pytest.raises(KeyError, match="environment"):
            fails()
    with section("act"):
        clock[0] += 100
    assert sections.pop() == {"env": 2, "store": 20, "act": 100}


@pytest.mark.parametrize("name", LEARNERS)
def test_sections_add_up_to_the_iteration(name, tmp_path):
    run = make_trainer(tmp_path, name, n_updates=20, width=64)
    run.train()
    times = run.section_times
    milliseconds = times.milliseconds()
    assert list(milliseconds) == list(SECTIONS) and min(milliseconds.values()) > 0
    assert times.n == 19  # the first iteration initialises libraries
    assert sum(milliseconds.values()) == pytest.approx(times.iteration, rel=0.1)
    assert all({f"section/{name}" for name in SECTIONS} <= set(row) for row in run.logger)


def test_a_slow_environment_is_seen_in_its_section(tmp_path, clock):
    run, step = make_trainer(tmp_path), Numbers.step

    def slow(decision):
        clock[0] += 0.25
        return step(run.env, decision)

    run.env.step = slow
    run.train()
    # the first report is of one iteration, as the one before it initialised libraries
    assert [row["section/env"] for row in run.logger] == [250 * T] * 3
    times = run.section_times
    assert times.iteration == times.milliseconds()["env"] == 250 * T


def test_the_host_alone_measures_nothing_more(tmp_path):
    run = make_trainer(tmp_path)
    run.train()
    rows, samples = list(run.logger), run.samples
    run.measure_sections()
    assert run.logger == rows and run.samples == samples


# ---- GPU ----


@pytest.mark.cuda
def test_graphs_captured_meanwhile_have_the_times_of_sections():
    total = torch.zeros(4, device="cuda")

    def work():
        with section("store"):
            total.add_(1)
            with section("env"):
                torch.cuda._sleep(2_000_000)  # cycles, a millisecond

    with sections.Spans() as spans:
        graph = capture.capture(work, (), (total,))
    for _ in range(3):
        graph()
    seconds = spans.seconds()
    assert set(seconds) == {"store", "env"}
    # one pass, although three warm up and three replay
    assert 5e-4 < seconds["env"] < 2e-2 and 0 < seconds["store"] < seconds["env"] / 5
    assert total.tolist() == [3] * 4


def test_an_interrupted_run_on_a_gpu_knows_its_log_only():
    on_gpu, on_cpu = performance.SectionTimes("cuda"), performance.SectionTimes("cpu")
    assert not on_gpu.is_known and not on_cpu.is_known
    for times in on_gpu, on_cpu:
        times.add(dict(rest=0.1, collect=0.9), 2)
    assert not on_gpu.is_known and on_cpu.is_known


@pytest.mark.cuda
@pytest.mark.parametrize("name", LEARNERS)
def test_a_gpu_is_measured_after_training(name, tmp_path):
    run = make_trainer(tmp_path, name, "cuda", n_updates=8)
    run.train()
    assert list(run.section_times.milliseconds()) == ["log"] and not run.section_times.is_known
    n_rows, samples = len(run.logger), run.samples
    run.measure_sections()
    milliseconds = run.section_times.milliseconds()
    assert list(milliseconds) == list(SECTIONS) and min(milliseconds.values()) > 0
    assert run.section_times.is_known
    assert len(run.logger) == n_rows + 1 and run.samples == samples
    assert {f"section/{name}" for name in SECTIONS} < set(run.logger[-1])


@pytest.mark.cuda
@pytest.mark.parametrize("name", [name for name in LEARNERS if "lag" not in name])
def test_measured_iterations_have_the_bits_of_others(name, tmp_path):
    plain, measured = (make_trainer(tmp_path / str(i), name, "cuda") for i in range(2))
    for run in plain, measured:
        run.train()
    measured.measure_sections()
    for _ in range(performance.N_WARM_UPS + 1 + performance.N_REPLAYS):
        plain.learner.update(plain.collect())
    plain_weights, weights = plain.policy.state_dict(), measured.policy.state_dict()
    assert all(torch.equal(weights[name], plain_weights[name]) for name in weights)
