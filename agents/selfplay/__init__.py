"""Self-play: opponents that are past snapshots of the policy or a scripted bot (:mod:`opponents`),
several policies in one environment (:mod:`mixed_policy`), and bots (:mod:`bots`), which also walk
alone. All but bots works in any environment with at least two agents.
"""
