"""Plots: the sRGB curve, images, floor plans, figures."""

import subprocess
import sys

import matplotlib
import numpy as np
import pytest
import torch

from megastep import core, modules, plotting, scene, toys
from megastep.arrdict import numpyify
from megastep.plotting import gamma_decode, gamma_encode

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


def test_gamma_of_arrays_and_tensors_agree_and_keep_the_dtype():
    light = np.linspace(-0.1, 1.5, 101, dtype=np.float32)
    for f in (gamma_encode, gamma_decode):
        assert f(light).dtype == np.float32 and f(torch.tensor(light)).dtype == torch.float32
        assert np.abs(f(light) - f(torch.tensor(light)).numpy()).max() < 1e-6
        assert f(torch.tensor(light).half()).dtype == torch.float16
        assert (
            f(np.array([0, 1])).tolist()
            == f(torch.tensor([0, 1])).round(decimals=6).tolist()
            == [0, 1]
        )


def test_core_exports_gamma_encode_and_decode():
    assert core.gamma_encode is gamma_encode and core.gamma_decode is gamma_decode


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


def test_images_are_drawn_on_given_axes():
    figure, _, strips = plotting.panels(2)
    axes = plotting.plot_images(
        {"rgb": np.zeros((1, 3, 1, 8)), "d": np.zeros((1, 1, 1, 8), np.float16)}, axes=strips
    )
    assert list(axes[:, 0]) == strips and all(ax.figure is figure for ax in strips)


def test_panels_per_agent_and_rows_per_camera():
    """Three agents with two cameras: one strip per agent, one row of pixels per camera. A row's
    label has the colour of the camera's view on the plan, where agents are numbered.
    """
    cpu = scene.scenery([toys.column()], 3, device="cpu")
    c = core.Core(cpu, res=16, cameras=[0, 180])
    c.agents.positions[:] = torch.tensor([[2.0, 2.0], [5.0, 2.0], [2.0, 5.0]])
    figure, plan, strips = plotting.panels(3, n_cameras=2)
    state, rgb = numpyify(c.state(0)), modules.RGB(c).state(0).numpy()
    core.Core.plot_state(state, plan)
    modules.RGB.plot_state(rgb, strips, state.yaws)
    assert [ax.get_title("left") for ax in strips] == ["rgb 0", "rgb 1", "rgb 2"]
    for strip, image in zip(strips, rgb, strict=True):
        pixels = strip.images[0].get_array()
        assert np.allclose(pixels, gamma_encode(image.transpose(1, 2, 0)), atol=1e-6)
        assert [label.get_text() for label in strip.get_yticklabels()] == ["0°", "180°"]
        assert strip.get_box_aspect() == 2 * plotting.STRIP
    assert np.ptp(rgb, axis=(0, 2)).min() > 0.01, "agents see different walls"
    assert [(note.get_text(), list(note.xy)) for note in plan.texts] == [
        ("0", [2, 2]),
        ("1", [5, 2]),
        ("2", [2, 5]),
    ]
    views = [matplotlib.colors.to_rgb(patch.get_facecolor()) for patch in plan.patches]
    ahead, behind = (patch.get_xy()[:, 0] for patch in plan.patches[:2])  # of an agent at (2, 2)
    assert ahead.min() >= 1.99 and behind.max() <= 2.01
    labels = [matplotlib.colors.to_rgb(t.get_color()) for t in strips[0].get_yticklabels()]
    assert views == 3 * labels and labels[0] != labels[1]


def test_single_camera_has_no_label_and_single_agent_no_number():
    c = core.Core(scene.scenery([toys.box()], 1, device="cpu"), res=8)
    figure, plan, strips = plotting.panels(1)
    core.Core.plot_state(numpyify(c.state(0)), plan)
    modules.Depth.plot_state(modules.Depth(c).state(0).numpy(), strips, c.agents.yaws)
    assert not plan.texts and not strips[0].get_yticklabels()
    assert strips[0].get_box_aspect() == plotting.STRIP


@pytest.mark.parametrize(
    ("shape", "transpose"),
    [((3, 1, 64), True), ((2, 64, 3), False), ((64,), False), ((64, 3), True)],
)
def test_bad_image_shapes_are_refused(shape, transpose):
    with pytest.raises(ValueError, match=r"image 'rgb' must have shape .*1 or 3 channels"):
        plotting.plot_images({"rgb": np.zeros(shape)}, transpose=transpose)


@pytest.mark.parametrize("images", [{}, {"rgb": np.zeros((0, 3, 1, 8))}])
def test_no_images_are_refused(images):
    with pytest.raises(ValueError, match="no images"):
        plotting.plot_images(images)


# ---- Plans ----

LINES = np.array([[[1, 1], [3, 1]], [[3, 1], [3, 5]]], np.float32)
COLOURS = [np.array([[0.1, 0, 0], [0, 0.2, 0]]), np.array([[0, 0, 0.3]])]


def test_lines_are_drawn_texel_by_texel_in_lit_colours(ax):
    drawn = plotting.plot_lines(ax, LINES, COLOURS, exposure=2.0)
    assert np.allclose(drawn.get_segments(), [[[1, 1], [2, 1]], [[2, 1], [3, 1]], [[3, 1], [3, 5]]])
    assert np.allclose(drawn.get_colors()[:, :3], gamma_encode(2 * np.concatenate(COLOURS)))


def test_bars_are_grouped_by_name(ax):
    drawn = plotting.plot_bars(("turn", "ahead"), [[0.5, -1], [0, 1]], ax)
    assert drawn is ax and [bar.get_height() for bar in ax.patches] == [0.5, -1, 0, 1]
    assert [bar.get_x() for bar in ax.patches] == pytest.approx([-0.4, 0.6, 0, 1])
    assert [label.get_text() for label in ax.get_xticklabels()] == ["turn", "ahead"]
    assert plotting.plot_bars(("turn",), [0.5]).figure is not ax.figure


def test_unseen_texels_are_faint(ax):
    drawn = plotting.plot_lines(ax, LINES, COLOURS, seen=[[True, False], [True]])
    full = plotting.plot_lines(ax, LINES, COLOURS)
    contrast = np.abs(
        np.array([lines.get_colors()[:, :3] - plotting.BACKGROUND for lines in (drawn, full)])
    )
    assert np.allclose(contrast[0] / contrast[1], np.array([1, plotting.UNSEEN, 1])[:, None])


def test_no_lines(ax):
    assert len(plotting.plot_lines(ax, np.zeros((0, 2, 2)), []).get_segments()) == 0


def test_lines_without_colours_are_refused(ax):
    with pytest.raises(ValueError, match="2 lines and 1 arrays"):
        plotting.plot_lines(ax, LINES, COLOURS[:1])


def test_plan_is_to_scale_and_shows_everything():
    ax = plotting.plot_scenery(LINES, COLOURS, lights=np.array([[2.0, 3.0, 1.0]]))
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_aspect()) == ("x, m", "y, m", 1)
    ax.figure.canvas.draw()
    (left, right), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    assert left < 1 and right > 3 and bottom < 1 and top > 5
    assert [2, 3] in [list(offset) for part in ax.collections for offset in part.get_offsets()]


def test_pixels_have_the_colour_of_their_wall():
    figure, plan, _ = plotting.panels()
    plotting.plot_scenery(LINES, [np.array([[1.0, 0, 0]]), np.array([[0, 1.0, 0]])], ax=plan)
    image = plotting.rasterise(figure)

    def pixel(x, y):
        column, row = plan.transData.transform((x, y))
        return image[len(image) - 1 - int(row), int(column)].tolist()

    assert pixel(2, 1) == [255, 0, 0] and pixel(3, 3) == [0, 255, 0]
    assert pixel(2, 3) == 3 * [round(255 * plotting.BACKGROUND)]


def test_view_reaches_each_hit_leftmost_ray_first(ax):
    # Two rays, 90 degrees, facing +y: in the camera frame they point along (1, 1/2) and (1, -1/2),
    # and left of +y is -x.
    patch = plotting.plot_view(ax, (1, 1), 90, 90, distances=[5**0.5, np.inf], reach=2 * 5**0.5)
    assert np.allclose(patch.get_xy()[:3], [[1, 1], [0, 3], [3, 5]])


def test_view_without_distances_is_a_wedge(ax):
    rim = plotting.plot_view(ax, (0, 0), 0, 60, reach=2.0).get_xy()[1:-1]
    assert np.allclose(np.linalg.norm(rim, axis=1), 2)
    degrees = np.degrees(np.arctan2(rim[:, 1], rim[:, 0]))
    assert 28 < degrees[0] < 30 and -30 < degrees[-1] < -28 and (np.diff(degrees) < 0).all()


# ---- Figures ----


def test_panels_do_not_overlap_and_are_unknown_to_pyplot():
    from matplotlib import pyplot

    figure, plan, strips = plotting.panels(3, title="a title")
    assert pyplot.get_fignums() == [] and len(strips) == 3 and plan.get_title() == "a title"
    bottoms = [ax.get_position().y0 for ax in (plan, *strips)]
    tops = [ax.get_position().y1 for ax in (plan, *strips)]
    assert all(top < bottom for top, bottom in zip(tops[1:], bottoms)) and bottoms[-1] > 0
    assert tops[0] < 1
    height, width, channels = plotting.rasterise(figure).shape
    assert (width, channels) == (600, 3) and abs(height - 100 * figure.get_figheight()) < 1


def test_rasterise_keeps_a_pyplot_figure_open():
    from matplotlib import pyplot

    figure = pyplot.figure(figsize=(2, 1), dpi=50, facecolor="r")
    assert (plotting.rasterise(figure) == [255, 0, 0]).all()
    assert plotting.rasterise(figure).shape == (50, 100, 3)
    assert pyplot.fignum_exists(figure.number)


def test_importing_the_simulator_and_training_imports_no_optional_package():
    code = (
        "import sys; import megastep; assert 'torch' not in sys.modules; "
        "from megastep import core, modules, envs, plotting; "
        "assert 'hydra' not in sys.modules; "
        "from megastep.agents.cli import train; "
        "print([m for m in ('matplotlib', 'tensorboard', 'av', 'IPython', 'wandb', 'loky') if m in "
        "sys.modules])"
    )
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert process.stdout == "[]\n", process.stderr
