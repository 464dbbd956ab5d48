"""What train.py, evaluate.py and record.py share: command line (alone in knowing Hydra), settings, runs."""
