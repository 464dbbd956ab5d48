"""What a training run shows of itself in one line."""

from collections.abc import Sequence

from megastep.agents import console
from megastep.agents.training.trainer import Trainer


def progress_of(running: Trainer) -> tuple[float | None, list[str]]:
    """Returns the fraction of the budget that is spent, None without one, and the few numbers that
    people watch.
    """
    words, left, latest = (
        [f"{console.number(running.samples)} samples"],
        running.fraction_left,
        running.latest_stats,
    )
    if running.samples_per_second is not None:
        words.append(f"{console.number(running.samples_per_second)}/s")
    if "episode/return" in latest:
        n_episodes = console.number(latest["episode/window"])
        words.append(f"return {latest['episode/return']:.3g} of {n_episodes} episodes")
        words += few_means(latest, running.episode_stats.metrics, running.episode_stats.groups)
        won = [(k.partition("episode/won/")[2], share) for k, share in latest.items()]
        words += [f"won vs {opponent} {100 * share:.0f} %" for opponent, share in won if opponent]
    if running.budget.is_limited and left < 1:
        words.append(f"{console.duration(running.clock.seconds * left / (1 - left))} left")
    return 1 - left if running.budget.is_limited else None, words


def few_means(latest: dict[str, float], metrics: Sequence[str], groups: Sequence[str]) -> list[str]:
    """The returns of groups of lanes, and metrics, if they are few enough for one line."""
    names = {group: f"episode/return/{group}" for group in groups}
    names |= {name: f"episode/{name}" for name in metrics}
    shown = [f"{name} {latest[key]:.3g}" for name, key in names.items() if key in latest]
    return shown if len(names) <= 4 else []
