"""The twin of the physics of movable objects: one environment, in NumPy and float64, without holds.
It shares no code with the kernels.

A slot is a dict: at (2,), angle (degrees), half (2,) of a rectangle or radius of a disc, v (2,), w
(rad/s), m and i (inverse mass and inertia), wish (2,), limit (newtons from the floor). Agents may
have `elevated`, and bodies be ramps with `steps`.
"""

import numpy as np

SUBSTEPS, ITERATIONS = 4, 3
SLOP, MAX_OVERLAP, MAX_SHIFT, LIGHT, SPARE = 0.002, 0.005, 0.02, 100, 0.2


def cross(a, b):
    return a[0] * b[1] - a[1] * b[0]


def axes(s):
    angle = np.radians(s["angle"])
    x = np.array([np.cos(angle), np.sin(angle)])
    return x, np.array([-x[1], x[0]])


def corners(s):
    x, y = axes(s)
    return [s["at"] + a * s["half"][0] * x + b * s["half"][1] * y for a, b in SIGNS]


SIGNS = (1, 1), (-1, 1), (-1, -1), (1, -1)


def nearest(box, point):
    """The point of a rectangle that is nearest to one outside, or the way out for one inside."""
    x, y = axes(box)
    local = np.array([x @ (point - box["at"]), y @ (point - box["at"])])
    on = np.clip(local, -box["half"], box["half"])
    if (on != local).any():
        at = box["at"] + on[0] * x + on[1] * y
        return at, (point - at) / np.linalg.norm(point - at), np.linalg.norm(point - at)
    inside = box["half"] - abs(local)
    k = 0 if inside[0] < inside[1] else 1
    return point, (x, y)[k] * (1 if local[k] >= 0 else -1), -inside[k]


def touch(a, b):
    """(normal from a to b, [(gap, point)]), the points on the outline of one of the two."""
    if "radius" in a and "radius" in b:
        to = b["at"] - a["at"]
        far = np.linalg.norm(to)
        return to / far, [(far - a["radius"] - b["radius"], a["at"] + to / far * a["radius"])]
    if "radius" in a:
        normal, points = touch(b, a)
        return -normal, points
    if "radius" in b:
        at, normal, gap = nearest(a, b["at"])
        return normal, [(gap - b["radius"], at)]
    best = None
    for own, other, sign in ((a, b, 1), (b, a, -1)):
        for k in (0, 1):
            axis = axes(own)[k]
            normal = axis if axis @ (other["at"] - own["at"]) >= 0 else -axis
            gap = min(normal @ (c - own["at"]) for c in corners(other)) - own["half"][k]
            if best is None or gap > best[0] + 1e-12:
                best = gap, own, other, sign, k, normal
    _, own, other, sign, k, normal = best
    along, reach, height = axes(own)[1 - k], own["half"][1 - k], own["half"][k]
    faces = [(s * other["half"][j] * axes(other)[j], j) for j in (0, 1) for s in (1, -1)]
    units = [axes(other)[j] * s for j in (0, 1) for s in (1, -1)]
    face, j = faces[int(np.argmin([u @ normal for u in units]))]
    side = other["half"][1 - j] * axes(other)[1 - j]
    start, end = other["at"] + face - side, other["at"] + face + side
    s0, s1 = along @ (start - own["at"]), along @ (end - own["at"])
    cuts = [np.clip((t - s0) / (s1 - s0), 0, 1) if s1 != s0 else 0.0 for t in (-reach, reach)]
    if min(s0, s1) > reach or max(s0, s1) < -reach:  # beside the side
        point = start if abs(s0) < abs(s1) else end
        where = along @ (point - own["at"])
        corner = own["at"] + height * normal + np.sign(where) * reach * along
        to = point - corner
        far = np.linalg.norm(to)
        return (sign * to / far, [(far, corner)]) if to @ normal > 0 else (normal, [])
    at = [start + c * (end - start) for c in sorted(cuts)]
    if abs(cuts[0] - cuts[1]) < 5e-4 or not np.any(side):
        at = [(at[0] + at[1]) / 2 if np.any(side) else start]
    return sign * normal, [(normal @ (p - own["at"]) - height, p) for p in at]


def impulses_of(mass, target):
    """x >= 0 with mass x + target >= 0, one or the other 0 in each row."""
    if len(target) == 1:
        return np.maximum(-target / mass[0, 0], 0)
    if np.linalg.det(mass) > 1e-3 * mass[0, 0] * mass[1, 1]:
        x = -np.linalg.solve(mass, target)
        if (x >= 0).all():
            return x
    for k in (0, 1):
        x = np.zeros(2)
        x[k] = -target[k] / mass[k, k]
        if x[k] >= 0 and mass[1 - k, k] * x[k] + target[1 - k] >= 0:
            return x
    return None


def solve(t, slots, v, w, inverse, rooms):
    a, b, normal, points = t["a"], t["b"], t["normal"], t["points"]
    arms = [[cross(p - s["at"], normal) for _, p in points] for s in (a, b)]
    mass = np.zeros((len(points),) * 2) + inverse[a["n"]] + inverse[b["n"]]
    mass += a["i"] * np.outer(arms[0], arms[0]) + b["i"] * np.outer(arms[1], arms[1])
    speeds = normal @ (v[b["n"]] - v[a["n"]]) + np.array(
        [w[b["n"]] * y * (b["i"] > 0) - w[a["n"]] * x * (a["i"] > 0) for x, y in zip(*arms)]
    )
    new = impulses_of(mass, speeds + rooms - mass @ t["impulses"])
    if new is None:
        deeper = int(np.argmin([g for g, _ in points]))
        target = (speeds + rooms - mass @ t["impulses"])[deeper]
        new = np.zeros(2)
        new[deeper] = max(-target / mass[deeper, deeper], 0)
    change, t["impulses"] = new - t["impulses"], new
    for s, sign, arm in ((a, -1, arms[0]), (b, 1, arms[1])):
        v[s["n"]] += sign * inverse[s["n"]] * change.sum() * normal
        w[s["n"]] += sign * s["i"] * (change @ np.array(arm))


def floor(s, v, w, h, done):
    """By impulses of at most the limit, to the velocity that a slot wishes."""
    if s["m"] == 0 or s["limit"] == 0:
        return
    old = done.get(s["n"], (np.zeros(2), 0.0))
    j = old[0] + (s["wish"] - v[s["n"]]) / s["m"]
    j *= min(1, s["limit"] * h / max(np.linalg.norm(j), 1e-300))
    v[s["n"]] += s["m"] * (j - old[0])
    turn = 0.0
    if s["i"]:
        most = s["limit"] * h * 0.93 * np.sqrt(s["m"] / s["i"])
        turn = np.clip(old[1] - w[s["n"]] / s["i"], -most, most)
        w[s["n"]] += s["i"] * (turn - old[1])
    done[s["n"]] = j, turn


def climb(agent, bodies, seconds):
    """What an agent passes in this step: bodies if above 0, below 0 the ramp -1 - elevated."""
    up = agent.get("elevated", 0)
    near = [min([gap for gap, _ in touch(agent, b)[1]] or [1]) for b in bodies]
    if up > 1 or (up == 1 and min(near) >= 0):
        up -= 1
    elif up < 0 and near[-1 - up] >= 0:
        up = 0
    fastest = max(np.linalg.norm(agent["v"]), np.linalg.norm(agent["wish"]))
    radius = agent["radius"]
    way = radius + seconds * (fastest + abs(agent["w"]) * radius)

    def along(b):
        x, y = axes(b)
        return x @ (agent["at"] - b["at"]), abs(y @ (agent["at"] - b["at"]))

    for k, b in enumerate(bodies):
        if up == 0 and "steps" in b and axes(b)[0] @ agent["wish"] > 0:
            (x, y), (length, width) = along(b), b["half"]
            if -length - way < x < -length and y <= width:
                up = -1 - k
    if up < 0 and along(bodies[-1 - up])[0] + radius + 0.05 >= bodies[-1 - up]["half"][0]:
        up = bodies[-1 - up]["steps"]
    return up


def step(slots, fixed, seconds):
    """Moves slots by a step, in place. `fixed` are walls and other objects."""
    h = seconds / SUBSTEPS
    bodies = [s for s in slots if not s["is_agent"]]
    for s in slots:
        if s["is_agent"]:
            s["elevated"] = climb(s, bodies, seconds)
    for n, s in enumerate([*slots, *fixed]):
        s["n"] = n
        s["extent"] = s["radius"] if "radius" in s else np.linalg.norm(s["half"])
    for s in fixed:
        s.update(m=0, i=0)
    v = np.array([s["v"] for s in slots] + [(0.0, 0.0)] * len(fixed))
    w = np.array([s["w"] for s in slots] + [0.0] * len(fixed))
    top = max(max(np.linalg.norm(s["v"]), np.linalg.norm(s["wish"])) + abs(s["w"]) * s["extent"]
              for s in slots)  # fmt: skip
    if top == 0:
        return
    limit = top + SPARE
    inverse = np.array([s["m"] for s in (*slots, *fixed)], float)
    light = np.array([s["m"] * (LIGHT if s["is_agent"] else 1) for s in slots] + [0] * len(fixed))

    def touches():
        found = []
        for k, a in enumerate(slots):
            for b in [*slots[k + 1 :], *fixed]:
                is_body = any(b is s for s in bodies)
                up = a.get("elevated", 0) if is_body else 0
                if (a["m"] or b["m"]) and not (up > 0 or (up < 0 and b is bodies[-1 - up])):
                    normal, points = touch(a, b)
                    reach = (limit * h + MAX_SHIFT) * (2 if b["n"] < len(slots) else 1)
                    if points and min(gap for gap, _ in points) < reach:
                        zeros = np.zeros(len(points))
                        found.append(dict(a=a, b=b, normal=normal, points=points, impulses=zeros))
        return found

    def displace(v, w, h, limit):
        for s in slots:
            if s["m"]:
                turn = w[s["n"]] if s["i"] else 0
                part = min(
                    1, limit / max(np.linalg.norm(v[s["n"]]) + abs(turn) * s["extent"], 1e-9)
                )
                s["at"] = s["at"] + h * part * v[s["n"]]
                s["angle"] += np.degrees(h * part * w[s["n"]])

    found = touches()
    for _ in range(SUBSTEPS):
        before, floors, taken = [(s["at"], s["angle"]) for s in slots], {}, set()
        for _ in range(ITERATIONS):
            for s in slots:
                if s["is_agent"]:
                    floor(s, v, w, h, floors)
            for t in found:
                rooms = np.array([max(gap, 0) / h for gap, _ in t["points"]])
                solve(t, slots, v, w, inverse, rooms)
            for s in slots:
                if not s["is_agent"]:
                    floor(s, v, w, h, floors)
        displace(v, w, h, limit)
        found = touches()
        gaps = [min(gap for gap, _ in t["points"]) for t in found]
        if min(gaps, default=1) < -SLOP:
            shift, turn = np.zeros_like(v), np.zeros_like(w)
            for _ in range(ITERATIONS):
                for t in found:
                    rooms = np.array([max(gap + SLOP, -MAX_SHIFT) for gap, _ in t["points"]])
                    solve(t, slots, shift, turn, light, rooms)
            displace(shift, turn, 1, MAX_SHIFT)
            found = touches()
            while (
                deep := {
                    s["n"]
                    for t in found
                    if min(gap for gap, _ in t["points"]) < -MAX_OVERLAP
                    for s in (t["a"], t["b"])
                    if s["n"] < len(slots)
                }
                - taken
            ):
                for n in deep:
                    s = slots[n]
                    s["at"], angle = before[n]
                    v[n] = 0
                    if not s["is_agent"]:
                        s["angle"], w[n] = angle, 0
                taken |= deep
                found = touches()
    for s in slots:
        s["v"], s["w"] = v[s["n"]], w[s["n"]]
