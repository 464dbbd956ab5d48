"""Benchmarks of populations: a tiny run."""

import populations
import pytest
import torch


@pytest.mark.nightly
def test_rates_are_sums_over_members(monkeypatch):
    monkeypatch.setattr(populations, "MEMBERS", {"cpu": (2, 16, 16)})
    one, several, share = populations.members(torch.device("cpu"), seconds=4)
    assert "one run" in one["what"] and "2 members in sum" in several["what"]
    assert share["value"] == pytest.approx(100 * several["value"] / one["value"])
