"""The environments of agents, with floor plans of a test's own."""

from megastep.agents.factory import make as factory
from megastep.agents.factory import settings
from megastep.agents.runs import folders, restore


def env_of(name, geometries=(), seed=1, **changes):
    """Returns an environment with the settings that an agent was trained with, on the CPU, and with
    what wrappers had learnt then.
    """
    loaded = folders.load_checkpoint(folders.find(name), False, "cpu")
    chosen = settings.changed(factory.config_of(loaded).env, **changes)
    env = factory.construct(chosen, geometries=[*geometries], seed=seed, device="cpu")
    restore.load_wrappers(env, loaded)
    return env
