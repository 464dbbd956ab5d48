"""What a checkpoint becomes: a policy that acts, weights to learn from, wrappers' state."""

from typing import TYPE_CHECKING, cast

import torch

from megastep import spaces
from megastep.agents.errors import UserError, user_errors
from megastep.agents.networks.policy import TRAINING_ONLY, Policy, share_threads
from megastep.types import Env, optional

if TYPE_CHECKING:
    from megastep.agents.runs.checkpoint import Checkpoint


def policy_of(
    loaded: "Checkpoint",
    env: Env | None = None,
    device: torch.device | str = "cpu",
    critic: str | None = None,
) -> Policy:
    """Returns the policy of a checkpoint, for an environment or on a device; with a kind of
    `critic`, or to act alone. On a CPU this sets PyTorch's threads, as training does. UserError.
    """
    device = torch.device(device if env is None else env.device)
    settings = loaded.config["train"]["agent"]
    kinds = (ValueError, TypeError, KeyError, RuntimeError)
    with user_errors(f"{loaded.path} cannot be used: ", kinds):
        texts = loaded.config["spaces"]
        tree = spaces.nested({name: spaces.from_text(text) for name, text in texts.items()})
        if device.type == "cpu":
            share_threads(settings["width"])
        seen = tree["obs"], tree["actions"], optional(env, "privileged_space") if env else None
        policy = Policy(*seen, **{**settings, "critic": critic}).to(device)
    return load_weights(policy, loaded, env).requires_grad_(False)


def load_weights(policy: Policy, loaded: "Checkpoint", env: Env | None = None) -> Policy:
    """Returns a policy with a checkpoint's weights. UserError if weights or spaces do not fit."""
    saved, present = loaded.config["spaces"], {} if env is None else spaces.texts(env)
    if present and (names := [k for k in {**present, **saved} if saved.get(k) != present.get(k)]):
        changes = [
            f"{k} was {saved.get(k, 'missing')} and is {present.get(k, 'missing')}" for k in names
        ]
        ids = loaded.config["train"]["env"].get("id"), getattr(env, "id", None)
        of_ids = f", {ids[0]} and not {ids[1]}" if ids[0] != ids[1] else ""
        raise UserError(
            f"{loaded.path} was trained in another environment{of_ids}: {'; '.join(changes)}. "
            "Choose the env it was trained in"
        )
    agent = " ".join(f"agent.{k}={v}" for k, v in loaded.config["train"]["agent"].items())
    kinds = (AttributeError, KeyError, TypeError, RuntimeError)
    with user_errors(f"{loaded.path} needs an agent with {agent}: ", kinds):
        weights = cast("dict", loaded.state)["policy"]
        of_training = {k: v for k, v in weights.items() if k.startswith(TRAINING_ONLY)}
        if policy.critic is None:
            weights = {k: v for k, v in weights.items() if k not in of_training}
        elif not of_training:
            weights = policy.state_dict() | weights
        policy.load_state_dict(weights)
    return policy


def load_wrappers(env: Env, loaded: "Checkpoint", is_frozen: bool = True) -> None:
    """Gives an environment's wrappers what a checkpoint's have learnt. UserError if others."""
    if state := (loaded.state or {}).get("wrappers"):
        load = optional(env, "load_wrapper_state")
        with user_errors(f"{loaded.path} cannot be used here: "):
            if load is None:
                raise ValueError(f"{type(env).__name__} has no load_wrapper_state")
            load(state, is_frozen)
