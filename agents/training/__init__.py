"""Training runs: the loop (:mod:`trainer`), when it ends (:mod:`budget`), what it logs
(:mod:`episode_stats`, :mod:`loggers`), and what is done about NaN
(:mod:`callbacks`). Knows learners and environments by their protocols alone, and no command
line. Files of runs are in :mod:`megastep.agents.runs`, evaluation in
:mod:`megastep.agents.evaluation`.
"""
