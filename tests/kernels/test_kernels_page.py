"""docs/kernels.md: its files are a library, and its Python code launches it."""

import re

import torch

from tests.helpers import pages


def test_example_of_page_runs(tmp_path, monkeypatch, device):
    text = (pages.ROOT / "docs" / "kernels.md").read_text()
    (tmp_path / "kernels").mkdir()
    for name, body in re.findall(r"```cpp\n// (\S+)\n(.*?)```", text, re.S):
        (tmp_path / name).write_text(body)
    module, use = pages.code(text)
    (tmp_path / "battery.py").write_text(module)
    expected = torch.tensor([1.0, 0.99, 0.98, 0.0])
    names = {}
    with pages.inside(tmp_path, monkeypatch):
        exec(compile(use, "docs/kernels.md", "exec"), names)
    torch.testing.assert_close(names["charge"], expected)

    charge = torch.ones(4, device=device)
    names["drain"](charge, torch.tensor([0.0, 1.0, 2.0, 200.0], device=device))
    torch.testing.assert_close(charge.cpu(), expected)
