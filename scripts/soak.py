"""Disturbs runs at random, resumes them, and compares them with the same runs left alone.

    python scripts/soak.py --minutes 10 --seed 1

Each round trains one small configuration on the CPU twice. The second run gets signals and kill -9
at random moments, a full disk, and flipped bits and missing bytes in its newest checkpoint. In the
end its metrics.jsonl must be equal byte for byte, and every leaf of its last checkpoint but the
times, and no process may have printed a traceback or ended with another status than its signal's.
Prints what differs and exits with 1 if anything does.
"""

import argparse
import contextlib
import itertools
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from torch.utils._pytree import tree_flatten_with_path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from megastep.agents.runs import checkpoint

ROOT = Path(__file__).resolve().parents[1]
WORDS = "device=cpu env.n_envs=4 agent.width=8 learner.n_steps=8 logging.every=1"
WORDS += " checkpoints.seconds=0.05"
MINIMAL = "env=minimal geometry=box env.res=8"
PONG = "env=pong env.self_play=true opponents.past=0.5 opponents.snapshots=2 opponents.every=10"
REPLAY = "learner.gradient_steps=2 learner.replay.capacity=400 learner.replay.burn_in=4"
CONFIGURATIONS = {
    "PPO": f"{MINIMAL} learner=ppo learner.n_minibatches=2",
    "V-trace": f"{MINIMAL} learner=vtrace learner.n_minibatches=2",
    "R2D2": f"{MINIMAL} learner=r2d2 {REPLAY}",
    "PPO, against its past": f"{PONG} learner=ppo learner.n_minibatches=2",
}
SIGNALS = {"SIGINT": 130, "SIGTERM": 143, "SIGHUP": 129, "SIGKILL": -9}
FAULTS = (*SIGNALS, "full disk", "flipped bit", "missing bytes")
#: Bytes that a file may have on the full disk: less than a checkpoint or metrics.jsonl has.
FULL = 1000
#: Leaves of a checkpoint that measure time.
TIMES = {"seconds"}
#: Seconds after which a process hangs: a hundred times what it needs.
HUNG = 1200


def start(words, is_disk_full=False):
    """Starts train.py."""

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (FULL, FULL))

    return subprocess.Popen(
        [sys.executable, str(ROOT / "train.py"), *words],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        preexec_fn=limit if is_disk_full else None,
    )


def end(process, allowed):
    """Waits for a process. Returns its status, or raises if that or its output is wrong."""
    try:
        _, error = process.communicate(timeout=HUNG)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise AssertionError("a process hangs") from None
    if process.returncode not in allowed or "Traceback" in error:
        raise AssertionError(f"a process ended with {process.returncode}: {error[-3000:]}")
    return process.returncode


def damage(path, fault, draw):
    """Flips a bit of a file, or cuts off its end."""
    content = bytearray(path.read_bytes())
    if fault == "flipped bit":
        content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
    else:
        del content[draw.randrange(len(content)) :]
    path.write_bytes(content)


def disturb(words, folder, samples, seconds, draw, deadline):
    """Trains with faults at random moments, each within `seconds` of a process's start, then to the
    end. Returns the faults.
    """
    faults = []
    for n_left in itertools.count(draw.randint(6, 15), -1):
        fault = draw.choice(FAULTS) if n_left > 0 and time.monotonic() < deadline else None
        saved = checkpoint.list_checkpoints(folder / "checkpoints")
        if not saved:
            shutil.rmtree(folder, ignore_errors=True)
        case = [f"resume={folder}"] if saved else [*words, f"folder={folder}"]
        if fault in ("flipped bit", "missing bytes"):
            if len(saved) < 2:  # without another, nothing is left to resume
                continue
            damage(draw.choice(sorted(saved[-1].iterdir())), fault, draw)
        process, number = start(case, fault == "full disk"), None
        if fault:
            number = signal.Signals[fault if fault in SIGNALS else draw.choice([*SIGNALS])]
            faults.append(fault if fault in SIGNALS else f"{fault}, then {number.name}")
        try:
            process.wait(draw.uniform(0, seconds) if fault else HUNG)
        except subprocess.TimeoutExpired:
            process.send_signal(number) if number else None
        # on a full disk the run cannot begin, or ends without its last checkpoint
        # a signal may come before Python handles it
        allowed = {0, SIGNALS[number.name], -number} if number else {0}
        status = end(process, allowed | ({1, 2} if fault == "full disk" else set()))
        if status == 0 or is_spent(folder, samples):
            return faults


def is_spent(folder, samples):
    """Returns whether a run's last checkpoint has its whole budget, after a signal at its end."""
    saved = checkpoint.list_checkpoints(folder / "checkpoints")
    with contextlib.suppress(checkpoint.CheckpointError):
        return bool(saved) and checkpoint.load_latest(saved[-1], None).step >= samples
    return False


def differences(expected, actual):
    """Yields what differs between two run folders, as sentences."""
    rows, other_rows = ((folder / "metrics.jsonl").read_bytes() for folder in (expected, actual))
    if rows != other_rows:
        pairs = itertools.zip_longest(rows.splitlines(), other_rows.splitlines())
        numbers = [n for n, (row, other) in enumerate(pairs, 1) if row != other]
        yield f"metrics.jsonl differs in {len(numbers)} lines, the first is {numbers[0]}"
    leaves, other_leaves = (
        {
            ".".join(str(getattr(part, "key", getattr(part, "idx", part))) for part in path): leaf
            for path, leaf in tree_flatten_with_path(
                checkpoint.load_latest(folder / "checkpoints").state
            )[0]
        }
        for folder in (expected, actual)
    )
    paths = [
        path
        for path in sorted({*leaves, *other_leaves})
        if path.rpartition(".")[2] not in TIMES
        and not is_equal(leaves.get(path), other_leaves.get(path))
    ]
    if paths:
        yield f"{len(paths)} leaves of the last checkpoint differ, such as {', '.join(paths[:5])}"


def is_equal(leaf, other):
    if torch.is_tensor(leaf) and torch.is_tensor(other):
        return torch.equal(leaf, other)
    return type(leaf) is type(other) and leaf == other


def soak(minutes, seed, samples, folder):
    """Runs rounds. Returns the number of differences."""
    deadline, draw, n_differences = time.monotonic() + 60 * minutes, random.Random(seed), 0
    for n, name in enumerate(itertools.cycle(CONFIGURATIONS)):
        if time.monotonic() > deadline:
            return n_differences
        words = [*WORDS.split(), *CONFIGURATIONS[name].split(), f"samples={samples}"]
        words.append(f"seed={draw.randrange(1000)}")
        alone, disturbed = (folder / f"{n}-{kind}" for kind in ("alone", "disturbed"))
        before = time.monotonic()
        end(start([*words, f"folder={alone}"]), {0})
        faults = disturb(words, disturbed, samples, time.monotonic() - before, draw, deadline)
        found = list(differences(alone, disturbed))
        print(f"{name}, {len(faults)} faults ({'; '.join(faults)}):", flush=True)
        print(*(found or ["equal"]), sep="\n", flush=True)
        n_differences += len(found)


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=10, help="start no round after so many")
    parser.add_argument("--seed", type=int, default=1, help="of the faults")
    parser.add_argument("--samples", type=int, default=10_000, help="budget of a run")
    parser.add_argument("--folder", type=Path, help="for the runs; by default a temporary one")
    options = parser.parse_args(arguments)
    if options.folder:
        return soak(options.minutes, options.seed, options.samples, options.folder.resolve()) > 0
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        return soak(options.minutes, options.seed, options.samples, Path(folder)) > 0


if __name__ == "__main__":
    sys.exit(main())
