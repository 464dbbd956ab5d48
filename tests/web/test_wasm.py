"""WebAssembly computes the CPU's bits, and pages play in a browser. Slow tests need clang, node or
Chromium, and are skipped where these are missing.
"""

import hashlib
import io
import itertools
import json
import shutil
import subprocess
import time
from pathlib import Path

import build_wasm
import numpy as np
import pytest
import torch
from PIL import Image

from megastep import geometries, spaces
from megastep.agents import pretrained
from megastep.agents.export.launches import add_policy
from megastep.arrdict import arrdict
from megastep.kernels.build.compile import EngineError, wasm, wasm_key, wasm_keys, wasm_tools
from megastep.spaces import random_actions
from megastep.types import n_lanes
from megastep.web.page import FOLDER, SHIPPED, page, scene
from megastep.web.program import Replay
from megastep.web.recording import record
from tests.helpers.agents import env_of
from tests.helpers.chromium import Browser
from tests.helpers.web import ENVS, made

REPLAY = Path(__file__).parents[1] / "helpers/replay_page.js"
ABOUT = {"title": "test", "about": "", "policies": [], "seed": 3}
N_STEPS = 400


def tiers(first, *others):
    """Has the slow tests take the first name, and the nightly ones the others."""
    others = [
        pytest.param(n, marks=pytest.mark.nightly) for n in others if n not in (first, "pixels")
    ]
    return [pytest.param(first, marks=pytest.mark.slow), *others]


def need(program):
    """Returns the path of a program; without it, skips the test."""
    path = shutil.which(program)
    if path is None:
        pytest.skip(f"{program} is not installed (Debian: apt install {program})")
    return path


@pytest.fixture(scope="module")
def modules(tmp_path_factory):
    """A module built now."""
    try:
        wasm_tools()
    except EngineError as error:
        pytest.skip(str(error))
    path = tmp_path_factory.mktemp("modules") / "kernels.wasm"
    path.write_bytes(wasm(build_wasm.operations()))
    return [str(path)]


def run_page(folder, text, **steps):
    """Runs a page's program in node. Returns its results, one for each module."""
    node = need("node")
    (folder / "page.html").write_text(text)
    (folder / "steps.json").write_text(json.dumps(steps))
    words = [node, str(REPLAY), str(FOLDER / "program.js"), "page.html", "steps.json"]
    process = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=300)
    assert not process.returncode, process.stderr
    return [json.loads(line) for line in process.stdout.splitlines()]


def test_shipped_module_is_of_these_kernels():
    keys = wasm_keys(SHIPPED.read_bytes())
    stale = {
        name
        for library, names in build_wasm.operations().items()
        for name in names
        if keys.get(name) != wasm_key(library)
    }
    assert not stale, (
        f"kernels have changed: run scripts/build_wasm.py ({', '.join(sorted(stale))})"
    )
    assert SHIPPED.stat().st_size <= 130_000  # of which 27,000 for objects that agents push


@pytest.mark.parametrize("name", tiers("deathmatch", *ENVS))
def test_modules_compute_the_same_bits_over_episodes(name, modules, tmp_path):
    """Every output and every state, after each step, in the shipped module and one built now."""
    program, env = record(made(name)), made(name)
    replay, generator = Replay(program), torch.Generator().manual_seed(2)
    hashed = [i for i, buffer in enumerate(program.buffers) if buffer.n_bytes < 20_000]
    actions, expected, n_ended = [], [], 0
    replay.run("reset")
    world = env.reset()
    for _ in range(2 * N_STEPS):  # in which Explorer's first episode ends
        leaves = spaces.leaves(world)
        for path, leaf in replay.world().items():
            assert torch.equal(leaf, leaves[path]), path
        expected.append(digest(replay, hashed))
        n_ended += int((world.terminal | world.truncated).sum())
        drawn = random_actions(env.action_space, n_lanes(env), generator=generator)
        actions.append(drawn.flatten(1).tolist())
        replay.tensor(program.actions).copy_(drawn)
        replay.run("step")
        world = env.step(arrdict(actions=drawn))
    expected.append(digest(replay, hashed))
    text = page(program, ABOUT, SHIPPED.read_bytes())
    results = run_page(tmp_path, text, modules=[None, *modules], actions=actions, hashed=hashed)
    for result in results:
        different = [
            t for t, pair in enumerate(zip(result["hashes"], expected)) if len({*pair}) > 1
        ]
        assert not different, f"in step {different[0]}"
    assert len(results) == 2 and n_ended > 0


def digest(replay, hashed):
    state = hashlib.sha256()
    for i in hashed:
        state.update(replay.memory[i])
    return state.hexdigest()[:16]


AGENTS = "deathmatch_anywhere", "explorer_anywhere", "pointgoal_anywhere", "hideandseek_quadrant"


@torch.no_grad()
@pytest.mark.parametrize("name", tiers(*AGENTS))
def test_packaged_agents_act_as_in_pytorch_for_400_steps(name, tmp_path):
    """Greedily, in a closed loop: both in WebAssembly, against both in Python."""
    settings = dict(n_envs=1, seed=3, resample=True)
    policy = pretrained.load(name, "cpu")
    homes = geometries.sample("quadrant" if "hide" in name else "homes", 3, "test", seed=7)
    envs = [env_of(name, homes, **settings) for _ in "ab"]
    program = record(envs[0])
    acting = add_policy(program, policy, range(n_lanes(envs[0])))
    about = ABOUT | {"policies": [acting._asdict()]}
    text = page(program, about, SHIPPED.read_bytes())
    (result,) = run_page(tmp_path, text, modules=[None], hashed=[], greedy=N_STEPS)
    world, state = envs[1].reset(), policy.initial(n_lanes(envs[1]))
    for t in range(N_STEPS):
        decision, state = policy(world, state, sample=False)
        logits = torch.tensor(result["logits"][t]).view_as(decision.logits)
        torch.testing.assert_close(logits.exp(), decision.logits.exp(), rtol=0, atol=1e-5)
        # PyTorch's own float32 log-probabilities are up to 5e-5 from float64's here
        torch.testing.assert_close(logits, decision.logits, rtol=0, atol=1e-4)
        assert torch.equal(torch.tensor(result["taken"][t]), decision.actions), t
        world = envs[1].step(decision)


@pytest.fixture(scope="module")
def agent_page():
    """A page in which the packaged agent explores three homes."""
    env = made("explorer", patience=200)
    program, policy = record(env), pretrained.load("explorer_anywhere", "cpu")
    about = scene(env, program, ["a", "b", "c"]) | ABOUT
    about["policies"] = [{**add_policy(program, policy, range(1))._asdict(), "name": "agent"}]
    return page(program, about, SHIPPED.read_bytes())


def soon(measure) -> bool:
    """Returns whether a measurement is below a second, in milliseconds, once in a minute, as other
    processes may run.
    """
    end = time.monotonic() + 60
    for attempt in itertools.count():
        if measure(attempt) < 1000:
            return True
        if time.monotonic() > end:
            return False


@pytest.mark.slow
def test_a_page_plays_in_a_browser(agent_page, tmp_path):
    """By itself; then the keyboard alone takes over, steps, changes the home and hands back."""
    (tmp_path / "page.html").write_text(agent_page)
    with Browser(tmp_path) as browser:

        def start(attempt) -> float:
            search = f"?{attempt}"
            browser.send("Page.navigate", url=f"file://{tmp_path}/page.html{search}")
            browser.until(f"location.search === '{search}' && globalThis.megastep?.steps > 0")
            return browser.value("megastep.started")

        assert soon(start)  # it can be played
        assert browser.value("performance.getEntriesByType('resource').length") == 0
        assert browser.value("byId('problem').textContent") == ""
        browser.value("byId('speed').value = '20'")
        browser.until("megastep.steps >= 300")
        steps = browser.value("megastep.steps")
        assert browser.value("megastep.returns")[0] > 3
        browser.key(" ", True)
        browser.key(" ", False)
        steps = browser.value("megastep.steps")
        browser.key(".", True)
        assert browser.value("megastep.steps") == steps + 1
        picture = np.asarray(Image.open(io.BytesIO(browser.screenshot())).convert("RGB"))
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100
        blue = np.abs(picture.astype(int) - (15, 139, 216)).sum(-1) < 12  # the agent and its trail
        assert blue.sum() > 200
        home = browser.value("megastep.game.running[0].layout")
        browser.key("n", True)
        assert browser.value("megastep.game.running[0].layout") == (home + 1) % 3

        def step(attempt) -> float:
            browser.value("started = performance.now(), megastep.step(300)")
            return browser.value("performance.now() - started")

        assert soon(step)
        browser.key("ArrowUp", True)  # drives, in a race
        names = browser.value("megastep.game.players.map(player => player.name)")
        before = browser.value("[...megastep.game.players[0].trail.at(-1)]")
        browser.value("megastep.step(5)")
        after = browser.value("[...megastep.game.players[0].trail.at(-1)]")
        assert names == ["you", "agent"] and before != after
        browser.key("Escape", True)
        assert browser.value("megastep.game.players.length") == 1
