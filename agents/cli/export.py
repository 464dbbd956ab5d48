"""megastep export run=RUN format=onnx: a trained agent for other runtimes, or in one file."""

from pathlib import Path
from typing import Literal

from megastep.agents import console
from megastep.agents.cli.command import Command, with_member
from megastep.agents.errors import UserError
from megastep.agents.factory import settings
from megastep.agents.runs import folders

HELP = """Writes a trained agent for use elsewhere.

  megastep export run=RUN format=onnx           one step for ONNX runtimes: policy.onnx
  megastep export run=RUN format=torch          the same for torch.export.load: policy.pt2
  megastep export run=RUN format=safetensors    an agent file, and its card: agent.md
  ... file=my_agent.onnx                        this file instead of one in RUN
  ... member=3                                  an agent of a population; without it, the best

run= takes a run, one of its checkpoints, latest, or a packaged agent."""
#: The formats, and the file of each.
FORMATS = {"onnx": "policy.onnx", "torch": "policy.pt2", "safetensors": "agent.safetensors"}


def run(
    run: str,
    format: Literal["onnx", "torch", "safetensors"],
    file: str | None = None,
    member: settings.PopulationMember = None,
) -> Path:
    """Writes an agent's file, and says what was written. Returns its path."""
    run = with_member({"run": run, "member": member}, "run")["run"]
    source, suffix = folders.find(run), Path(FORMATS[format]).suffix
    path = folders.folder_of(source) / FORMATS[format] if file is None else Path(file)
    if path.suffix != suffix:
        raise UserError(f"file={path} must end with {suffix} for format={format}")
    from megastep.agents.export import agent, runtimes  # with PyTorch

    if format == "safetensors":
        agent.write(run, path)
        console.say(f"Wrote {path} and its card, {path.with_suffix('.md')}")
    else:
        console.say(f"Wrote {path}: {runtimes.write(source, path)}")
    return path


COMMAND = Command("export", run, HELP)
main = COMMAND.main
