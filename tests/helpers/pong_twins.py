"""Twins of Pong: one game in plain Python, and many games in NumPy. The kernel is compared with
both on every bit.

Positions and speeds are integers, 256 per cell. N games, S sides that act, B = N S lanes.
"""

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
