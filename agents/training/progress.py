"""What a training run shows of itself in one line."""

from collections.abc import Sequence

from megastep.agents import console
from megastep.agents.training.trainer import Trainer


def progress_of(trainer: Trainer) -> tuple[float | None, list[str]]:
    """Returns the fraction of the budget that is spent, None without one, and the few numbers that
    people watch.
    """
    words, left, latest = (
        [f"{console.number(trainer.samples)} samples"],
        trainer.fraction_left,
        trainer.latest_stats,
    )
    if trainer.samples_per_second is not None:
        words.append(f"{console.number(trainer.samples_per_second)}/s")
    if "episode/return" in latest:
        n_episodes = console.number(latest["episode/window"])
        words.append(f"return {latest['episode/return']:.3g} of {n_episodes} episodes")
        words += few_means(latest, trainer.episode_stats.metrics, trainer.episode_stats.groups)
        won = [(key.partition("episode/won/")[2], rate) for key, rate in latest.items()]
        words += [f"won vs {opponent} {100 * rate:.0f} %" for opponent, rate in won if opponent]
    if trainer.evaluate_every and "return" in trainer.evaluation:
        words.append(f"evaluated {trainer.evaluation['return']:.3g}")
    if trainer.budget.is_limited and left < 1:
        words.append(f"{console.duration(trainer.clock.seconds * left / (1 - left))} left")
    return 1 - left if trainer.budget.is_limited else None, words


def few_means(latest: dict[str, float], metrics: Sequence[str], groups: Sequence[str]) -> list[str]:
    """The returns of groups of lanes, and metrics, if they are few enough for one line."""
    names = {group: f"episode/return/{group}" for group in groups}
    names |= {name: f"episode/{name}" for name in metrics}
    shown = [f"{name} {latest[key]:.3g}" for name, key in names.items() if key in latest]
    return shown if len(names) <= 4 else []
