"""Bots: what can play or walk without learning.

Each is a policy (:class:`megastep.types.Policy`). All but random actions know the truth about the
environment that they are made for, such as its floor plans and their own pose, so they are
opponents and baselines, not competitors.
"""

#: Import paths by the short names that `against=` and `opponents.bot_class=` take.
BOTS = {
    "explorer": "megastep.agents.selfplay.bots.walker:Explorer",
    "hunter": "megastep.agents.selfplay.bots.walker:Hunter",
    "mapper": "megastep.agents.selfplay.bots.seekers:Mapper",
    "oracle": "megastep.agents.selfplay.bots.seekers:Oracle",
    "random": "megastep.agents.selfplay.bots.random:RandomActions",
    "runner": "megastep.agents.selfplay.bots.walker:Runner",
    "walker": "megastep.agents.selfplay.bots.walker:Walker",
    "wanderer": "megastep.agents.selfplay.bots.seekers:Wanderer",
}
