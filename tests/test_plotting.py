"""Plots: the sRGB curve, images, floor plans, figures."""

import io
import os
import subprocess
import sys

import matplotlib
import matplotlib.image
import numpy as np
import pytest
import torch

from megastep import core, modules, plotting, scene, toys
from megastep.arrdict import numpyify
from megastep.plotting import gamma_decode, gamma_encode, plans

matplotlib.use("Agg")


@pytest.fixture(autouse=True)
def _figures_closed():
    from matplotlib import pyplot

    yield
    pyplot.close("all")


@pytest.fixture
def ax():
    return plotting.panels()[1]


# ---- sRGB ----


@pytest.mark.parametrize(
    ("light", "value"), [(0, 0), (0.001, 0.01292), (0.2140411, 0.5), (0.5, 0.7353569), (1, 1)]
)
def test_srgb_curve_matches_published_values(light, value):
    assert gamma_encode(light) == pytest.approx(value, abs=1e-6)
    assert gamma_decode(value) == pytest.approx(light, abs=1e-6)


@pytest.mark.parametrize("kind", [np.linspace, torch.linspace])
def test_gamma_decode_inverts_gamma_encode(kind):
    light = kind(0, 1, 10_001)
    tolerance = 1e-14 if kind is np.linspace else 1e-6  # float64 and float32 rounding
    assert abs(gamma_decode(gamma_encode(light)) - light).max() < tolerance
    assert abs(gamma_encode(gamma_decode(light)) - light).max() < tolerance
    assert (np.diff(gamma_encode(light)) > 0).all()


# ---- Images and strips ----


def test_screen_is_gamma_encoded_and_drawn_left_to_right():
    screen = np.zeros((1, 1, 64, 3), np.float32)
    screen[0, 0, 0] = [0.2140411, 1, 0]
    axes = plotting.plot_images({"rgb": screen}, transpose=True, aspect=0.1)
    assert axes.shape == (1, 1) and axes[0, 0].get_title("left") == "rgb"
    assert axes[0, 0].get_box_aspect() == 0.1
    shown = axes[0, 0].images[0].get_array()
    assert shown.shape == (1, 64, 3) and np.allclose(shown[0, 0], [0.5, 1, 0], atol=1e-6)
    assert (shown[0, 1:] == 0).all()


def test_observations_are_channels_first_with_one_panel_per_agent():
    rgb = np.random.default_rng(1).random((2, 3, 1, 8))
    depth = np.linspace(0, 1, 8).reshape(1, 1, 1, 8)
    axes = plotting.plot_images({"rgb": rgb, "depth": depth})
    assert [[ax.get_title("left") for ax in row] for row in axes] == [
        ["rgb 0", "rgb 1"],
        ["depth", ""],
    ]
    assert np.allclose(
        axes[0, 1].images[0].get_array()[0, 5], gamma_encode(rgb[1, :, 0, 5]), atol=1e-6
    )
    assert np.allclose(
        axes[1, 0].images[0].get_array()[0], depth[0, 0, 0]
    )  # grey is not gamma encoded
    assert axes[1, 0].images[0].get_clim() == (0, 1) and not axes[1, 1].axison


@pytest.fixture
def words(monkeypatch):
    """Collects what is written: (area, words, colour)."""
    written, text = [], plotting.Area.text

    def spy(area, point, words, *args, **options):
        written.append((area, words, options.get("colour")))
        text(area, point, words, *args, **options)

    monkeypatch.setattr(plotting.Area, "text", spy)
    return written


def pixel(image, area, point):
    """Returns the colour of an image of the area's figure at a point of its data, in [0, 1]."""
    column, row = area.transform.transform(point)
    return image[len(image) - 1 - int(row), int(column)] / 255


def rgb_of(colour):
    return np.array(matplotlib.colors.to_rgb(colour))


def test_panels_per_agent_and_rows_per_camera(words, monkeypatch):
    """Three agents with two cameras: one strip per agent, one row of pixels per camera. A row's
    label has the colour of the camera's view on the plan, where agents are numbered.
    """
    cpu = scene.scenery([toys.column()], 3, device="cpu")
    c = core.Core(cpu, res=16, cameras=[0, 180])
    c.agents.positions[:] = torch.tensor([[2.0, 2.0], [5.0, 2.0], [2.0, 5.0]])
    figure, plan, strips = plotting.panels(3, n_cameras=2)
    state, rgb = numpyify(c.state(0)), modules.RGB(c).state(0).numpy()
    views = []

    def plot_view(ax, *where, colour):
        views.append((ax, plotting.view_polygon(*where), colour))

    with monkeypatch.context() as patched:
        patched.setattr(plotting, "plot_view", plot_view)
        core.Core.plot_state(state, plan)
    modules.RGB.plot_state(rgb, strips, state.yaws)
    ahead, behind = plotting.camera_colours(2)
    for a, (strip, view) in enumerate(zip(strips, rgb, strict=True)):
        labels = [(text, colour) for area, text, colour in words if area is strip.strip_label]
        assert [text for text, _ in labels] == [f"{a}", "rgb", "0°", "180°"]
        assert [colour for _, colour in labels[2:]] == [ahead, behind] and ahead != behind
        x0, y0, x1, y1 = np.round(strip.bbox.extents).astype(int)
        image = plotting.rasterise(figure)
        shown = image[len(image) - y1 : len(image) - y0, x0:x1] / 255
        for row, colours in enumerate(np.moveaxis(gamma_encode(view), 0, -1)):
            middles = shown[
                int((row + 0.5) / 2 * len(shown)),
                ((np.arange(16) + 0.5) / 16 * shown.shape[1]).astype(int),
            ]
            assert np.allclose(middles, colours, atol=0.003)
    assert np.ptp(rgb, axis=(0, 2)).min() > 0.01, "agents see different walls"
    assert [text for area, text, _ in words if area is plan][-3:] == ["0", "1", "2"]
    (_, ahead_view, colour_ahead), (_, behind_view, colour_behind) = views[:2]
    assert ahead_view[:, 0].min() >= 1.99 and behind_view[:, 0].max() <= 2.01  # of one at (2, 2)
    assert (colour_ahead, colour_behind) == (ahead, behind) and len(views) == 6


@pytest.mark.parametrize(
    ("shape", "transpose"),
    [((3, 1, 64), True), ((2, 64, 3), False), ((64,), False), ((64, 3), True)],
)
def test_bad_image_shapes_are_refused(shape, transpose):
    with pytest.raises(ValueError, match=r"image 'rgb' must have shape .*1 or 3 channels"):
        plotting.plot_images({"rgb": np.zeros(shape)}, transpose=transpose)


# ---- Plans ----


SQUARE = np.array([[[1, 1], [5, 1]], [[5, 1], [5, 5]], [[5, 5], [1, 5]], [[1, 5], [1, 1]]], float)
LIT = [np.ones((80, 3)) * [1.0, 0, 0] for _ in SQUARE]


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_floor_is_lighter_than_outside_and_walls_are_coloured(theme):
    with plotting.styled(theme=theme):
        figure, plan, _ = plotting.panels()
    plotting.plot_scenery(SQUARE, LIT, [[3, 3, 1]], ax=plan)
    image = plotting.rasterise(figure)
    inside, outside = (pixel(image, plan, point) for point in ((3, 3), (0.85, 3)))
    assert np.allclose(inside, rgb_of(plan.style.colours.floor), atol=0.003)
    assert (inside > outside + 0.05).all()
    wall = pixel(image, plan, (3, 1))
    assert wall[0] > 0.7 and wall[1] < 0.05


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_what_is_seen_later_is_drawn_over_what_is_kept(theme):
    """Frames of an episode, drawn one by one, equal those of a process that draws only the last."""

    def draw(n_seen, n_views):
        seen = [np.arange(80) < n_seen for _ in SQUARE]
        views = np.array([[[3, 3], [5, 3 + k], [5, 4 + k]] for k in (-2, -1, 0)], float)[:n_views]
        with plotting.styled(theme=theme):
            figure, plan, _ = plotting.panels()
        plotting.plot_scenery(SQUARE, LIT, [[3, 3, 1]], seen, plan, views)
        return plotting.rasterise(figure), plan

    plans._KEPT.clear()
    frames = [draw(10, 1), draw(10, 2), draw(60, 3), draw(5, 1)]
    assert len(plans._KEPT) == 1
    for (image, _), arguments in zip(frames, [(10, 1), (10, 2), (60, 3), (5, 1)]):
        plans._KEPT.clear()
        assert (draw(*arguments)[0] == image).all(), arguments
    image, plan = frames[2]
    theme = plan.style.colours
    assert np.allclose(pixel(image, plan, (4.5, 3.3)), rgb_of(theme.floor), atol=0.003)
    hatched = [pixel(image, plan, (1.5, y)) for y in np.linspace(2, 4, 200)]
    kinds = {tuple(np.round(colour, 2)) for colour in hatched}
    assert tuple(np.round(rgb_of(theme.unseen), 2)) in kinds and len(kinds) > 1
    assert np.allclose(pixel(image, plan, (4.9, 1)), rgb_of(theme.unseen_wall), atol=0.02)
    assert pixel(image, plan, (1.5, 1))[0] > 0.7


def test_view_reaches_each_hit_leftmost_ray_first():
    # Two rays, 90 degrees, facing +y: in the camera frame they point along (1, 1/2) and (1, -1/2),
    # and left of +y is -x.
    view = plotting.view_polygon((1, 1), 90, 90, distances=[5**0.5, np.inf], reach=2 * 5**0.5)
    assert np.allclose(view, [[1, 1], [0, 3], [3, 5]])


def test_agents_are_at_least_12_pixels_wide_in_their_colour():
    figure, plan, _ = plotting.panels()
    plan.fit(np.array([0.0, 0.0]), np.array([100.0, 100.0]))  # an agent would be a pixel wide
    plotting.plot_agent(plan, (50, 50), 0, 0.1, "#ff0000")
    image = plotting.rasterise(figure)
    column, row = plan.transform.transform((50, 50)).astype(int)
    across = image[len(image) - 1 - row - 8 : len(image) - 1 - row + 9, column]
    assert ((across[:, 0] > 200) & (across[:, 1] < 60)).sum() >= 12


def test_teams_outline_what_they_have_locked_and_hold_it_on_a_line():
    room = toys.box()
    c = core.Core(scene.scenery([room], 2, 1, device="cpu"))
    crate = modules.Crate(1, side=1.0, movable=True)
    crates = modules.Objects([room], c, {"a": crate, "b": crate}, colours=["ffffff"])
    c.agents.positions[:] = torch.tensor([[3.0, 2.0], [3.0, 5.0]])
    for name, x in (("a", 2.0), ("b", 5.0)):
        crates[name].positions[:] = torch.tensor([x, 4.0])
        crates[name].visible[:] = True
    crates["a"].lock(torch.ones(1, 1, dtype=torch.bool), 7)
    crates["b"].grab(torch.tensor([[[True], [False]]]))
    state = numpyify(c.state(0))
    state["teams"] = np.array([2, 0])
    figure, plan, _ = plotting.panels()
    core.Core.plot_state(state, plan)
    image = plotting.rasterise(figure)
    for colour, point in ((7, (1.5, 4.2)), (2, (4.0, 3.0)), (2, (4.8, 3.8))):
        expected = [int(plotting.AGENTS[colour][i : i + 2], 16) for i in (1, 3, 5)]
        column, row = plan.transform.transform(point).astype(int)
        near = image[len(image) - 4 - row : len(image) + 3 - row, column - 3 : column + 4]
        assert (np.abs(near - np.array(expected)).max(-1) < 8).any(), (colour, point)


# ---- Figures ----


def test_pictures_show_themselves_and_are_equal_files_each_time():
    with plotting.styled(dpi=50, title="Title"):
        figure, plan, _ = plotting.panels(title="step 3")
        plotting.plot_scenery(SQUARE, LIT, ax=plan)
    png = figure._repr_png_()
    shown = matplotlib.image.imread(io.BytesIO(png))
    assert shown.shape[:2] == (360, 320)
    assert np.abs(255 * shown[..., :3] - plotting.rasterise(figure)).max() < 1
    for ending, start in ("svg", b"<?xml"), ("pdf", b"%PDF"):
        content = plotting.encoded(figure, ending)
        assert content.startswith(start) and content == plotting.encoded(figure, ending)
    assert b"step 3" in plotting.encoded(figure, "svg"), "text stays text"


LAZY = """
import os, sys
import megastep
assert "torch" not in sys.modules and os.environ["OMP_WAIT_POLICY"] == "passive"
from megastep import core, modules, envs, plotting
assert not [name for name in sys.modules if name.startswith(("hydra", "megastep.agents"))]
from megastep.agents import api
from megastep.agents.cli import train
optional = "matplotlib", "tensorboard", "av", "IPython", "wandb", "loky", "megastep.adapters"
assert not {*optional} & {*sys.modules}, {*optional} & {*sys.modules}
"""


def test_the_simulator_imports_no_learner_and_training_no_optional_package():
    env = {key: text for key, text in os.environ.items() if key != "OMP_WAIT_POLICY"}
    subprocess.run([sys.executable, "-c", LAZY], env=env, check=True, timeout=300)
