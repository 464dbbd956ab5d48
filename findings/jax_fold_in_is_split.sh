#!/usr/bin/env bash
# JAX 0.10.2: `fold_in(key, i)` is `split(key, n)[i]`. Who splits a key for networks and environments, and folds the
# number of each step into it for noise, has the first steps draw what initialised the networks, under other names.
# `jax_debug_key_reuse` finds nothing if `fold_in` comes first, since it may be called often with one key. It has been
# so since `jax_threefry_partitionable` is the default; without it the two differ. Neither's documentation says it.
# Seen: both of two keys of a split are those with 0 and 1 folded in; without the flag none is.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder"
"$folder/bin/pip" install -q jax==0.10.2 jaxlib==0.10.2 numpy==2.2.6
"$folder/bin/python" -W ignore - <<'END'
import jax


def compared():
    key = jax.random.key(3)
    noise = [jax.random.normal(jax.random.fold_in(key, step), (2,)).tolist() for step in range(2)]
    weights = [jax.random.normal(part, (2,)).tolist() for part in jax.random.split(key)]
    print("noise of two steps:", noise, "weights from two parts:", weights)
    return [a == b for a, b in zip(noise, weights)]


jax.config.update("jax_debug_key_reuse", True)
assert compared() == [True, True]
jax.config.update("jax_threefry_partitionable", False)
assert compared() == [False, False]
END
