"""Ratings of players by what came of their duels: the Plackett-Luce model of Weng and Lin (JMLR 12,
2011), by the package openskill.

A rating is a mean, 25 for whoever has not played, and a standard deviation of what is not known
about it; a player 5.9 above another wins 73 % of their duels, one 1 above 54 %.
"""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from megastep.agents.training import atomic_files

#: In how many orders the same duels are taken.
ORDERS = 10


def rate(
    n_players: int, scores: Mapping[tuple[int, int], Sequence[float]], seed: int = 1
) -> list[tuple[float, float]]:
    """(mean, standard deviation) of each player. `scores[i, j]` are those of player i in duels with
    player j, 1 won, 0 lost, 0.5 a draw. The model takes them one by one, so ratings depend on their
    order: these are means over `ORDERS` of them, drawn from `seed`.
    """
    games = [(i, j, score) for (i, j), row in scores.items() for score in row]
    random = np.random.default_rng(seed)
    orders = [random.permutation(len(games)) for _ in range(ORDERS)]
    rated = [_rate(n_players, [games[k] for k in order]) for order in orders]
    return [(float(mean), float(sigma)) for mean, sigma in np.mean(rated, 0)]


def _rate(n_players, games):
    from openskill.models import PlackettLuce

    model = PlackettLuce(tau=0.0)  # players do not change between two duels
    players = [model.rating() for _ in range(n_players)]
    for i, j, score in games:
        [players[i]], [players[j]] = model.rate(
            [[players[i]], [players[j]]], scores=[score, 1 - score]
        )
    return [(player.mu, player.sigma) for player in players]


def rows(
    players: Sequence[tuple[str, int | None]],
    scores: Mapping[tuple[int, int], Sequence[float]],
    seed: int = 1,
) -> list[dict]:
    """A table's row for each player `(name, samples)`: its rating, the share of its duels that it
    won, a draw being half, and their number.
    """
    found = []
    for k, ((name, samples), (mean, sigma)) in enumerate(
        zip(players, rate(len(players), scores, seed), strict=True)
    ):
        own = [x for (i, _), row in scores.items() if i == k for x in row]
        own += [1 - x for (_, j), row in scores.items() if j == k for x in row]
        found.append(
            dict(
                player=name,
                samples=samples,
                rating=mean,
                sigma=sigma,
                won=sum(own) / len(own),
                duels=len(own),
            )
        )
    return found


def write(folder: Path, table: Sequence[dict], title: str) -> None:
    """Writes `ratings.csv` and `ratings.svg` into a folder, each whole or not at all: ratings
    against samples with two standard deviations, players without samples as lines.
    """
    text = io.StringIO()
    writer = csv.DictWriter(text, list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    atomic_files.replace(folder / "ratings.csv", text.getvalue().encode())
    atomic_files.replace(folder / "ratings.svg", _plot(table, title))


def _plot(table, title):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    learnt = [row for row in table if row["samples"] is not None]
    samples, means, sigmas = (
        np.array([row[key] for row in learnt], float) for key in ("samples", "rating", "sigma")
    )
    axes.errorbar(samples, means, 2 * sigmas, marker="o", capsize=3, label="the run")
    for i, row in enumerate(each for each in table if each["samples"] is None):
        axes.axhline(row["rating"], color=f"C{i + 1}", linestyle="--", label=row["player"])
    axes.set(title=title, xlabel="samples", ylabel="rating ± two standard deviations")
    axes.grid(alpha=0.3)
    axes.legend()
    image = io.BytesIO()
    figure.savefig(image, format="svg", metadata={"Date": None})
    return image.getvalue()
