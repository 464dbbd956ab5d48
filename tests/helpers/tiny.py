"""The smallest run, as words of the command line: an update takes milliseconds."""

import copy

from megastep.agents.cli.command import load
from megastep.agents.cli.compose import Composer

TINY = [
    "env=minimal",
    "geometry=box",
    "env.n_envs=4",
    "env.res=8",
    "learner.n_steps=8",
    "learner.n_minibatches=2",
    "agent.width=8",
    "logging.every=4",
    "device=cpu",
]
#: A small run with what a GPU brings: CUDA graphs, and a host that is updates ahead.
ON_GPU = [
    "env=explorer",
    "geometry=homes",
    "geometry.n=8",
    "env.n_envs=64",
    "agent.width=32",
    "learner.n_steps=8",
    "device=cuda",
]
SHORT_EPISODES = ["env.shortest=5", "env.longest=9"]
UPDATE = 4 * 8  # samples of one update
UPDATE_ON_GPU = 64 * 8


def settings(*words, script="train"):
    """Returns the settings that a script makes of words."""
    return Composer(load(script)).settings(words)


def changed(tree, key, value):
    """Returns a copy of nested dicts with another value of a dotted key."""
    tree = copy.deepcopy(tree)
    *groups, leaf = key.split(".")
    node = tree
    for group in groups:
        node = node[group]
    node[leaf] = value
    return tree
