"""Datasets that `megastep dump` writes, and what reads them back."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import megastep
from megastep import colour, data
from megastep.agents.cli import dump
from megastep.agents.evaluation import dumping
from megastep.agents.generator import stream_seed
from megastep.agents.storage import collector
from megastep.data import episodes
from tests.helpers import faults

MAZE = ["env=memory", "geometry=memory_maze", "geometry.n=6", "env.res=64", "env.subsample=1"]
HOMES = ["env=pointgoal", "geometry=box", "env.res=16", "env.subsample=1"]
TOLD = ("agent_pos", "agent_dir", "targets_pos", "targets_vec", "target_pos", "target_vec")


def dumped(folder, *words, bot="random", n=10):
    words = [f"bot={bot}", f"episodes={n}", f"folder={folder}", "device=cpu", *words]
    assert dump.main(words) == 0
    return folder


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.glob("*.npz")}


@pytest.fixture
def few(monkeypatch):
    """Four lanes a wave, and rollouts shorter than an episode."""
    monkeypatch.setattr(dumping, "LANES", 4)
    monkeypatch.setattr(dumping, "STEPS", 8)


@pytest.fixture(scope="module")
def mazes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mazes") / "data"
    return dumped(folder, *MAZE, "max_steps=70", "truth=true", bot="walker", n=3)


def test_keys_and_shapes_are_those_of_memory_maze(mazes):
    arrays, n = np.load(mazes / "episode-000000.npz"), 71
    assert {name: (array.shape, array.dtype.kind) for name, array in arrays.items()} == {
        "image": ((n, 1, 64, 3), "u"),
        "action": ((n, 7), "u"),
        "reward": ((n,), "f"),
        "maze_layout": ((n, 9, 9), "u"),
        "agent_pos": ((n, 2), "f"),
        "agent_dir": ((n, 2), "f"),
        "targets_pos": ((n, 3, 2), "f"),
        "targets_vec": ((n, 3, 2), "f"),
        "target_pos": ((n, 2), "f"),
        "target_vec": ((n, 2), "f"),
        "target_color": ((n, 3), "f"),
        # and ours
        "d": ((n, 1, 1, 64), "f"),
        "imu": ((n, 3), "f"),
        "terminal": ((n,), "b"),
        "truncated": ((n,), "b"),
        "walls": ((len(arrays["walls"]), 2, 2), "f"),
        "maze_frame": ((3,), "f"),
    }
    assert not arrays["action"][0].any() and (arrays["action"][1:].sum(1) == 1).all()
    assert arrays["truncated"].tolist() == [False] * 70 + [True]


def test_truth_is_in_cells_of_the_maze(mazes):
    for one in data.load(mazes):
        floor = one["maze_layout"][0].bool()
        for name in "agent_pos", "targets_pos":
            x, y = one[name].floor().long().unbind(-1)
            assert floor[y, x].all(), name
        x, y = one["agent_dir"][:, None].unbind(-1)
        ahead, left = one["targets_vec"].unbind(-1)
        offset = torch.stack([x * ahead - y * left, y * ahead + x * left], -1)
        # float32, of up to 9 cells
        torch.testing.assert_close(
            one["agent_pos"][:, None] + offset, one["targets_pos"], atol=1e-4, rtol=0
        )
        distances = (one["targets_pos"] - one["target_pos"][:, None]).norm(dim=-1)
        assert (distances.min(1).values == 0).all()
    corner, cell = one["maze_frame"][:2], one["maze_frame"][2]
    ends = (one["walls"] - corner) / cell
    assert (ends - ends.round()).abs().max() < 1e-3, "walls are along cells"


def test_pictures_that_are_no_light_are_stored_as_they_are(few, tmp_path):
    folder = dumped(
        tmp_path / "data", "env=minigrid", "env.id=MiniGrid-Empty-5x5-v0", "seed=5", n=4
    )
    env = megastep.make("minigrid", id="MiniGrid-Empty-5x5-v0", n_envs=4, device="cpu")
    first = env.reset(seed=stream_seed(5, "wave 0")).obs.image
    for lane, one in enumerate(data.load(folder)):
        assert torch.equal(one.obs.image[0], first[lane]) and len(one.obs.image) > len(one.reward)


def test_an_environment_repeats_the_episodes(few, tmp_path):
    """Replayed by hand from the seed, an environment gives the stored rows."""
    folder = dumped(tmp_path / "data", *HOMES, "env.limit=30", "seed=5", n=8)
    where = dict(geometry="box", res=16, subsample=1, limit=30, resample=True, device="cpu")
    env = megastep.make("pointgoal", n_envs=4, seed=5, **where)
    for wave in range(2):
        stored = [data.load(folder)[4 * wave + lane] for lane in range(4)]
        files = [np.load(folder / f"episode-{4 * wave + lane:06d}.npz") for lane in range(4)]
        world, most = env.reset(seed=stream_seed(5, f"wave {wave}")), 0
        for t in range(31):
            for lane, (one, file) in enumerate(zip(stored, files)):
                n = len(one.reward)
                most = max(most, n)
                if t > n:
                    continue
                for name in "d", "imu", "goal":
                    assert torch.equal(one.obs[name][t], world.obs[name][lane]), (t, name)
                light = world.obs.rgb[lane, 0].permute(1, 2, 0).double().numpy()
                assert (file["image"][t] == np.round(255 * colour.gamma_encode(light))).all()
                # a step of 8-bit sRGB is at most 0.9 % of full light
                assert (one.obs.rgb[t] - world.obs.rgb[lane]).abs().max() < 0.0046
                if t:
                    assert one.reward[t - 1] == world.reward[lane]
                    assert one.terminal[t - 1] == world.terminal[lane]
                    assert one.truncated[t - 1] == world.truncated[lane]
                    assert (t == n) == bool(world.terminal[lane] | world.truncated[lane])
            actions = [one.actions[min(t, len(one.actions) - 1)] for one in stored]
            world = env.step({"actions": torch.stack(actions)})
        assert most == 30


def test_a_stopped_dump_goes_on_to_the_same_bytes(few, tmp_path, monkeypatch):
    words = *HOMES, "max_steps=20", "truth=true"
    whole = contents(dumped(tmp_path / "whole", *words))
    assert len(whole) == 10 and len({*whole.values()}) == 10
    write, n_written = episodes.write, 0

    def killed(path, arrays):
        nonlocal n_written
        n_written += 1
        if n_written == 6:
            path.with_suffix(".tmp").write_bytes(b"half")
            raise KeyboardInterrupt
        write(path, arrays)

    monkeypatch.setattr(episodes, "write", killed)
    monkeypatch.setattr(dumping, "WRITERS", 1)
    folder = tmp_path / "stopped"
    words = ["bot=random", "episodes=10", f"folder={folder}", "device=cpu", *words]
    with pytest.raises(KeyboardInterrupt):
        dump.main(words)
    assert len(contents(folder)) == 5
    with pytest.raises(data.DatasetError, match="5 of 10 episodes; repeat its megastep dump"):
        data.load(folder)
    monkeypatch.setattr(episodes, "write", write)
    assert dump.main(words) == 0
    assert contents(folder) == whole and not [*folder.glob("*.tmp")]
    assert (
        contents(dumped(tmp_path / "other", *words[4:], "seed=2")).items().isdisjoint(whole.items())
    )


def test_a_single_lane_keeps_all_its_steps(tmp_path, monkeypatch):
    words, found = [*HOMES, "max_steps=20"], []
    for steps in 8, 32:
        monkeypatch.setattr(dumping, "STEPS", steps)
        found.append(contents(dumped(tmp_path / f"{steps}", *words, n=1)))
    assert found[0] == found[1]


def test_environments_of_others_repeat_their_waves(few, tmp_path):
    """Those without seeded resets are made anew for each wave."""
    words = "env=gymnasium", "env.id=CartPole-v1"
    pair = [dumped(tmp_path / name, *words, n=6) for name in ("one", "other")]
    assert contents(pair[0]) == contents(pair[1]) and len({*contents(pair[0]).values()}) == 6
    for one in data.load(pair[0]):
        assert one.obs.shape == (len(one.reward) + 1, 1, 4) and one.terminal[-1]
        assert (one.reward == 1).all() and one.obs[-1].abs().max() > 0.2  # radians, or metres


def test_a_trained_agent_plays_its_own_environment(few, tmp_path):
    words = "run=pointgoal_anywhere", "episodes=4", "device=cpu", "geometry=box", "greedy=true"
    assert dump.main([*words, f"folder={tmp_path / 'data'}"]) == 0
    stored = data.load(tmp_path / "data")
    assert all(one.terminal[-1] for one in stored), "in a box it always reaches its goal"
    batch = data.pad([*stored])
    n = [len(one.reward) for one in stored]
    assert batch.valid.sum(0).tolist() == n and batch.obs.d.shape[:2] == (max(n) + 1, 4)
    assert torch.equal(batch.actions[: n[1], 1], stored[1].actions)
    assert not batch.reward[n[1] :, 1].any()


def test_what_a_bot_remembers_is_on_the_device(few, tmp_path, monkeypatch):
    """While it plays, a tensor that is made on no device in particular is one without data."""

    def inside(function):
        def call(*args):
            with torch.device("meta"):
                return function(*args)

        return call

    for name in "initial_actor_state", "collect":
        monkeypatch.setattr(collector, name, inside(getattr(collector, name)))
    dumped(tmp_path / "data", "env=explorer", "geometry=box", "max_steps=9", bot="explorer", n=2)


@pytest.mark.cuda
@pytest.mark.parametrize("player", ["run=memory_9", "bot=explorer"])
def test_graphs_have_the_bytes_of_single_steps(player, few, tmp_path, monkeypatch):
    words = "env=memory", "geometry=memory_maze", "geometry.n=6", "max_steps=40", "truth=true"
    words = [player, "episodes=10", "device=cuda", *words]
    assert dump.main([*words, f"folder={tmp_path / 'graphs'}"]) == 0
    monkeypatch.setattr(collector, "capture_with", lambda env, policies, function, **_: function)
    assert dump.main([*words, f"folder={tmp_path / 'steps'}"]) == 0
    assert contents(tmp_path / "graphs") == contents(tmp_path / "steps")


def test_a_full_disk_is_one_sentence(few, tmp_path, capsys, monkeypatch):
    folder = tmp_path / "data"
    words = ["bot=random", "episodes=8", f"folder={folder}", "device=cpu", *HOMES, "max_steps=20"]
    with faults.full_disk(3_000):  # an episode is larger
        assert dump.main(words) == 2
    assert not folder.exists() or not [*folder.iterdir()]
    write, n_written = episodes.write, 0

    def full(path, arrays):
        nonlocal n_written
        n_written += 1
        if n_written > 5:
            raise OSError(28, "No space left on device")
        write(path, arrays)

    monkeypatch.setattr(episodes, "write", full)
    assert dump.main(words) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.endswith("as the disk is full: make room, and repeat the command to go on")
    assert 4 <= len(contents(folder)) <= 5 and not [*folder.glob("*.tmp")]
    monkeypatch.setattr(episodes, "write", write)
    assert dump.main(words) == 0 and len(data.load(folder)) == 8


@pytest.mark.parametrize(
    ("words", "sentence"),
    {
        ("format=hdf5",): "'hdf5' is unknown; there are lerobot, minari, npz",
        ("bot=null",): "run: or bot= is needed, one of both",
        ("env=null",): "env: is missing; bot=random env=explorer says where the bot plays",
        ("folder=null",): "folder: is missing; folder=FOLDER is a new folder",
        ("folder={other}",): "has other files; choose a new folder",
        ("folder={strange}",): "was written by another program; give a folder that megastep dump",
        ("folder={old}", "seed=2"): "settings.seed is 1 and not 2; choose a new folder",
        ("episodes=3",): "3 episodes need about 0.0 GB, and the disk of ",
        ("bot=oracle",): "PointGoal has no cue",
        ("env=pong", "truth=true"): "Pong has no method truth(); leave it out",
    }.items(),
)
def test_bad_words_are_one_sentence(words, sentence, few, tmp_path, capsys, monkeypatch):
    old = dumped(tmp_path / "old", *HOMES, "max_steps=3", n=2)
    for name in "other", "strange":
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text("x")
    (tmp_path / "strange" / "dataset.json").write_text('{"writer": "somebody"}')
    words = [
        word.format(old=old, **{n: tmp_path / n for n in ("other", "strange")}) for word in words
    ]
    rest = [f"folder={tmp_path / 'new'}", "bot=random", "episodes=2", "max_steps=3", "device=cpu"]
    keys = {word.partition("=")[0] for word in words}
    words += [word for word in [*rest, *HOMES] if word.partition("=")[0] not in keys]
    if "episodes=3" in words:
        monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(9, 8, 1))
    if not keys.isdisjoint({"env"}):
        words = [word for word in words if not word.startswith(("env.", "geometry"))]
    assert dump.main(words) == 2
    assert sentence in capsys.readouterr().err
    assert not (tmp_path / "new").exists() or not [*(tmp_path / "new").iterdir()]


def test_load_refuses_what_is_no_dataset(mazes, tmp_path):
    with pytest.raises(data.DatasetError, match="does not exist; give a folder"):
        data.load(tmp_path / "absent")
    with pytest.raises(data.DatasetError, match="has no dataset.json; give a folder"):
        data.load(tmp_path)
    np.savez(tmp_path / "a.npz", image=np.zeros(3))
    (tmp_path / "dataset.json").write_text("[]")
    with pytest.raises(data.DatasetError, match="cannot be read"):
        data.load(tmp_path)


@pytest.mark.parametrize("kept", [slice(100), slice(-30), slice(5_000, 5_001)])
def test_a_damaged_file_is_one_sentence(kept, mazes, tmp_path):
    folder = shutil.copytree(mazes, tmp_path / "data")
    path = folder / "episode-000001.npz"
    whole = path.read_bytes()
    flipped = whole[:5_000] + bytes([whole[5_000] ^ 1]) + whole[5_001:]
    path.write_bytes(whole[kept] if kept.start is None else flipped)
    with pytest.raises(data.DatasetError, match="episode-000001.npz is damaged"):
        data.load(folder)[1]


# ---- Other formats ----


@pytest.fixture(params=[HOMES, [*HOMES, "env.control=continuous"]], ids=["discrete", "continuous"])
def twice(request, tmp_path, monkeypatch):
    """Returns a function of a format, which dumps the same as npz and in that format."""

    def both(format):
        words = *request.param, "max_steps=12", "truth=true"
        npz = dumped(tmp_path / "npz", *words, n=3)
        monkeypatch.chdir(tmp_path)
        other = dumped(Path(format), *words, f"format={format}", n=3)  # as it is typed
        before = sorted(path.stat().st_mtime_ns for path in other.rglob("*") if path.is_file())
        dumped(other, *words, f"format={format}", n=3)  # is there already
        assert before == sorted(p.stat().st_mtime_ns for p in other.rglob("*") if p.is_file())
        return [np.load(path) for path in data.load(npz).files], other.resolve()

    return both


def test_minari_reads_every_array(twice, monkeypatch):
    minari = pytest.importorskip("minari")
    files, folder = twice("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    dataset = minari.load_dataset("pointgoal_random-v0")
    assert dataset.total_episodes == 3
    for one, file in zip(dataset.iterate_episodes(), files, strict=True):
        for name in "image", "d", "imu", "goal":
            assert np.array_equal(one.observations[name], file[name]), name
            assert dataset.observation_space[name].contains(one.observations[name][0])
        for ours, theirs in ("reward", "rewards"), ("terminal", "terminations"):
            assert np.array_equal(getattr(one, theirs), file[ours][1:])
        assert np.array_equal(one.truncations, file["truncated"][1:])
        action, own = one.actions, file["action"][1:]
        assert np.array_equal(action, own if own.dtype == np.float32 else own.argmax(1))
        assert dataset.action_space.contains(action[0])
        assert np.array_equal(one.infos["agent_pos"], file["agent_pos"])
        assert np.array_equal(one.infos["walls"], file["walls"])


def test_an_episode_begins_where_its_agent_joins(tmp_path):
    words = "env=pettingzoo", "env.id=tests.helpers.odd_envs:Joins"
    first, second = data.load(dumped(tmp_path / "npz", *words, n=2))
    assert first.reward.tolist() == [1, 2, 3, 4, 5] and first.obs.flatten().tolist() == [*range(6)]
    assert second.reward.tolist() == [3, 4, 5] and second.obs.flatten().tolist() == [2, 3, 4, 5]
    assert second.truncated.tolist() == [False, False, True] and second.actions.shape == (3, 1)
    row = np.load(tmp_path / "npz" / "episode-000001.npz")["action"]
    assert row.sum(1).tolist() == [0, 1, 1, 1]


def test_one_observation_without_a_name_and_a_dict_of_one_action(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    words = "env=gymnasium", "env.id=tests.helpers.odd_envs:OddOneKey-v0"
    one = data.load(dumped(tmp_path / "npz", *words, n=2))
    file = np.load(one.files[0])
    assert {"obs", "action.press"} < {*file} and file["obs"].tolist() == [[t] for t in range(11)]
    assert one[0].obs.shape == (11, 1, 1) and one[0].actions.press.shape == (10, 1)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    dumped(tmp_path / "minari", *words, "format=minari", n=2)
    theirs = minari.load_dataset("gymnasium_random-v0")[0]
    assert np.array_equal(theirs.observations["obs"], file["obs"])
    presses = theirs.actions["action.press"]
    assert np.array_equal(presses, file["action.press"][1:].argmax(1))


def test_lerobot_has_half_frames_a_second_and_statistics_of_each_episode(tmp_path, few):
    pandas = pytest.importorskip("pandas")
    parquet = pytest.importorskip("pyarrow.parquet")
    words = *HOMES, "env.fps=2.5", "max_steps=7"
    npz, folder = dumped(tmp_path / "npz", *words), tmp_path / "lerobot"
    dumped(folder, *words, "format=lerobot")
    files = [np.load(path) for path in data.load(npz).files]
    frames = pandas.read_parquet(folder / "data")
    assert np.allclose(frames.timestamp, frames.frame_index / 2.5)
    assert json.loads((folder / "meta/info.json").read_text())["fps"] == 2.5
    rows = parquet.read_table(folder / "meta/episodes").to_pylist()
    whole = json.loads((folder / "meta/stats.json").read_text())
    for name, scale in ("imu", 1), ("image", 255):
        numbers = [file[name] / scale for file in files]
        assert whole[f"observation.{name}"]["count"] == [sum(map(len, numbers))]  # no pixels
        numbers = [one.reshape(-1, one.shape[-1]) for one in numbers]
        mean = np.ravel(whole[f"observation.{name}"]["mean"])
        assert np.allclose(mean, np.concatenate(numbers).mean(0, np.float64))
        for i in (0, 9):  # LeRobot computes from these what is left after delete_episodes
            assert rows[i][f"stats/observation.{name}/count"] == [len(files[i]["reward"])]
            for key in "min", "max", "mean", "std":
                own = np.ravel(rows[i][f"stats/observation.{name}/{key}"])
                assert np.allclose(own, getattr(numbers[i].astype(np.float64), key)(0)), key


READ = """
import sys, numpy, torch
# torchvision's operators are not there without its own build of torch, and are not used
library = torch.library.Library("torchvision", "DEF")
for name in "nms", "qnms":
    library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
from lerobot.datasets.lerobot_dataset import LeRobotDataset
dataset = LeRobotDataset("local/dataset", root=sys.argv[1])
rows = [dataset[i] for i in range(len(dataset))]
assert rows[0]["task"] == "pointgoal_random" and dataset.fps == 10
keys = [key for key in rows[0] if isinstance(rows[0][key], torch.Tensor)]
arrays = {key: torch.stack([row[key] for row in rows]).numpy() for key in keys}
pair = LeRobotDataset("local/dataset", root=sys.argv[1], delta_timestamps={"action": [0, 0.1]})
arrays["pair"] = torch.stack([pair[i]["action"] for i in range(3)]).numpy()
arrays |= {f"mean {key}": value["mean"] for key, value in dataset.meta.stats.items()}
from lerobot.datasets.dataset_tools import delete_episodes
fewer = delete_episodes(dataset, [1], output_dir="fewer", repo_id="local/fewer")
arrays |= {f"fewer {key}": value["mean"] for key, value in fewer.meta.stats.items()}
numpy.savez(sys.argv[2], **arrays)
"""
#: LeRobot's own requirements, without torch, which is this environment's.
LEROBOT = """lerobot==0.4.4 torchvision datasets>=4,<5 huggingface-hub<0.36 jsonlines einops
draccus==0.10.0 termcolor deepdiff orderly-set dill multiprocess xxhash fsspec httpx httpcore h11
anyio sniffio requests urllib3 idna certifi charset-normalizer tqdm mergedeep pyyaml-include toml
typing-inspect mypy-extensions av<16 hf-xet aiohttp aiosignal aiohappyeyeballs frozenlist multidict
yarl propcache attrs accelerate>=1.10,<2 psutil pandas pyarrow python-dateutil six pytz"""


@pytest.fixture(scope="module")
def lerobot(tmp_path_factory):
    """Python with LeRobot: an environment of its own, which sees the packages of this one."""
    pytest.importorskip("pyarrow")  # which writes the files, as pandas does
    if python := os.environ.get("LEROBOT_PYTHON"):
        return python
    base = tmp_path_factory.mktemp("lerobot") / "venv"
    subprocess.run([sys.executable, "-m", "venv", base], check=True)
    (packages,) = base.glob("lib/python*/site-packages")
    (packages / "outside.pth").write_text(os.path.dirname(os.path.dirname(torch.__file__)))
    pip = [base / "bin/python", "-m", "pip", "install", "-q", "--no-deps", *LEROBOT.split()]
    if (done := subprocess.run(pip, capture_output=True, text=True)).returncode:
        pytest.skip(f"LeRobot cannot be installed here: {done.stderr[-200:]}")
    return str(base / "bin/python")


@pytest.mark.nightly
def test_lerobot_reads_every_array(twice, lerobot, tmp_path):
    files, folder = twice("lerobot")
    env = dict(os.environ, HF_HUB_OFFLINE="1", HF_HOME=str(tmp_path / "hf"), PYTHONPATH="")
    subprocess.run(
        [lerobot, "-c", READ, folder, tmp_path / "read.npz"], check=True, env=env, cwd=tmp_path
    )
    read = np.load(tmp_path / "read.npz")
    images = np.concatenate([file["image"] for file in files])
    assert np.array_equal(np.round(255 * read["observation.image"]).transpose(0, 2, 3, 1), images)
    for name in "d", "imu", "goal":
        rows = np.concatenate([file[name].reshape(len(file[name]), -1) for file in files])
        assert np.array_equal(read[f"observation.{name}"], rows.astype(np.float32))
        # float32 and float64, and LeRobot's file has all digits
        assert np.allclose(read[f"mean observation.{name}"], rows.mean(0, np.float64), atol=1e-6)
        fewer = rows[np.r_[:13, 26:39]].mean(0, np.float64)
        assert np.allclose(read[f"fewer observation.{name}"], fewer, atol=1e-6)
    for name, key in ("action", "action"), ("reward", "next.reward"), ("truncated", "next.done"):
        rows = [np.concatenate([file[name][1:], 0 * file[name][:1]]) for file in files]
        assert np.array_equal(read[key], np.concatenate(rows)), name
    assert np.array_equal(read["truth.agent_pos"], np.concatenate([f["agent_pos"] for f in files]))
    assert np.array_equal(read["pair"][:, 1], read["action"][1:4])
    assert read["frame_index"].tolist() == [*range(13)] * 3
    assert np.array_equal(read["index"], np.arange(39))
