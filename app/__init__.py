"""What train.py, evaluate.py and record.py share: the command line (the only place that knows Hydra), settings, run folders."""
