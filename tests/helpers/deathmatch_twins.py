"""A twin of Deathmatch in plain Python and NumPy: hits, health, rewards, hidden spawns. Slow and
obvious, and shares no code with the kernels.

N environments, A agents, M lines of the agent model, W walls.
"""

import numpy as np

from tests.helpers.pong_twins import philox

ONE, MIN_HEALTH = np.float32(1), np.float32(1e-4)
F = np.float32


def hits_of(line, ray, health, tally, ages, ended, *, n_model, res, rules):
    """Steps one environment. ``line``, ``ray``, ``health``, ``ages``, ``ended`` are (A,); ``tally``
    is (4, A): kills, damage, hits, aim. Returns {name: values} of the outputs and the new state.
    """
    n, rules = len(line), {name: F(value) for name, value in rules.items()}
    hits = {}  # attacker: target
    for a in range(n):
        target = int(line[a]) // n_model if 0 <= line[a] < n * n_model else None
        if target is not None and not ended[a] and not ended[target]:
            hits[a] = target
    by = {a: [attacker for attacker, target in hits.items() if target == a] for a in range(n)}
    left, lost, dies = {}, {}, {}
    for a in range(n):
        before = ONE if ended[a] else health[a]
        wounds = F(len(by[a])) * rules["damage"]
        left[a] = ONE if ended[a] else before - wounds - rules["drain"]
        lost[a], dies[a] = min(wounds, before), bool(left[a] <= MIN_HEALTH)
    rows = []
    for a in range(n):
        starts, target = bool(ended[a]), hits.get(a)
        gain = rules["health_per_hit"] if a in hits else F(0)
        gain = gain if by[a] else gain + rules["recovery"]
        hit, wounds, kill, damage = F(a in hits), F(len(by[a])), F(0), F(0)
        if target is not None:
            share = ONE / F(len(by[target]))
            kill, damage = share * F(dies[target]), lost[target] * share
        aim = F(0)
        if rules["aim_reward"] and ray[a] >= 0:
            aim = max(ONE - F(abs(int(ray[a]) - res // 2)) / (F(res) * F(0.5)), F(0))
        reward = (
            rules["hit_reward"] * hit
            - rules["wound_cost"] * wounds
            + rules["kill_reward"] * kill
            - rules["death_cost"] * F(dies[a])
            + rules["aim_reward"] * (aim - tally[3, a])
        )
        age = 0 if starts else int(ages[a]) + 1
        ends = not starts and (dies[a] or age >= rules["limit"])
        sums = [F(0) if starts else tally[k, a] + x for k, x in enumerate((kill, damage, hit))]
        after = F(0) if dies[a] else min(left[a] + gain, ONE)
        rows.append(
            dict(
                reward=F(0) if starts else reward,
                reset=starts,
                terminal=ends and dies[a],
                truncated=ends and not dies[a],
                kills=sums[0] if ends else F(0),
                deaths=F(ends and dies[a]),
                damage=sums[1] if ends else F(0),
                accuracy=sums[2] / F(age) if ends else F(0),
                health_obs=np.array([after, hit, wounds], np.float16),
                health=after,
                tally=np.array([*sums, aim]),
                ages=age,
                ended=ends,
            )
        )
    return {name: np.stack([row[name] for row in rows]) for name in rows[0]}


def privileged(health, positions, angles):
    """Returns the privileged observation of one environment, (A, 1 + 5 (A - 1)) float64: own
    health; then, for each other agent from the next one on, health, position ahead and left / 10 m,
    cosine and sine of its relative heading.
    """
    rows, n = [], len(health)
    for a in range(n):
        row, heading = [health[a]], np.radians(float(angles[a]))
        turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
        for k in range(1, n):
            b = (a + k) % n
            other = np.radians(float(angles[b])) - heading
            place = turn @ (positions[b].astype(float) - positions[a]) / 10
            row += [health[b], *place, np.cos(other), np.sin(other)]
        rows.append(row)
    return np.array(rows)


def sound(positions, angles, hearing):
    """Returns what each agent of one environment hears, (A, 3): the loudness of the nearest other
    agent, and the cosine and sine of its bearing.
    """
    rows, n = [], len(angles)
    for a in range(n):
        away = [positions[b].astype(float) - positions[a] for b in range(n) if b != a]
        nearest = min(away, key=np.linalg.norm)
        distance = np.linalg.norm(nearest)
        bearing = np.arctan2(nearest[1], nearest[0]) - np.radians(float(angles[a]))
        heard = [1 - distance / hearing, np.cos(bearing), np.sin(bearing)]
        rows.append(heard if distance < hearing else [0, 0, 0])
    return np.array(rows)


# ---- Hidden spawns ----


def cuts(walls, start, end):
    """(W,) bool: walls (W, 2, 2) that cut a line of sight, by solving for the crossings."""
    along, step = walls[:, 1] - walls[:, 0], end - start
    area = step[0] * along[:, 1] - step[1] * along[:, 0]
    away = walls[:, 0] - start
    with np.errstate(divide="ignore", invalid="ignore"):
        on_sight = (away[:, 0] * along[:, 1] - away[:, 1] * along[:, 0]) / area
        on_wall = (away[:, 0] * step[1] - away[:, 1] * step[0]) / area
    return (on_sight >= 0) & (on_sight <= 1) & (on_wall >= 0) & (on_wall <= 1) & (area != 0)


def is_visible(walls, eye, place, radius):
    """Returns if an agent at ``eye`` (2,) sees the centre or either side of a disc at ``place``."""
    away = place - eye
    side = radius * np.array([-away[1], away[0]]) / max(np.linalg.norm(away), radius)
    return any(not cuts(walls, eye, place + k * side).any() for k in (-1, 0, 1))


def respawned(walls, points, positions, mask, draws, first_lane, seed, radius):
    """Returns the agents' positions (A, 2) after those of ``mask`` (A,) have respawned.

    ``points`` are (A, P, 2), ``draws`` (A,) the numbers drawn before.
    """
    walls, positions = walls.astype(float), positions.astype(float).copy()
    placed = [not respawns for respawns in mask]
    for a in np.nonzero(mask)[0]:
        word = philox(first_lane + int(a), int(draws[a]), seed)[0]
        first = int((word >> 8) / 2**24 * len(points[a]))
        candidates = np.roll(points[a].astype(float), -first, axis=0)
        others = [positions[b] for b in range(len(mask)) if placed[b] and b != a]
        hidden = [
            not any(is_visible(walls, eye, at, radius) for eye in others) for at in candidates
        ]
        if any(hidden):
            positions[a] = candidates[hidden.index(True)]
        else:
            gaps = [min(np.linalg.norm(at - eye) for eye in others) for at in candidates]
            positions[a] = candidates[int(np.argmax(gaps))]
        placed[a] = True
    return positions
