"""Training runs: the loop (:mod:`trainer`), when it ends (:mod:`budget`), what it logs
(:mod:`episode_stats`, :mod:`loggers`), and callbacks. Knows learners and environments by their
protocols alone, and no command line.
"""
