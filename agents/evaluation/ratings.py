"""Ratings of players from the results of their duels.

Uses the Plackett-Luce model of Weng and Lin (JMLR 12, 2011) from the package openskill. A rating is
a mean, which starts at 25, and a standard deviation for its uncertainty. A player rated 5.9 higher
wins 73 % of the duels, a player rated 1 higher 54 %.
"""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from megastep.agents import console
from megastep.agents.distributed import process_group
from megastep.agents.errors import UserError
from megastep.agents.evaluation import tables
from megastep.agents.evaluation.eval_env import EvalEnv
from megastep.agents.factory import settings
from megastep.agents.runs import checkpoint, folders

#: Number of orders that ratings are averaged over.
N_ORDERS = 10

#: Scores of player i in duels with player j, by (i, j): 1 won, 0 lost, 0.5 a draw.
Scores = Mapping[tuple[int, int], Sequence[float]]

#: Columns of the table, and the forms of their numbers.
COLUMNS = dict(player="", rating=".2f", sigma=".2f", won=".3f", duels="")


def write(
    cfg: settings.Evaluate, run: checkpoint.Checkpoint, where: EvalEnv, geometry: settings.Geometry
) -> Path:
    """Rates a run's snapshots, and others, by duels of each with each; writes ratings.csv."""
    folder, players = folders.folder_of(run.path), []
    for path in (
        checkpoint.list_checkpoints(folder / "snapshots")
        or checkpoint.list_checkpoints(folder / "checkpoints")
        or [run.path]  # the file of an agent
    ):
        try:
            (player,) = where.players([str(path)], run, cfg.trust)
        except UserError:
            if path.exists():
                raise
            continue  # its run, which is training, has deleted it
        players.append(player._replace(name=f"{player.step:,} samples"))
    players += where.players(cfg.against or (), run, cfg.trust)
    if len(players) < 2:
        raise UserError(
            f"{folder} has one checkpoint and nothing to compare it with: train with "
            "checkpoints.snapshots=8, or name others with against="
        )
    where.warn_without_layout()
    pairs = [*itertools.combinations(range(len(players)), 2)]
    played = {(i, j): where.duel(cfg, run, players[i], players[j]) for i, j in pairs}
    if process_group.rank() > 0:
        return folder
    scores = {pair: one["score"].tolist() for pair, one in played.items()}
    table = []
    for k, (mean, sigma) in enumerate(rate(len(players), scores, cfg.seed)):
        results = [score for (i, _), values in scores.items() if i == k for score in values]
        results += [1 - score for (_, j), values in scores.items() if j == k for score in values]
        about = dict(player=players[k].name, samples=players[k].step, rating=mean, sigma=sigma)
        table.append(about | dict(won=sum(results) / len(results), duels=len(results)))
    layouts, what = played[0, 1].get("homes"), f"{where.shard.n_envs:,} duels of each pair"
    n_homes = None if layouts is None else len(layouts.unique())
    title = tables.title_of(where, geometry, cfg.split, what, n_homes)
    title = f"Ratings in {title}, seed {cfg.seed}"
    cells = [[format(row[name], form) for name, form in COLUMNS.items()] for row in table]
    console.say(f"{title}\n{console.table([*COLUMNS], cells)}")
    rows = [[*row.values()] for row in table]
    folders.write({folder / "ratings.csv": console.as_csv([*table[0]], rows)})
    return folder / "ratings.csv"


def rate(n_players: int, scores: Scores, seed: int = 1) -> list[tuple[float, float]]:
    """Returns (mean, standard deviation) of each player's rating, over random orders of duels."""
    from openskill.models import PlackettLuce

    duels = [(i, j, score) for (i, j), values in scores.items() for score in values]
    generator, model = np.random.default_rng(seed), PlackettLuce(tau=0.0)  # strengths do not drift
    ratings = []
    for _ in range(N_ORDERS):
        players = [model.rating() for _ in range(n_players)]
        for k in generator.permutation(len(duels)):
            i, j, score = duels[k]
            [players[i]], [players[j]] = model.rate(
                [[players[i]], [players[j]]], scores=[score, 1 - score]
            )
        ratings.append([(player.mu, player.sigma) for player in players])
    return [(float(mean), float(sigma)) for mean, sigma in np.mean(ratings, 0)]
