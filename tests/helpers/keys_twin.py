"""A twin of Keys' step in plain Python, an environment at a time. Shares no code with the kernel.

N environments, C colours, K doorways, O = C + 1 + K objects: keys, the goal, doors.
"""

import math

import torch

from tests.helpers.memory_twin import draws

THINGS = "positions", "angles", "sizes", "colours", "visible", "open", "carriers"


def touches(thing, k, x, y, radius, reach, is_door):
    """Returns whether an agent at (x, y) touches object k, which must be there and lie about."""
    if not thing["visible"][k] or thing["open"][k] or thing["carriers"][k] >= 0:
        return False
    (at_x, at_y), size = thing["positions"][k].tolist(), float(thing["sizes"][k])
    if not is_door:
        return math.hypot(x - at_x, y - at_y) <= radius + size + reach
    angle = math.radians(float(thing["angles"][k]))
    along = math.cos(angle) * (x - at_x) + math.sin(angle) * (y - at_y)
    aside = math.cos(angle) * (y - at_y) - math.sin(angle) * (x - at_x)
    return math.hypot(max(abs(along) - size, 0), aside) <= radius + reach


def begin(thing, tables, layout, number):
    """Puts the objects where episode `number` of a layout has them. Returns where it starts."""
    n = tables["keys"].shape[2]
    keys, doors = tables["keys"][layout, number], tables["doors"][layout, number]
    thing["open"][:], thing["carriers"][:] = False, -1
    for k, at in enumerate(keys):
        is_there = not at.isnan().any()
        thing["positions"][k] = at if is_there else torch.zeros(2)
        thing["visible"][k], thing["colours"][k] = is_there, k
    thing["positions"][n] = tables["goals"][layout, number]
    thing["visible"][n], thing["colours"][n] = True, n + 1
    for k, (state, doorway) in enumerate(zip(doors.tolist(), tables["doorways"][layout])):
        k += n + 1
        thing["visible"][k], thing["colours"][k] = state != -1, n if state < 0 else state
        thing["positions"][k] = doorway[:2] if state != -1 else torch.zeros(2)
        thing["angles"][k], thing["sizes"][k] = doorway[2], doorway[3]
    return tables["starts"][layout, number]


def keys_step(
    positions, radius, things, layout, tables, state, *, seed, limit, reach, key_reward, door_reward
):
    """Returns (outputs, positions, things, state) after a step, on the CPU. Changes nothing.

    Args:
        positions: (N, 2) metres, the agents'; `radius` of them.
        things: {name: (N, O, ...)} of `THINGS`.
        layout: (N,).
        tables: {name: (D, M, ...)}, as `megastep.envs.Keys` has them.
        state: {name: tensor (N,)}, likewise.
    """
    positions = positions.clone()
    things, state = ({k: v.clone() for k, v in part.items()} for part in (things, state))
    numbers, n = draws(state["n_draws"], seed), tables["keys"].shape[2]
    rows = []
    for e in range(len(positions)):
        thing = {name: tensor[e] for name, tensor in things.items()}
        reset, success, reward = bool(state["ended"][e]), False, 0.0
        if reset:
            number = int(numbers[e, 0] * tables["starts"].shape[1])
            positions[e] = begin(thing, tables, int(layout[e]), number)
            state["n_draws"][e] += 1
            state["opened"][e] = state["ages"][e] = 0
        else:
            state["ages"][e] += 1
            where = *positions[e].tolist(), radius, reach
            for k in range(n):
                if touches(thing, k, *where, False):
                    thing["carriers"][k] = 0
                    reward += key_reward
            for k in range(n + 1, len(thing["visible"])):
                colour = int(thing["colours"][k])
                if (
                    colour < n
                    and thing["carriers"][colour] == 0
                    and touches(thing, k, *where, True)
                ):
                    thing["open"][k], thing["visible"][colour] = True, False
                    thing["carriers"][colour] = -1
                    reward += door_reward
                    state["opened"][e] += 1
            success = touches(thing, n, *where, False)
        ends = not reset and (success or int(state["ages"][e]) >= limit)
        held = thing["visible"][:n] & (thing["carriers"][:n] == 0)
        rows.append(
            dict(
                reward=reward + success,
                reset=reset,
                terminal=ends and success,
                truncated=ends and not success,
                metrics=[ends * float(v) for v in (success, state["opened"][e], held.sum())],
                keys_obs=held.tolist(),
            )
        )
        state["ended"][e] = ends
    outputs = {name: torch.tensor([row[name] for row in rows]) for name in rows[0]}
    return outputs, positions, things, state
