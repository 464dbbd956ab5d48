"""Self-play: opponents that are past snapshots of the policy or a scripted bot (:mod:`opponents`),
several policies in one environment (:mod:`mixed_policy`), duels of two policies (:mod:`duels`), and
ratings computed from duels (:mod:`ratings`). Works in any environment with at least two agents.
"""
