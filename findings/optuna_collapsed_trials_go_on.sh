#!/usr/bin/env bash
# Optuna 5.0.0: pruners by the median compare a trial's best value so far, not its last one. A run that was good once,
# and has collapsed, is never stopped, however long it goes on; one that was never good is stopped at once.
# Seen: of five runs that rise to 0.9, the median is above one that falls from 0.95 to 0 at step 1, which completes;
# one that stays at 0.05 is pruned at step 1.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q optuna==5.0.0
"$folder/bin/python" -W ignore - <<'END'
import optuna

optuna.logging.set_verbosity(optuna.logging.ERROR)
CURVES = [[step / 10 for step in range(10)]] * 5 + [[0.95] + [0.0] * 9, [0.05] * 10]
study = optuna.create_study(direction="maximize", pruner=optuna.pruners.MedianPruner(n_startup_trials=3))


def objective(trial):
    for step, value in enumerate(CURVES[trial.number]):
        trial.report(value, step)
        if trial.should_prune():
            raise optuna.TrialPruned
    return value


study.optimize(objective, len(CURVES))
*_, collapsed, low = study.trials
print("collapsed:", collapsed.state.name, collapsed.last_step, "low:", low.state.name, low.last_step)
assert (collapsed.state.name, collapsed.last_step) == ("COMPLETE", 9)
assert (low.state.name, low.last_step) == ("PRUNED", 1)
END
