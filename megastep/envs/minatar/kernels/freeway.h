// Freeway: a chicken crosses eight lanes of cars.
#pragma once
#include "board.h"

constexpr int N_CARS = 8;  // one in each of rows 1 to 8

struct Freeway : Game {
    int y, move_timer, time_left;
    int cars[N_CARS];  // x, plus 16 times its timer, plus 256 times (5 + cells in five steps)
};
static_assert(sizeof(Freeway) == FREEWAY_FIELDS * sizeof(int), "FREEWAY_FIELDS");

constexpr int CHICKEN_X = 4, CHICKEN_INTERVAL = 3, SLOWEST = 5;

HD int car_x(int car) { return car & 15; }
HD int car_timer(int car) { return car >> 4 & 15; }
// Steps between two moves, negative if it drives to the left.
HD int car_speed(int car) { return (car >> 8 & 15) - SLOWEST; }
HD int car_of(int x, int timer, int speed) { return x + 16 * timer + 256 * (speed + SLOWEST); }
HD int magnitude(int speed) { return speed < 0 ? -speed : speed; }

// Draws eight speeds, then eight directions.
HD void draw_cars(Freeway& g, const Env& e) {
    int speeds[N_CARS];
    for (int i = 0; i < N_CARS; i++)
        speeds[i] = 1 + draw_below(g, e, SLOWEST);
    for (int i = 0; i < N_CARS; i++) {
        int speed = draw(g, e) < HALF ? -speeds[i] : speeds[i];
        g.cars[i] = car_of(car_x(g.cars[i]), speeds[i], speed);
    }
}

HD void begin(Freeway& g, const Env& e) {
    for (int i = 0; i < N_CARS; i++)
        g.cars[i] = 0;
    draw_cars(g, e);
    g.y = LAST;
    g.move_timer = CHICKEN_INTERVAL;
    g.time_left = FREEWAY_STEPS - 1;
}

HD Outcome play(Freeway& g, const Env& e, int action) {
    Outcome outcome = {0, 0};
    if ((action == UP || action == DOWN) && g.move_timer == 0) {
        g.move_timer = CHICKEN_INTERVAL;
        g.y = moved(g.y, action, UP, DOWN, 0, LAST);
    }
    if (g.y == 0) {
        outcome.reward = 1;
        draw_cars(g, e);
        g.y = LAST;
    }
    for (int i = 0; i < N_CARS; i++) {
        int x = car_x(g.cars[i]), timer = car_timer(g.cars[i]), speed = car_speed(g.cars[i]);
        if (x == CHICKEN_X && g.y == i + 1)
            g.y = LAST;
        if (timer == 0) {
            timer = magnitude(speed);
            x += speed > 0 ? 1 : -1;
            x = x < 0 ? LAST : x > LAST ? 0 : x;
            if (x == CHICKEN_X && g.y == i + 1)
                g.y = LAST;
        } else {
            timer--;
        }
        g.cars[i] = car_of(x, timer, speed);
    }
    g.move_timer -= g.move_timer > 0;
    outcome.is_terminal = --g.time_left < 0;
    return outcome;
}

// Channels: chicken, car, and the trails of cars that move every 1 to 5 steps.
HD void observe(const Freeway& g, const Env&, unsigned int* bits) {
    set_cell(bits, 0, g.y, CHICKEN_X);
    for (int i = 0; i < N_CARS; i++) {
        int x = car_x(g.cars[i]), speed = car_speed(g.cars[i]);
        int from = speed > 0 ? x - 1 : x + 1;
        set_cell(bits, 1, i + 1, x);
        set_cell(bits, 1 + within(magnitude(speed), SLOWEST), i + 1,
                 from < 0      ? LAST
                 : from > LAST ? 0
                               : from);
    }
}
