#!/usr/bin/env bash
# Optuna 5.0.0: a trial whose score is infinite is complete, and is the best of a study to be maximised;
# one whose score is NaN has failed. A division by zero in a score wins the search, unless one checks.
# Seen: of 1, nan, inf and 2 the best value is inf, and only nan has failed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q optuna==5.0.0
"$folder/bin/python" -W ignore - <<'END'
import optuna

optuna.logging.set_verbosity(optuna.logging.ERROR)
scores = [1.0, float("nan"), float("inf"), 2.0]
study = optuna.create_study(direction="maximize")
study.optimize(lambda trial: scores[trial.number], n_trials=4)
states = [trial.state.name for trial in study.trials]
print(states, study.best_value)
assert states == ["COMPLETE", "FAIL", "COMPLETE", "COMPLETE"] and study.best_value == float("inf")
END
