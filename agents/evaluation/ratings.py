"""Ratings of players from the results of their duels.

Uses the Plackett-Luce model of Weng and Lin (JMLR 12, 2011) from the package openskill. A rating is
a mean, which starts at 25, and a standard deviation for its uncertainty. A player rated 5.9 higher
wins 73 % of the duels, a player rated 1 higher 54 %.
"""

import io
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from megastep.agents import console
from megastep.agents.distributed import process_group
from megastep.agents.errors import UserError, user_errors
from megastep.agents.evaluation import tables
from megastep.agents.evaluation.duels import Duels
from megastep.agents.runs import checkpoint, folders
from megastep.atomic_files import write_atomically

if TYPE_CHECKING:
    from megastep.agents.types import Row

#: Number of orders that ratings are averaged over.
N_ORDERS = 10

#: Scores of player i in duels with player j, by (i, j): 1 won, 0 lost, 0.5 a draw.
Scores = Mapping[tuple[int, int], Sequence[float]]


def write(duels: Duels, labels: tables.Labels) -> Path:
    """Rates the run's snapshots, or else its checkpoints, and those of `cfg.against`, by duels of
    each with each. Prints a table, writes ratings.csv and ratings.svg into the run's folder, and
    returns the path of the first.
    """
    folder, players = folders.folder_of(duels.run.path), []
    for path in (
        checkpoint.list_checkpoints(folder / "snapshots")
        or checkpoint.list_checkpoints(folder / "checkpoints")
        or [duels.run.path]  # the file of an agent
    ):
        try:
            player = duels.player(str(path))
        except UserError:
            if path.exists():
                raise
            continue  # its run, which is training, has deleted it
        players.append(player._replace(name=f"{player.step:,} samples"))
    players += duels.others
    if len(players) < 2:
        raise UserError(
            f"{folder} has one checkpoint and nothing to compare it with: train with "
            "checkpoints.snapshots=8, or name others with against="
        )
    played = {
        (i, j): duels.play(players[i], players[j])
        for i, j in itertools.combinations(range(len(players)), 2)
    }
    if process_group.rank() > 0:
        return folder
    scores = {pair: one["score"].tolist() for pair, one in played.items()}
    table = rows([(player.name, player.step) for player in players], scores, duels.cfg.seed)
    layouts, what = played[0, 1].get("homes"), f"{duels.where.shard.n_envs:,} duels of each pair"
    n_homes = None if layouts is None else len(layouts.unique())
    title = f"Ratings in {labels.title(what, n_homes)}, seed {duels.cfg.seed}"
    cells = [[form.format_map(row) for form in tables.RATINGS.values()] for row in table]
    console.say(f"{title}\n{console.table([*tables.RATINGS], cells)}")
    with user_errors(f"{folder} cannot be written: "):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(folder / "ratings.csv", tables.as_csv(table, [*table[0]]).encode())
        write_atomically(folder / "ratings.svg", _plot(table, title))
    console.say(f"Plot: {folder / 'ratings.svg'}")
    return folder / "ratings.csv"


def rate(n_players: int, scores: Scores, seed: int = 1) -> list[tuple[float, float]]:
    """Returns the rating (mean, standard deviation) of each player.

    The model updates ratings duel by duel, so they depend on the order of the duels. The result is
    the mean over `N_ORDERS` random orders.
    """
    duels = [(i, j, score) for (i, j), values in scores.items() for score in values]
    generator = np.random.default_rng(seed)
    orders = [generator.permutation(len(duels)) for _ in range(N_ORDERS)]
    ratings = [_rate_in_order(n_players, [duels[k] for k in order]) for order in orders]
    return [(float(mean), float(sigma)) for mean, sigma in np.mean(ratings, 0)]


def _rate_in_order(n_players, duels) -> list[tuple[float, float]]:
    from openskill.models import PlackettLuce

    model = PlackettLuce(tau=0.0)  # the strength of a player does not drift between duels
    players = [model.rating() for _ in range(n_players)]
    for i, j, score in duels:
        [players[i]], [players[j]] = model.rate(
            [[players[i]], [players[j]]], scores=[score, 1 - score]
        )
    return [(player.mu, player.sigma) for player in players]


def rows(players: Sequence[tuple[str, int | None]], scores: Scores, seed: int = 1) -> "list[Row]":
    """Returns a table row per player: rating, fraction of duels won (a draw is half), and duels.

    Args:
        players: (name, samples it was trained on, or None) of each player.
    """
    ratings = rate(len(players), scores, seed)
    table = []
    for k, ((name, samples), (mean, sigma)) in enumerate(zip(players, ratings, strict=True)):
        results = [score for (i, _), values in scores.items() if i == k for score in values]
        results += [1 - score for (_, j), values in scores.items() if j == k for score in values]
        table.append(
            dict(
                player=name,
                samples=samples,
                rating=mean,
                sigma=sigma,
                won=sum(results) / len(results),
                duels=len(results),
            )
        )
    return table


def _plot(table, title) -> bytes:
    """Returns an SVG of ratings over samples with two standard deviations. Players without samples
    are horizontal lines.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    trained = [row for row in table if row["samples"] is not None]
    untrained = [row for row in table if row["samples"] is None]
    samples, means, sigmas = (
        np.array([row[key] for row in trained], float) for key in ("samples", "rating", "sigma")
    )
    axes.errorbar(samples, means, 2 * sigmas, marker="o", capsize=3, label="the run")
    for i, row in enumerate(untrained):
        axes.axhline(row["rating"], color=f"C{i + 1}", linestyle="--", label=row["player"])
    axes.set(title=title, xlabel="samples", ylabel="rating ± two standard deviations")
    axes.grid(alpha=0.3)
    axes.legend()
    image = io.BytesIO()
    figure.savefig(image, format="svg", metadata={"Date": None})
    return image.getvalue()
