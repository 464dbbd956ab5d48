"""Training runs: the loop (:mod:`trainer`), when it ends (:mod:`budget`), what it logs
(:mod:`episode_stats`, :mod:`loggers`, :mod:`curves`), its checkpoints (:mod:`checkpoint`,
:mod:`saver`), and the evaluation of a trained policy (:mod:`evaluation`). Knows learners and
environments by their protocols alone, and no command line.
"""
