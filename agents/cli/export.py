"""megastep export run=RUN format=onnx: a trained agent for other runtimes, or in one file."""

from pathlib import Path

from megastep.agents import console
from megastep.agents.cli import plain_words
from megastep.agents.errors import UserError, user_errors
from megastep.agents.runs import folders
from megastep.settings import closest

HELP = """Writes a trained agent for use elsewhere.

  megastep export run=RUN format=onnx           one step for ONNX runtimes: policy.onnx
  megastep export run=RUN format=torch          the same for torch.export.load: policy.pt2
  megastep export run=RUN format=safetensors    an agent file with its card: agent.safetensors
  megastep export run=RUN format=hub            a folder for the Hugging Face Hub: hub/
  ... file=my_agent.onnx                        this file or folder instead of one in RUN

run= takes a run, one of its checkpoints, latest, or a packaged agent."""
#: The formats, and the file or folder of each.
FORMATS = {
    "onnx": "policy.onnx",
    "torch": "policy.pt2",
    "safetensors": "agent.safetensors",
    "hub": "hub",
}


def main(words: list[str]) -> int:
    """Exports as the words of a command line ask for. Returns the exit code."""
    if not words or words[0] in ("-h", "--help"):
        console.say(HELP)
        return 0 if words else 2
    given = plain_words.parse(words, {"run": False, "format": False, "file": False})
    for key, cure in {"run": "latest takes the newest run", "format": ", ".join(FORMATS)}.items():
        if key not in given:
            raise UserError(f"{key} is missing; {key}={cure}")
    run, kind = given["run"][0], given["format"][0]
    if kind not in FORMATS:
        raise UserError(f"format: {kind!r} is unknown; {closest(kind, FORMATS)}")
    path = folders.find(run)
    default, suffix = folders.folder_of(path) / FORMATS[kind], Path(FORMATS[kind]).suffix
    file = Path(given["file"][0]) if "file" in given else default
    if suffix and file.suffix != suffix:
        raise UserError(f"file={file} must end with {suffix} for format={kind}")
    run_export(run, kind, file)
    return 0


def run_export(run: str, kind: str, file: Path) -> None:
    """Writes `file` and says what was written."""
    from megastep.agents import pretrained  # with PyTorch
    from megastep.agents.export import agent, hub, runtimes
    from megastep.agents.export.step import Step

    if kind == "safetensors":
        for path in agent.write(run, file):
            console.say(f"Wrote {path}")
        return
    policy, env = pretrained.load_with_env(run, "cpu", films=kind == "hub")
    name = folders.name_of(folders.find(run))
    if kind == "hub":
        for path in hub.write(run, file, name, policy, env):
            console.say(f"Wrote {path}")
        return
    with user_errors(f"{file} cannot be written: "):
        file.parent.mkdir(parents=True, exist_ok=True)
    step = Step(policy, env.obs_space)
    write, runner = {
        "onnx": (runtimes.write_onnx, runtimes.run_onnx),
        "torch": (runtimes.write_torch, runtimes.run_torch),
    }[kind]
    with user_errors(f"{file} cannot be written: ", (OSError,)):
        write(step, file, name)
    found = runtimes.compare(step, runner(file), policy, env)
    runtimes.check(file, found)
    console.say(
        f"Wrote {file}: {', '.join(port.name for port in step.inputs)} -> "
        f"{', '.join(port.name for port in step.outputs)}; in 1,000 steps its numbers differ from "
        f"the policy's by at most {found.difference:.1g}"
    )
