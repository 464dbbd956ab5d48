"""Training with the plain form of fused operations."""

import json
import subprocess
import sys

import pytest
import train_plain
from records import ROOT

TINY = "experiment=deathmatch geometry=box env.n_envs=8 seconds=null finish.record=false"


def test_an_unknown_part_is_refused(capsys):
    assert train_plain.main(["lstm,head"]) == 2
    assert "unknown part 'head'. Available: " in capsys.readouterr().err
    assert train_plain.chosen("all") and train_plain.chosen("none") == []


@pytest.mark.nightly
def test_plain_parts_learn_the_same(tmp_path):
    losses = {}
    for word in ("none", "all"):
        command = [sys.executable, ROOT / "scripts" / "train_plain.py", word, *TINY.split()]
        command += ["samples=4096", "logging.every=1", f"folder={tmp_path / word}", "device=cpu"]
        subprocess.run(command, check=True, capture_output=True, cwd=tmp_path)
        (report, *_) = (tmp_path / word / "metrics.jsonl").read_text().splitlines()
        losses[word] = {k: v for k, v in json.loads(report).items() if k.startswith("loss/")}
    assert losses["none"]["loss/grad_norm"] > 0
    assert losses["all"] == pytest.approx(losses["none"], rel=1e-3, abs=1e-5)
