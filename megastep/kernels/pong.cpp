// A loop over environments. Each clears its pictures and draws the few pixels in them.
#include "pong.h"

static void draw(const Picture& picture, unsigned char* pixels) {
    constexpr int COLUMNS = WIDTH / CELL;
    __builtin_memset(pixels, 0, 8 * WORDS);
    for (int i = 0; i < PADDLE / CELL; i++) {
        pixels[COLUMNS * (picture.own + i)] = PADDLE_GREY;
        pixels[COLUMNS * (picture.other + i) + COLUMNS - 1] = PADDLE_GREY;
    }
    pixels[picture.trail] = TRAIL;
    pixels[picture.ball] = BALL;
}

KERNEL pong(const PongParams& p) {
#pragma omp parallel for schedule(static) num_threads(p.n_threads)
    for (int env = 0; env < p.n_envs; env++) {
        Game game = pong_env(p, env);
        if (p.pixels)
            for (int side = 0; side < p.n_sides; side++) {
                long long lane = (long long)env * p.n_sides + side;
                draw(picture_of(game, side), p.pixels + 8 * WORDS * lane);
            }
    }
}
