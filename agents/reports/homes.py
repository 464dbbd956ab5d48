"""The homes of an evaluation, drawn from above and coloured by what was earned in them."""

import html
from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from megastep.agents.errors import ConfigErrors, UserError
from megastep.agents.evaluation.statistics import SCORES
from megastep.agents.factory import check, components
from megastep.agents.factory import make as factory
from megastep.agents.reports import runs
from megastep.agents.runs import folders, trust

#: Homes that are drawn: so many of the worst, and of the best.
N_WORST, N_BEST = 36, 12
#: What an evaluation of another version, or of a stranger, may raise.
ODD = ArithmeticError, AttributeError, LookupError, StopIteration, TypeError, ValueError


def section(run: runs.Run) -> list[str]:
    """Returns the HTML that shows where the agent does badly; empty without several homes."""
    for table in run.evaluations:
        if "home" not in table.get("episodes", {}):
            continue
        try:
            name, by_home = score_by_home(table["episodes"])
            plans = plans_of(run, table)
        except (UserError, ConfigErrors, *ODD) as error:
            return [f"<p>Homes are not drawn: {html.escape(str(error))}</p>"]
        worst = sorted(by_home, key=by_home.__getitem__)
        if len(worst) < 2 or not all(0 <= home < len(plans) for home in worst):
            continue
        span = by_home[worst[0]], by_home[worst[-1]]
        drawn = worst[:N_WORST] + worst[max(N_WORST, len(worst) - N_BEST) :]
        n_left = len(worst) - len(drawn)
        text = (
            f"{table['title']}. By {name}, worst first: {span[0]:.3g} to {span[1]:.3g} in "
            f"{len(worst):,} homes{f'; {n_left:,} between them are not drawn' * (n_left > 0)}."
        )
        shown = [figure(home, plans[home], by_home[home], span) for home in drawn]
        return [
            "<h2>Homes, worst first</h2>",
            f"<p>{html.escape(text)} <code>record.py home=N</code> films one of this split.</p>",
            f'<div class="plans">{"".join(shown)}</div>',
        ]
    return []


def score_by_home(episodes: Mapping[str, Sequence]) -> tuple[str, dict[int, float]]:
    """Returns the first of `SCORES` that episodes have, and its mean by home, of one agent."""
    name = next(name for name in SCORES if any(v is not None for v in episodes.get(name, ())))
    agents, values = episodes["agent"], defaultdict(list)
    for agent, home, value in zip(agents, episodes["home"], episodes[name], strict=True):
        if agent == agents[0] and home is not None and value is not None:
            values[int(home)].append(float(value))
    return name, {home: float(np.mean(some)) for home, some in values.items()}


def plans_of(run: runs.Run, table: Mapping) -> list:
    """Returns the geometries of the split that a table is about."""
    loaded = folders.load_checkpoint(folders.find(str(run.folder)), False, "cpu")
    trained = factory.config_of(loaded)
    chosen, geometry = table["evaluation"], trained.geometry
    if typed := chosen.get("geometry"):
        trust.check({"train": {"geometry": typed}}, "An evaluation", "")
        geometry = check.check(components.kind_of("geometry", str(typed["name"])), typed)
    return factory.homes(trained.env, geometry, str(chosen["split"]))


def figure(number: int, plan: Mapping, value: float, span: tuple[float, float]) -> str:
    """Returns a home from above, its floor coloured by a value between the bounds of `span`."""
    walls = np.asarray(plan["walls"], float)
    low, high = walls.min((0, 1)), walls.max((0, 1))
    lines = "".join(
        f"M{a[0] - low[0]:.2f} {high[1] - a[1]:.2f}L{b[0] - low[0]:.2f} {high[1] - b[1]:.2f}"
        for a, b in walls
    )
    width, height = high - low
    fraction = (value - span[0]) / (span[1] - span[0]) if span[1] > span[0] else 1.0
    # from a dark red to a light green: lightness differs as well
    hue, saturation, lightness = 10 + 110 * fraction, 70 - 15 * fraction, 48 + 20 * fraction
    colour = f"hsl({hue:.0f} {saturation:.0f}% {lightness:.0f}%)"
    box = f"-.3 -.3 {width + 0.6:.2f} {height + 0.6:.2f}"
    floor = f'<rect width="{width:.2f}" height="{height:.2f}" fill="{colour}"/>'
    drawing = f'<svg viewBox="{box}" role="img">{floor}<path d="{lines}"/></svg>'
    return f"<figure>{drawing}<figcaption>{number}: {value:.3g}</figcaption></figure>"
