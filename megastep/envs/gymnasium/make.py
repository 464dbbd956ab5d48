"""Makes Gymnasium's vector environments, and says in one sentence why one cannot be made."""

import difflib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from megastep.agents.imports import import_object

__all__ = ["seeds", "vector_env"]

INSTALL = "pip install 'megastep-flatland[gymnasium]'"


def vector_env(
    id: str | None,
    n_envs: int,
    kwargs: Mapping[str, Any],
    wrappers: Sequence[str],
    vectorization: str,
) -> Any:
    """Returns a vector environment that resets an ended environment in the step after its end.

    Args are those of :class:`~megastep.envs.gymnasium.env.Gymnasium`.

    Raises:
        ValueError: saying what is wrong, and what would do.
    """
    try:
        import gymnasium
    except ImportError:
        raise ValueError(
            f"env=gymnasium needs Gymnasium, which is not installed: {INSTALL}"
        ) from None
    spec = _spec(id)
    return gymnasium.make_vec(
        spec,
        n_envs,
        "sync",
        dict(copy=False),
        [import_object(name) for name in wrappers],
        **{"disable_env_checker": True, **kwargs},
    )


def _spec(id):
    import gymnasium

    if id is None:
        raise ValueError("env.id is missing: name an environment, such as env.id=CartPole-v1")
    try:
        return gymnasium.envs.registration._find_spec(id)
    except gymnasium.error.Error:
        near = difflib.get_close_matches(id, gymnasium.registry, 1)
        raise ValueError(f"Gymnasium has no environment {id}; {near}") from None


def seeds(seed: int, n_envs: int, vectorization: str) -> list[int]:
    """Returns a seed for each environment."""
    return np.random.SeedSequence(seed).generate_state(n_envs).tolist()
