"""The original megastep's tutorial "A Minimal Env": its code cells run from top to bottom in one
notebook, on the CPU, and give what the page says. data/a_minimal_env.md holds the cells and their
repairs.
"""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib import pyplot as plt
from test_original_concepts import session

from megastep import arrdict, core, cuda, modules, plotting, recording

PAGE = Path(__file__).parent / "data" / "a_minimal_env.md"
CELLS = dict(re.findall(r"^# ([\w' ]+)\n\n```python\n(.*?)```", PAGE.read_text(), re.S | re.M))


@pytest.fixture(autouse=True)
def _on_the_cpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    torch.manual_seed(1)
    with plt.rc_context({"figure.dpi": 50}):  # draws in half the time
        yield
    torch.set_num_threads(threads)
    plt.close("all")


def run(title, names):
    """Runs the cell of that title with a notebook's variables. A cell of `>>>` lines must also
    print what the page shows.
    """
    if CELLS[title].startswith(">>>"):
        names.update(session(CELLS[title], **names))
    else:
        exec(compile(CELLS[title], f"cell '{title}'", "exec"), names)


def notebook(last):
    """The variables of a notebook after running its cells up to and including that title."""
    names, titles = {"__name__": "__main__"}, list(CELLS)
    for title in titles[: titles.index(last) + 1]:
        run(title, names)
    return names


def agent_centre(c, e):
    """(x, y) of the centre of the agent's model in the scenery of environment e."""
    return c.scenery.lines[e][: len(c.scenery.model)].mean((0, 1)).tolist()


def test_all_cells_are_found():
    assert len(CELLS) == PAGE.read_text().count("```python") == 30


def test_scenery_is_displayed():
    names = notebook("scenery")
    scenery, ax = names["scenery"], plt.gca()
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    assert left < -0.1 and bottom < -0.1 and right > 6 and top > 6, "agents stand at the origin"
    image, area = plotting.rasterise(ax.figure), plotting.Area.on(ax)

    def drawn(point):
        column, row = area.transform.transform(point).astype(int)
        return image[len(image) - 1 - row - 4 : len(image) - row + 4, column - 4 : column + 5]

    for point in (1, 3), (6, 3), (0.1, 0):  # walls, and an agent's side
        assert np.ptp(drawn(point), axis=(0, 1)).max() > 20, point
    assert np.ptp(drawn((3, 3)), axis=(0, 1)).max() == 0
    first_walls = [int(scenery.lines.starts[e]) + len(scenery.model) for e in (125, 126)]
    colours = [scenery.textures[wall] for wall in first_walls]
    assert not torch.equal(*colours), "each environment has random colours"


def test_agents_see():
    names = notebook("inside")
    assert names["c"].agents.positions.shape == (128, 1, 2)
    assert np.allclose(agent_centre(names["c"], 0), [0, 0], atol=1e-6)
    for title in ("render", "screen"):
        run(title, names)
    c, r, im = names["c"], names["r"], names["im"]
    assert im.shape == (1, 1, 64, 3) and im.max() > 0
    shown = plt.gca().images[0].get_array()
    encoded = core.gamma_encode(np.clip(im[0], 0, 1))
    assert shown.shape == (1, 64, 3) and np.allclose(shown, encoded, atol=1e-6)
    # the two middle rays pass either side of straight ahead
    beside = np.tan(np.radians(c.fov / 2)) / 64
    ahead = pytest.approx(2 * [3 * np.hypot(1, beside)], abs=1e-4)
    assert r.distances[0, 0, 31:33].tolist() == ahead
    # the model has moved to where the agent is
    assert np.allclose(agent_centre(c, 0), [3, 3], atol=1e-3)


def test_agents_stop_at_the_wall():
    names = notebook("collision")
    c = names["c"]
    assert (c.agents.positions - torch.tensor([5.8649, 3.0])).abs().max() < 1e-3  # a millimetre
    assert (names["p"].progress < 1).all() and (c.agents.velocity == 0).all()
    assert np.allclose(agent_centre(c, 0), [3, 3], atol=1e-3)  # still, until the next render
    run("render again", names)
    assert np.allclose(agent_centre(c, 0), [5.8649, 3], atol=2e-3)


def test_the_basic_loop_moves_agents_by_their_velocities():
    names = notebook("render again")
    names["cuda"] = Moving()
    run("loop", names)
    c, p, r = names["c"], names["p"], names["r"]
    assert (p.progress == 1).all() and r.screen.shape == (2, 1, 64, 3)
    # three steps of 0.1 s at 1 m/s
    assert torch.allclose(c.agents.positions, torch.tensor([3.0, 3.3]))


class Moving:
    """The engine, with cores whose agents start at (3, 3) and move along +y at 1 m/s."""

    def __getattr__(self, name):
        return getattr(cuda, name)

    def Core(self, scenery):
        c = cuda.Core(scenery)
        c.agents.positions[:] = 3.0
        c.agents.velocity[..., 1] = 1.0
        return c


def test_the_skeleton_steps():
    names = notebook("skeleton's loop")
    first = names["env"].reset()
    assert torch.equal(names["world"].obs, first.obs) and first.obs.max() > 0  # nothing moves yet


def test_importing_the_finished_class_replaces_no_other_name():
    names = notebook("skeleton's loop")
    before = dict(names)
    run("library", names)
    changed = {name for name in names if names[name] is not before.get(name)}
    assert changed == {"Minimal", "self", "world"}
    assert names["self"].core.n_envs == 128 and names["world"].obs.shape == (128, 1, 3, 1, 64)


def test_spawning():
    names = notebook("render the spawned")
    c, reset = names["self"].core, names["reset"]
    positions = c.agents.positions
    assert ((positions > 1 + 0.1) & (positions < 6 - 0.1)).all()  # in the room, clear of the walls
    assert len(positions.unique(dim=0)) > 64  # at different points
    assert c.env_full(1.0).shape == (128,)
    assert reset.shape == (128, 1) and reset.dtype == torch.bool
    assert agent_centre(c, 5) == pytest.approx(positions[5, 0].tolist(), abs=1e-3)


def test_observations():
    names = notebook("reset")
    self, obs = names["self"], names["obs"]
    assert obs.shape == (128, 1, 3, 1, 64) and self.rgb.space.shape == (1, 3, 1, 64)
    screen = cuda.render(self.core.scenery, self.core.agents).screen
    assert torch.equal(obs[:, :, :, 0].transpose(-1, -2), screen)


def test_movement():
    names = notebook("mover")
    c = names["self"].core
    c.agents.positions[:] = 3.0
    c.agents.angles[:] = 0.0
    run("movement", names)
    # forward is the agent's +x: 10 m/s for 0.1 s
    assert torch.allclose(c.agents.positions, torch.tensor([4.0, 3.0]), atol=1e-3)


def test_heads():
    decision = notebook("decision")["decision"]
    assert decision.logits.shape == (128, 1, 7)
    assert torch.allclose(decision.logits.exp().sum(-1), torch.ones(128, 1))
    assert decision.actions.shape == (128, 1)
    assert ((decision.actions >= 0) & (decision.actions < 7)).all()


def test_random_actions_run():
    names = notebook("trying it out")
    world, positions = names["world"], names["env"].core.agents.positions
    assert world.obs.shape == (128, 1, 3, 1, 64) and world.obs.isfinite().all()
    assert ((positions > 1 + 0.1) & (positions < 6 - 0.1)).all()


def test_the_whole_notebook_records_a_video(tmp_path):
    import av

    names = notebook("plot state")
    names["range"] = lambda n: range(n // 8)  # 8 frames instead of 64, which take ten seconds
    run("recording", names)
    with av.open(str(names["encoder"].save(tmp_path / "minimal.mp4"))) as container:
        assert container.streams.video[0].frames == 8


def test_the_tutorial_functions_make_an_environment_that_can_be_recorded(tmp_path):
    """The functions become methods of a class."""
    names = notebook("plot state")
    methods = {name: names[name] for name in ("reset", "step", "state", "plot_state")}
    env = type("Typed", (), methods)()
    env.core = names["self"].core
    env.rgb, env.movement = modules.RGB(env.core), modules.SimpleMovement(env.core)

    with recording.ParallelEncoder(env.plot_state) as encoder:
        env.reset()
        for _ in range(2):
            world = env.step(arrdict.arrdict(actions=env.core.agent_full(3)))
            encoder(env.state())
    assert world.obs.shape == (128, 1, 3, 1, 64)
    assert encoder.save(tmp_path / "typed.mp4").stat().st_size > 1000
