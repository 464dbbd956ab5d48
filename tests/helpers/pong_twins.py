"""Twins of Pong: one game in plain Python, and many games in NumPy. The kernel is compared with
both on every bit.

Positions and speeds are integers, 256 per cell. N games, S sides that act, B = N S lanes.
"""

import numpy as np

CELL, ROWS, COLUMNS, PADDLE_ROWS = 256, 30, 40, 4
WORD = 0xFFFFFFFF


def philox(lane, draw, seed):
    """Returns Philox 4x32-10 of a lane's draw: four words of 32 bits."""
    words, keys = [lane, draw, 0, 0], [seed & WORD, seed >> 32]
    for _ in range(10):
        first, second = 0xD2511F53 * words[0], 0xCD9E8D57 * words[2]
        words = [
            second >> 32 ^ words[1] ^ keys[0],
            second & WORD,
            first >> 32 ^ words[3] ^ keys[1],
            first & WORD,
        ]
        keys = [keys[0] + 0x9E3779B9 & WORD, keys[1] + 0xBB67AE85 & WORD]
    return words


class PythonPong:
    """One game, the `lane`-th of its seed. Without `self_play`, a tracker plays the right side."""

    def __init__(
        self, lane=0, seed=1, points=1, limit=1000, self_play=False, tracker=128, pixels=True
    ):
        self.lane, self.seed, self.points, self.limit = lane, seed, points, limit
        self.sides, self.tracker, self.pixels = 2 if self_play else 1, tracker, pixels
        self.draws = 0

    def reset(self):
        self.paddles = [(ROWS - PADDLE_ROWS) * CELL // 2] * 2
        self.scores, self.age, self.over = [0, 0], 0, False
        self.serve()
        return self.world(True, None, False)

    def serve(self):
        height, slope, side, _ = philox(self.lane, self.draws, self.seed)
        self.draws += 1
        to_right = side >= 1 << 31
        self.ball = [COLUMNS * CELL // 2 - to_right, (height >> 16) * ROWS * CELL >> 16]
        self.last = list(self.ball)
        self.velocity = [CELL if to_right else -CELL, ((slope >> 16) * (CELL + 1) >> 16) - 128]

    def step(self, actions):
        """Takes one step with the actions of all sides. Returns a world."""
        if self.over:
            return self.reset()
        moves = [(0, -CELL, CELL)[action] for action in actions]
        if self.sides == 1:
            wanted = self.ball[1] - PADDLE_ROWS * CELL // 2 - self.paddles[1]
            moves.append(max(-self.tracker, min(self.tracker, wanted)))
        for side in range(2):
            place = self.paddles[side] + moves[side]
            self.paddles[side] = max(0, min((ROWS - PADDLE_ROWS) * CELL, place))
        self.last = list(self.ball)
        self.ball = [place + speed for place, speed in zip(self.ball, self.velocity)]
        if self.ball[1] < 0:
            self.ball[1], self.velocity[1] = -1 - self.ball[1], -self.velocity[1]
        elif self.ball[1] >= ROWS * CELL:
            self.ball[1] = 2 * ROWS * CELL - 1 - self.ball[1]
            self.velocity[1] *= -1
        winner = None
        column = self.ball[0] // CELL
        if column in (0, COLUMNS - 1):
            side = int(column > 0)
            below = self.ball[1] - self.paddles[side]
            if 0 <= below < PADDLE_ROWS * CELL:
                edge = (COLUMNS - 1 if side else 1) * CELL
                self.ball[0] = 2 * edge - 1 - self.ball[0]
                self.velocity = [-self.velocity[0], int((2 * below - 1023) / 4)]
            else:
                winner = 1 - side
        self.age += 1
        if winner is not None:
            self.scores[winner] += 1
        won = winner is not None and self.scores[winner] == self.points
        self.over = won or self.age >= self.limit
        if winner is not None and not self.over:
            self.serve()
        return self.world(False, winner, won)

    def world(self, reset, winner, won):
        played = sum(self.scores)
        observe = self.image if self.pixels else self.features
        return dict(
            obs=[observe(side) for side in range(self.sides)],
            reward=[
                0.0 if winner is None else 1.0 if winner == side else -1.0
                for side in range(self.sides)
            ],
            reset=reset,
            terminal=won,
            truncated=self.over and not won,
            points_won=[
                0.0 if not self.over else self.scores[side] / played if played else 0.5
                for side in range(self.sides)
            ],
        )

    def image(self, side):
        """Returns the pixels, row by row."""
        pixels = bytearray(ROWS * COLUMNS)
        for paddle, column in ((side, 0), (1 - side, COLUMNS - 1)):
            top = self.paddles[paddle] // CELL
            for row in range(top, top + PADDLE_ROWS):
                pixels[row * COLUMNS + column] = 170
        for (x, y), grey in ((self.last, 85), (self.ball, 255)):
            column = x // CELL
            pixels[y // CELL * COLUMNS + (COLUMNS - 1 - column if side else column)] = grey
        return pixels

    def features(self, side):
        """Returns own paddle, other paddle, ball x and y, its velocity x and y, and how far it is
        below the centre of each paddle.
        """
        (x, y), (across, down) = self.ball, self.velocity
        middles = [self.paddles[paddle] + 511.5 for paddle in (side, 1 - side)]
        room = (ROWS - PADDLE_ROWS) * CELL
        return [
            2 * self.paddles[side] / room - 1,
            2 * self.paddles[1 - side] / room - 1,
            2 * (COLUMNS * CELL - 1 - x if side else x) / (COLUMNS * CELL) - 1,
            2 * y / (ROWS * CELL) - 1,
            (-across if side else across) / CELL,
            down / CELL,
            *(max(-2.0, min(2.0, (y - middle) / 512)) for middle in middles),
        ]


class NumpyPong:
    """N games at once. Without `self_play`, a tracker plays the right side. All steps write to the
    same buffer of images.
    """

    def __init__(self, n, seed=1, points=1, limit=1000, self_play=False, tracker=128, pixels=True):
        self.n, self.seed, self.points, self.limit = n, seed, points, limit
        self.sides, self.tracker = 2 if self_play else 1, tracker
        self.rows = np.arange(n)
        self.ball, self.last, self.velocity, self.paddles, self.scores = np.zeros(
            (5, 2, n), np.int64
        )
        self.age, self.draws = np.zeros((2, n), np.int64)
        self.over = np.ones(n, bool)
        self.images = np.zeros((n, self.sides, ROWS, COLUMNS), np.uint8) if pixels else None

    def reset(self):
        self.over[:] = True
        return self.step(np.zeros((self.sides, self.n), np.int64))

    def serve(self, which):
        """Serves in the games `which`."""
        counters = [which.astype(np.uint64), self.draws[which].astype(np.uint64)]
        words = [*counters, np.zeros_like(counters[0]), np.zeros_like(counters[0])]
        mask, half, keys = np.uint64(WORD), np.uint64(32), [self.seed & WORD, self.seed >> 32]
        for _ in range(10):
            a, b = np.uint64(0xD2511F53) * words[0], np.uint64(0xCD9E8D57) * words[2]
            key0, key1 = map(np.uint64, keys)
            words = [b >> half ^ words[1] ^ key0, b & mask, a >> half ^ words[3] ^ key1, a & mask]
            keys = [keys[0] + 0x9E3779B9 & WORD, keys[1] + 0xBB67AE85 & WORD]
        height, slope, side = (word.astype(np.int64) for word in words[:3])
        to_right = side >> 31
        self.ball[:, which] = COLUMNS * 128 - to_right, (height >> 16) * ROWS * CELL >> 16
        self.last[:, which] = self.ball[:, which]
        self.velocity[:, which] = (2 * to_right - 1) * CELL, ((slope >> 16) * 257 >> 16) - 128
        self.draws[which] += 1

    def step(self, actions):
        """Takes one step with actions (S, N). Returns a world."""
        reset, room = self.over.copy(), (ROWS - PADDLE_ROWS) * CELL
        moves = np.zeros((2, self.n), np.int64)
        moves[: self.sides] = np.array([0, -CELL, CELL])[actions]
        if self.sides == 1:
            wanted = self.ball[1] - PADDLE_ROWS * CELL // 2 - self.paddles[1]
            moves[1] = wanted.clip(-self.tracker, self.tracker)
        self.paddles = (self.paddles + moves).clip(0, room)
        self.last, self.ball = self.ball, self.ball + self.velocity
        outside = (self.ball[1] < 0) | (self.ball[1] >= ROWS * CELL)
        self.ball[1] = np.where(
            self.ball[1] < 0,
            -1 - self.ball[1],
            np.where(outside, 2 * ROWS * CELL - 1 - self.ball[1], self.ball[1]),
        )
        self.velocity[1] = np.where(outside, -self.velocity[1], self.velocity[1])
        winner = np.full(self.n, -1)
        for side, edge in enumerate((CELL, (COLUMNS - 1) * CELL)):
            there = self.ball[0] >= edge if side else self.ball[0] < edge
            below = self.ball[1] - self.paddles[side]
            hit = there & (below >= 0) & (below < PADDLE_ROWS * CELL)
            self.ball[0] = np.where(hit, 2 * edge - 1 - self.ball[0], self.ball[0])
            self.velocity[0] = np.where(hit, -self.velocity[0], self.velocity[0])
            self.velocity[1] = np.where(
                hit, np.trunc((2 * below - 1023) / 4).astype(np.int64), self.velocity[1]
            )
            winner[there & ~hit] = 1 - side
        winner[reset] = -1
        self.age += 1
        scored = np.flatnonzero(winner >= 0)
        self.scores[winner[scored], scored] += 1
        self.paddles[:, reset], self.scores[:, reset], self.age[reset] = room // 2, 0, 0
        won = (winner >= 0) & (self.scores.max(0) == self.points)
        self.over = won | (self.age >= self.limit)
        self.serve(np.flatnonzero(((winner >= 0) & ~self.over) | reset))
        return self.world(reset, winner, won)

    def world(self, reset, winner, won):
        """Returns a world: flags (N,), rewards and points won (N, S), observations (N, S, ...)."""
        sides = range(self.sides)
        reward = [np.where(winner < 0, 0.0, np.where(winner == s, 1.0, -1.0)) for s in sides]
        played = self.scores.sum(0).astype(np.float32)
        shares = [
            np.where(played > 0, self.scores[s].astype(np.float32) / np.maximum(played, 1), 0.5)
            for s in sides
        ]
        return dict(
            obs=self._features() if self.images is None else self._images(),
            reward=np.stack(reward, -1).astype(np.float32),
            reset=reset,
            terminal=won,
            truncated=self.over & ~won,
            points_won=np.where(self.over[:, None], np.stack(shares, -1), 0.0).astype(np.float32),
        )

    def _images(self):
        self.images[:] = 0
        games = self.rows[:, None]
        for side in range(self.sides):
            pixels = self.images[:, side]
            for paddle, column in ((side, 0), (1 - side, COLUMNS - 1)):
                rows = self.paddles[paddle][:, None] // CELL + np.arange(PADDLE_ROWS)
                pixels[games, rows, column] = 170
            for (x, y), grey in ((self.last, 85), (self.ball, 255)):
                column = COLUMNS - 1 - x // CELL if side else x // CELL
                pixels[self.rows, y // CELL, column] = grey
        return self.images

    def _features(self):
        (x, y), (across, down), seen = self.ball, self.velocity, []
        for side in range(self.sides):
            numbers = [
                (self.paddles[side], 2 / ((ROWS - PADDLE_ROWS) * CELL), 1),
                (self.paddles[1 - side], 2 / ((ROWS - PADDLE_ROWS) * CELL), 1),
                (COLUMNS * CELL - 1 - x if side else x, 2 / (COLUMNS * CELL), 1),
                (y, 2 / (ROWS * CELL), 1),
                (-across if side else across, 1 / CELL, 0),
                (down, 1 / CELL, 0),
            ]
            for paddle in (side, 1 - side):
                below = 2 * (y - self.paddles[paddle]) - 1023
                numbers.append((below.clip(-2048, 2048), 1 / 1024, 0))
            seen.append(
                [
                    n.astype(np.float32) * np.float32(scale) - np.float32(o)
                    for n, scale, o in numbers
                ]
            )
        return np.moveaxis(np.array(seen), -1, 0).astype(np.float16)
