"""A folder as the Hugging Face Hub has models of reinforcement learning: a card whose head is YAML,
the settings, the agent's file, and a film.
"""

import json
import shutil
from pathlib import Path

import yaml

from megastep import recording
from megastep.agents import console
from megastep.agents.errors import UserError, user_errors
from megastep.agents.export import agent
from megastep.agents.factory import settings
from megastep.agents.networks.policy import Policy
from megastep.agents.runs import agent_file, folders
from megastep.types import Env

#: Frames of the film.
N_STEPS = 400


def write(run: str, folder: Path, name: str, policy: Policy, env: Env) -> list[Path]:
    """Writes the folder. Returns its files.

    Args:
        run: a run, or a packaged agent.
        folder: empty, or does not exist.
        name: of the agent.
        policy, env: what is filmed.

    Raises:
        UserError: the folder is not empty; or as `agent.write`.
    """
    if folder.exists() and any(folder.iterdir()):
        raise UserError(f"The folder {folder} is not empty; choose another with file=")
    path, file = folders.find(run), folder / "agent.safetensors"
    with user_errors(f"{folder} cannot be written: "):
        folder.mkdir(parents=True, exist_ok=True)
        if agent_file.is_agent_file(path):
            shutil.copyfile(path, file)
    if not file.exists():
        agent.write(run, file)
    about = agent_file.read_metadata(file)
    film = folder / "replay.mp4"
    with console.warned("The card has no film: "), user_errors(kinds=(Exception,)):
        recording.film(env, policy, film, N_STEPS)
    text = agent.card(file).replace("# agent\n", f"# {name}\n", 1)
    head = yaml.safe_dump(front_matter(about, name), sort_keys=False)
    with user_errors(f"{folder} cannot be written: "):
        (folder / "README.md").write_text(f"---\n{head}---\n{text}\n{agent.default_words(about)}")
        (folder / "config.json").write_text(json.dumps(about["config"], indent=1))
        file.with_suffix(".md").unlink(missing_ok=True)
    return sorted(folder.iterdir())


def front_matter(about: dict, name: str) -> dict:
    """Returns the head of the card: tags, and the agent's results as `model-index`."""
    train = about["config"]["train"]
    env = train["env"].get("id") or settings.label(train["env"]["name"])
    results = []
    for table in about["tables"]:
        for row in (row for row in table["rows"] if "return" in row and "trained" in row["agent"]):
            value = f"{row['return']:.2f} +/- {(row['upper'] - row['lower']) / 2:.2f}"
            where = f", {row['source']}" if "source" in row else ""
            results.append(
                {
                    "task": {"type": "reinforcement-learning", "name": "reinforcement-learning"},
                    "dataset": {"type": env, "name": f"{env}{where}"},
                    "metrics": [{"type": "mean_reward", "value": value, "name": "mean_reward"}],
                }
            )
    index = [{"name": name, "results": results}] if results else []
    return {
        "library_name": "megastep",
        "pipeline_tag": "reinforcement-learning",
        "tags": ["reinforcement-learning", "deep-reinforcement-learning", "megastep", env],
        **({"model-index": index} if index else {}),
    }
