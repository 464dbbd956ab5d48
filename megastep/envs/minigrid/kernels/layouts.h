// The layouts of MiniGrid's tasks. Each draws its numbers in the order of the original.
#pragma once
#include "grid.h"

// In the order of their names, which the original draws from: blue, green, grey, purple, red and
// yellow, four bits each.
HD int colour_by_name(int i) { return 0x403512 >> 4 * i & 15; }

RARE int draw_colour(Game& g, const Grid& grid) {
    return colour_by_name(draw(g, grid, 0, N_COLOURS));
}

RARE void fill(const Grid& grid, Rectangle in, int cell) {
    for (int y = in.y; y < in.y + in.height; y++)
        for (int x = in.x; x < in.x + in.width; x++)
            grid.cells[at(grid, x, y)] = (unsigned char)cell;
}

HD void wall(const Grid& grid, Rectangle along) { fill(grid, along, cell_of(WALL, GREY)); }

RARE void wall_around(const Grid& grid, Rectangle r) {
    wall(grid, {r.x, r.y, r.width, 1});
    wall(grid, {r.x, r.y + r.height - 1, r.width, 1});
    wall(grid, {r.x, r.y, 1, r.height});
    wall(grid, {r.x + r.width - 1, r.y, 1, r.height});
}

HD Rectangle all_of(const Grid& grid) { return {0, 0, grid.width, grid.height}; }

HD void put(const Grid& grid, int x, int y, int cell) {
    grid.cells[at(grid, x, y)] = (unsigned char)cell;
}

HD void put_goal(const Grid& grid, int x, int y) { put(grid, x, y, cell_of(GOAL, GREEN)); }

HD void stand(Game& g, int x, int y, int direction) {
    g.x = x;
    g.y = y;
    g.direction = direction;
}

RARE void place_agent(Game& g, const Grid& grid, Rectangle in) {
    stand(g, -1, -1, g.direction);
    int place_of = inside(grid, place(g, grid, EMPTY, in));
    stand(g, place_of % grid.width, place_of / grid.width, draw(g, grid, 0, 4));
}

// a: whether the agent starts anywhere.
RARE void empty_room(Game& g, const Grid& grid) {
    put_goal(grid, grid.width - 2, grid.height - 2);
    stand(g, 1, 1, 0);
    if (grid.a)
        place_agent(g, grid, all_of(grid));
}

RARE void four_rooms(Game& g, const Grid& grid) {
    int w = grid.width / 2, h = grid.height / 2;
    for (int j = 0; j < 2; j++)
        for (int i = 0; i < 2; i++) {
            int left = i * w, top = j * h, right = left + w, bottom = top + h;
            if (i == 0) {
                wall(grid, {right, top, 1, h});
                put(grid, right, draw(g, grid, top + 1, bottom), EMPTY);
            }
            if (j == 0) {
                wall(grid, {left, bottom, w, 1});
                put(grid, draw(g, grid, left + 1, right), bottom, EMPTY);
            }
        }
    place_agent(g, grid, all_of(grid));
    place(g, grid, cell_of(GOAL, GREEN), all_of(grid));
}

RARE void door_key(Game& g, const Grid& grid) {
    put_goal(grid, grid.width - 2, grid.height - 2);
    int split = draw(g, grid, 2, grid.width - 2);
    Rectangle left = {0, 0, split, grid.height};
    wall(grid, {split, 0, 1, grid.height});
    place_agent(g, grid, left);
    put(grid, split, draw(g, grid, 1, grid.width - 2), cell_of(LOCKED_DOOR, YELLOW));
    place(g, grid, cell_of(KEY, YELLOW), left);
}

// ---- Rooms in rows, of which neighbours share walls ----

constexpr int TO_RIGHT = 0, DOWN = 1, TO_LEFT = 2, UP = 3;
constexpr int OFFSET_BITS = 3;
constexpr int FIRST_WALLS = 0x15555;  // the wall to the right of each room

// Room k = j n_columns + i has wall 2 k on its right, and wall 2 k + 1 below.
struct Rooms {
    int size, n_columns, n_rows;
    int locked;                  // the room behind a locked door
    int doors;                   // a bit for each wall: whether one can go through
    unsigned long long offsets;  // how far along each wall its door is
};

HD Rectangle room(const Rooms& r, int i, int j) {
    return {i * (r.size - 1), j * (r.size - 1), r.size, r.size};
}

HD int has_neighbour(const Rooms& r, int i, int j, int direction) {
    int x = i + dx_of(direction), y = j + dy_of(direction);
    return x >= 0 && y >= 0 && x < r.n_columns && y < r.n_rows;
}

HD int wall_of(const Rooms& r, int i, int j, int direction) {
    int k = j * r.n_columns + i;
    if (direction >= TO_LEFT)
        k += dx_of(direction) + dy_of(direction) * r.n_columns;
    return 2 * k + (direction & 1);
}

HD int door_place(const Grid& grid, const Rooms& r, int i, int j, int direction) {
    int wall = wall_of(r, i, j, direction), k = wall / 2;
    int offset = (int)(r.offsets >> OFFSET_BITS * wall) & ((1 << OFFSET_BITS) - 1);
    int along = r.size - 1, x = k % r.n_columns * along, y = k / r.n_columns * along;
    return wall & 1 ? at(grid, x + offset, y + along) : at(grid, x + along, y + offset);
}

HD void connect(Rooms& r, int i, int j, int direction) {
    r.doors |= 1 << wall_of(r, i, j, direction);
}

HD Rooms make_rooms(Game& g, const Grid& grid, int size, int n_columns, int n_rows) {
    Rooms r = {size, n_columns, n_rows, -1, 0, 0};
    for (int k = 0; k < n_columns * n_rows; k++)
        wall_around(grid, room(r, k % n_columns, k / n_columns));
    for (int k = 0; k < n_columns * n_rows; k++)
        for (int direction = TO_RIGHT; direction <= DOWN; direction++)
            if (has_neighbour(r, k % n_columns, k / n_columns, direction)) {
                unsigned long long offset = (unsigned long long)draw(g, grid, 1, size - 1);
                r.offsets |= offset << OFFSET_BITS * (2 * k + direction);
            }
    stand(g, n_columns / 2 * (size - 1) + size / 2, n_rows / 2 * (size - 1) + size / 2, 0);
    return r;
}

RARE int add_door(Game& g, const Grid& grid, Rooms& r, int i, int j, int direction, int kind) {
    int colour = draw_colour(g, grid);
    grid.cells[door_place(grid, r, i, j, direction)] = (unsigned char)cell_of(kind, colour);
    connect(r, i, j, direction);
    if (kind == LOCKED_DOOR)
        r.locked = j * r.n_columns + i;
    return colour;
}

HD int near_agent(const Game& g, int x, int y) { return absi(g.x - x) + absi(g.y - y) < 2; }

RARE void add_object(Game& g, const Grid& grid, const Rooms& r, int i, int j, int cell) {
    place_unless(g, grid, cell, room(r, i, j), MAX_TRIES,
                 [&](int x, int y) { return near_agent(g, x, y); });
}

RARE int add_random(Game& g, const Grid& grid, const Rooms& r, int i, int j, int kind) {
    int cell = cell_of(kind, draw_colour(g, grid));
    add_object(g, grid, r, i, j, cell);
    return cell;
}

// In front of nothing, or of a wall.
HD void place_in_room(Game& g, const Grid& grid, const Rooms& r, int i, int j) {
    while (may_draw(g, grid)) {
        place_agent(g, grid, room(r, i, j));
        int front = kind_of(grid.cells[front_of(g, grid)]);
        if (front == EMPTY || front == WALL)
            return;
    }
}

RARE void unlock(Game& g, const Grid& grid, int with_box) {
    Rooms r = make_rooms(g, grid, 6, 2, 1);
    int box = with_box ? add_random(g, grid, r, 1, 0, BOX) : 0;
    int colour = add_door(g, grid, r, 0, 0, TO_RIGHT, LOCKED_DOOR);
    add_object(g, grid, r, 0, 0, cell_of(KEY, colour));
    place_in_room(g, grid, r, 0, 0);
    g.marks[0] = with_box ? box : door_place(grid, r, 0, 0, TO_RIGHT);
    g.mission[0] = box;
}

// Whether one can go from a room to all. Room k is bit 2 k.
HD int are_connected(const Rooms& r, int start) {
    int n_rooms = r.n_columns * r.n_rows, row = 2 * r.n_columns;
    int right = r.doors & FIRST_WALLS, down = r.doors >> 1 & FIRST_WALLS, reached = 1 << 2 * start;
    for (int i = 1; i < n_rooms; i++)
        reached |= (reached & right) << 2 | (reached >> 2 & right) | (reached & down) << row |
                   (reached >> row & down);
    return reached == (FIRST_WALLS & ((1 << 2 * n_rooms) - 1));
}

// a: size of the rooms, b: rows.
RARE void key_corridor(Game& g, const Grid& grid) {
    int n_rows = grid.b;
    Rooms r = make_rooms(g, grid, grid.a, 3, n_rows);
    for (int j = 1; j < n_rows; j++) {
        Rectangle middle = room(r, 1, j);
        fill(grid, {middle.x + 1, middle.y, r.size - 2, 1}, EMPTY);
        connect(r, 1, j, UP);
    }
    int row = draw(g, grid, 0, n_rows);
    int colour = add_door(g, grid, r, 2, row, TO_LEFT, LOCKED_DOOR);
    g.marks[0] = g.mission[0] = add_random(g, grid, r, 2, row, BALL);
    add_object(g, grid, r, 0, draw(g, grid, 0, n_rows), cell_of(KEY, colour));
    place_in_room(g, grid, r, 1, n_rows / 2);
    int start = n_rows / 2 * 3 + 1;
    while (!are_connected(r, start) && may_draw(g, grid)) {
        int i = draw(g, grid, 0, 3), j = draw(g, grid, 0, n_rows), k = draw(g, grid, 0, 4);
        int here = j * 3 + i, there = here + dx_of(k) + 3 * dy_of(k);
        if (has_neighbour(r, i, j, k) && !(r.doors >> wall_of(r, i, j, k) & 1) &&
            here != r.locked && there != r.locked)
            add_door(g, grid, r, i, j, k, CLOSED_DOOR);
    }
}

// ---- A chain of rooms ----

struct ChainedRoom {
    Rectangle at;
    int door_x, door_y;
};

// Draws a room behind a door in one of its walls. Returns 0 if it does not fit.
RARE int chain_room(Game& g, const Grid& grid, ChainedRoom* rooms, int n, int wall_of_door, int x,
                    int y) {
    int w = draw(g, grid, 4, grid.c + 1), h = draw(g, grid, 4, grid.c + 1);
    int left = x, top = y;
    if (n > 0) {
        int is_beside = wall_of_door == TO_RIGHT || wall_of_door == TO_LEFT;
        if (is_beside)
            top = draw(g, grid, y - h + 2, y);
        else
            left = draw(g, grid, x - w + 2, x);
        if (wall_of_door == TO_RIGHT)
            left = x - w + 1;
        if (wall_of_door == DOWN)
            top = y - h + 1;
    }
    if (left < 0 || top < 0 || left + w > grid.width || top + h >= grid.height)
        return 0;
    for (int i = 0; i < n - 1; i++) {
        Rectangle other = rooms[i].at;
        if (left + w >= other.x && other.x + other.width > left && top + h >= other.y &&
            other.y + other.height > top)
            return 0;
    }
    rooms[n] = {{left, top, w, h}, x, y};
    return 1;
}

HD int chain_rooms(Game& g, const Grid& grid, ChainedRoom* rooms, int n_rooms) {
    int x = draw(g, grid, 0, grid.width - 2), y = draw(g, grid, 0, grid.width - 2), entry = TO_LEFT;
    int n = chain_room(g, grid, rooms, 0, entry, x, y), is_placed = n;
    while (is_placed && n < n_rooms) {
        Rectangle r = rooms[n - 1].at;
        is_placed = 0;
        int next_entry = 0;
        for (int i = 0; i < 8 && !is_placed; i++) {
            int exit = draw(g, grid, 0, 3);
            exit += exit >= entry;
            int is_beside = exit == TO_RIGHT || exit == TO_LEFT;
            int along = draw(g, grid, 1, (is_beside ? r.height : r.width) - 1);
            x = is_beside ? r.x + (exit == TO_RIGHT ? r.width - 1 : 0) : r.x + along;
            y = is_beside ? r.y + along : r.y + (exit == DOWN ? r.height - 1 : 0);
            next_entry = exit ^ 2;
            is_placed = chain_room(g, grid, rooms, n, next_entry, x, y);
        }
        n += is_placed;
        entry = next_entry;
    }
    return n;
}

// a: fewest rooms, b: most, c: the largest size of a room.
RARE void multi_room(Game& g, const Grid& grid) {
    ChainedRoom rooms[MAX_ROOMS];
    int n_rooms = draw(g, grid, grid.a, grid.b + 1), colour = -1;
    int n_chained = 0;
    while (n_chained < n_rooms && may_draw(g, grid))
        n_chained = chain_rooms(g, grid, rooms, n_rooms);
    n_rooms = n_chained;
    for (int i = 0; i < n_rooms; i++) {
        wall_around(grid, rooms[i].at);
        if (i == 0)
            continue;
        int choice = draw(g, grid, 0, colour < 0 ? N_COLOURS : N_COLOURS - 1);
        colour = choice + (colour >= 0 && choice >= colour);
        put(grid, rooms[i].door_x, rooms[i].door_y, cell_of(CLOSED_DOOR, colour_by_name(colour)));
    }
    place_agent(g, grid, rooms[0].at);
    place(g, grid, cell_of(GOAL, GREEN), rooms[maxi(n_rooms, 1) - 1].at);
}

// ---- Obstacles ----

RARE void lava_gap(Game& g, const Grid& grid) {
    stand(g, 1, 1, 0);
    put_goal(grid, grid.width - 2, grid.height - 2);
    int x = draw(g, grid, 2, grid.width - 2), y = draw(g, grid, 1, grid.height - 1);
    fill(grid, {x, 1, 1, grid.height - 2}, cell_of(LAVA, RED));
    put(grid, x, y, EMPTY);
}

// Shuffles n items (Fisher and Yates), from the last.
RARE void shuffle(Game& g, const Grid& grid, int* items, int n) {
    for (int i = n - 1; i > 0; i--) {
        int other = draw(g, grid, 0, i + 1), item = items[i];
        items[i] = items[other];
        items[other] = item;
    }
}

constexpr int MAX_RIVERS = 16;

// a: rivers, b: what they are of.
RARE void crossing(Game& g, const Grid& grid) {
    stand(g, 1, 1, 0);
    put_goal(grid, grid.width - 2, grid.height - 2);
    int size = grid.width, per_way = (size - 3) / 2, n = grid.a;
    int rivers[MAX_RIVERS], path[MAX_RIVERS];
    for (int i = 0; i < 2 * per_way; i++)
        rivers[i] = i;
    shuffle(g, grid, rivers, 2 * per_way);
    // sorted places of those down and across, between 0 and the wall
    int down[MAX_RIVERS] = {0}, across[MAX_RIVERS] = {0}, n_down = 0, n_across = 0;
    for (int k = 0; k < 2 * per_way; k++)
        for (int i = 0; i < n; i++)
            if (rivers[i] == k) {
                int place = 2 + 2 * (k % per_way);
                if (k < per_way)
                    down[++n_down] = place;
                else
                    across[++n_across] = place;
            }
    for (int i = 1; i <= n_across; i++)
        fill(grid, {1, across[i], size - 2, 1}, grid.b);
    for (int i = 1; i <= n_down; i++)
        fill(grid, {down[i], 1, 1, size - 2}, grid.b);
    down[n_down + 1] = across[n_across + 1] = size - 1;
    for (int i = 0; i < n; i++)
        path[i] = i >= n_down;  // 0: to the right, over a river that runs down
    shuffle(g, grid, path, n);
    int i = 0, j = 0;
    for (int k = 0; k < n; k++) {
        if (path[k] == 0) {
            put(grid, down[i + 1], draw(g, grid, across[j] + 1, across[j + 1]), EMPTY);
            i++;
        } else {
            put(grid, draw(g, grid, down[i] + 1, down[i + 1]), across[j + 1], EMPTY);
            j++;
        }
    }
}

// a: the row of the second strip.
RARE void dist_shift(Game& g, const Grid& grid) {
    put_goal(grid, grid.width - 2, 1);
    fill(grid, {3, 1, grid.width - 6, 1}, cell_of(LAVA, RED));
    fill(grid, {3, grid.a, grid.width - 6, 1}, cell_of(LAVA, RED));
    stand(g, 1, 1, 0);
}

// a: whether the agent starts anywhere, b: obstacles.
RARE void dynamic_obstacles(Game& g, const Grid& grid) {
    empty_room(g, grid);
    for (int i = 0; i < grid.b; i++)
        g.obstacles[i] = place(g, grid, BALL_BLUE, all_of(grid));
}

// ---- Missions ----

// a: whether the hallway's length is random.
RARE void memory(Game& g, const Grid& grid) {
    int middle = grid.height / 2, end = grid.a ? draw(g, grid, 4, grid.width - 2) : grid.width - 3;
    wall(grid, {1, middle - 2, 4, 1});
    wall(grid, {1, middle + 2, 4, 1});
    wall(grid, {4, middle - 1, 1, 1});
    wall(grid, {4, middle + 1, 1, 1});
    if (end > 5) {
        wall(grid, {5, middle - 1, end - 5, 1});
        wall(grid, {5, middle + 1, end - 5, 1});
    }
    wall(grid, {end, 0, 1, middle});
    wall(grid, {end, middle + 1, 1, grid.height - middle - 1});
    wall(grid, {end + 2, 0, 1, grid.height});
    stand(g, draw(g, grid, 1, end + 1), middle, 0);
    int shown = draw(g, grid, 0, 2), order = draw(g, grid, 0, 2);
    put(grid, 1, middle - 1, cell_of(shown ? BALL : KEY, GREEN));
    put(grid, end + 1, middle - 2, cell_of(order ? KEY : BALL, GREEN));
    put(grid, end + 1, middle + 2, cell_of(order ? BALL : KEY, GREEN));
    int is_up = shown != order;  // the first of the two is the one that was shown
    g.marks[!is_up] = at(grid, end + 1, middle - 1);
    g.marks[is_up] = at(grid, end + 1, middle + 1);
}

RARE void red_blue_doors(Game& g, const Grid& grid) {
    int size = grid.height;
    wall_around(grid, {size / 2, 0, size, size});
    place_agent(g, grid, {size / 2, 0, size, size});
    g.marks[0] = at(grid, size / 2, draw(g, grid, 1, size - 1));
    g.marks[1] = at(grid, size / 2 + size - 1, draw(g, grid, 1, size - 1));
    grid.cells[g.marks[0]] = cell_of(CLOSED_DOOR, RED);
    grid.cells[g.marks[1]] = cell_of(CLOSED_DOOR, BLUE);
}

constexpr int MAX_OBJECTS = 3;

// b: objects.
RARE void put_near(Game& g, const Grid& grid) {
    int objects[MAX_OBJECTS] = {0, 0, 0}, places[MAX_OBJECTS] = {0, 0, 0}, n = 0;
    while (n < grid.b && may_draw(g, grid)) {
        int kind = KEY + draw(g, grid, 0, 3), object = cell_of(kind, draw_colour(g, grid));
        int is_there = 0;
        for (int i = 0; i < n; i++)
            is_there |= objects[i] == object;
        if (is_there)
            continue;
        places[n] = place_unless(g, grid, object, all_of(grid), MAX_TRIES, [&](int x, int y) {
            int is_near = 0;
            for (int i = 0; i < n; i++)
                is_near |=
                    absi(x - places[i] % grid.width) <= 1 && absi(y - places[i] / grid.width) <= 1;
            return is_near;
        });
        objects[n++] = object;
    }
    place_agent(g, grid, all_of(grid));
    int moved = draw(g, grid, 0, n), target;
    do
        target = draw(g, grid, 0, n);
    while (target == moved && may_draw(g, grid));
    g.marks[0] = g.mission[0] = objects[moved];
    g.marks[1] = places[target];
    g.mission[1] = objects[target];
}

RARE void go_to_door(Game& g, const Grid& grid) {
    int width = draw(g, grid, 5, grid.width + 1), height = draw(g, grid, 5, grid.height + 1);
    fill(grid, all_of(grid), EMPTY);
    wall_around(grid, {0, 0, width, height});
    int places[4], colours[4] = {0, 0, 0, 0}, n = 0;
    places[0] = at(grid, draw(g, grid, 2, width - 2), 0);
    places[1] = at(grid, draw(g, grid, 2, width - 2), height - 1);
    places[2] = at(grid, 0, draw(g, grid, 2, height - 2));
    places[3] = at(grid, width - 1, draw(g, grid, 2, height - 2));
    while (n < 4 && may_draw(g, grid)) {
        int colour = draw_colour(g, grid), is_there = 0;
        for (int i = 0; i < n; i++)
            is_there |= colours[i] == colour;
        if (!is_there)
            colours[n++] = colour;
    }
    for (int i = 0; i < 4; i++)
        grid.cells[places[i]] = (unsigned char)cell_of(CLOSED_DOOR, colours[i]);
    place_agent(g, grid, {0, 0, width, height});
    int target = draw(g, grid, 0, 4);
    g.marks[0] = places[target];
    g.mission[0] = cell_of(CLOSED_DOOR, colours[target]);
}

// A random one of those given. a: how many.
RARE void custom(Game& g, const Grid& grid) {
    int i = draw(g, grid, 0, grid.a), n_cells = grid.width * grid.height;
    for (int k = 0; k < n_cells; k++)
        grid.cells[k] = grid.layouts[(long long)i * n_cells + k];
    stand(g, grid.starts[3 * i], grid.starts[3 * i + 1], grid.starts[3 * i + 2]);
}

RARE void new_game(Game& g, const Grid& grid) {
    fill(grid, all_of(grid), EMPTY);
    int task = grid.task;
    if (task != MULTI_ROOM && task != UNLOCK && task != UNLOCK_PICKUP && task != KEY_CORRIDOR)
        wall_around(grid, all_of(grid));
    stand(g, -1, -1, 0);
    g.carried = g.age = g.ended = 0;
    g.marks[0] = g.marks[1] = g.mission[0] = g.mission[1] = 0;
    switch (task) {
        case EMPTY_ROOM:
            return empty_room(g, grid);
        case FOUR_ROOMS:
            return four_rooms(g, grid);
        case DOOR_KEY:
            return door_key(g, grid);
        case UNLOCK:
            return unlock(g, grid, 0);
        case UNLOCK_PICKUP:
            return unlock(g, grid, 1);
        case KEY_CORRIDOR:
            return key_corridor(g, grid);
        case MULTI_ROOM:
            return multi_room(g, grid);
        case LAVA_GAP:
            return lava_gap(g, grid);
        case CROSSING:
            return crossing(g, grid);
        case DIST_SHIFT:
            return dist_shift(g, grid);
        case MEMORY:
            return memory(g, grid);
        case RED_BLUE_DOORS:
            return red_blue_doors(g, grid);
        case DYNAMIC_OBSTACLES:
            return dynamic_obstacles(g, grid);
        case PUT_NEAR:
            return put_near(g, grid);
        case GO_TO_DOOR:
            return go_to_door(g, grid);
        case CUSTOM:
            return custom(g, grid);
    }
}
