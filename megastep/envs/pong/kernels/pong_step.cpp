// A loop over environments. Each clears its images and draws the few pixels that are not black.
#include "pong_step.h"

static void draw(const Image& image, unsigned char* pixels) {
    __builtin_memset(pixels, 0, 8 * WORDS);
    for (int i = 0; i < PADDLE_ROWS; i++) {
        pixels[COLUMNS * (image.own_top + i)] = PADDLE_GREY;
        pixels[COLUMNS * (image.other_top + i) + COLUMNS - 1] = PADDLE_GREY;
    }
    pixels[image.trail] = TRAIL_GREY;
    pixels[image.ball] = BALL_GREY;
}

KERNEL pong_step(const PongStepParams& p) {
#pragma omp parallel for schedule(static) num_threads(p.n_threads)
    for (int env = 0; env < p.n_envs; env++) {
        Game game = pong_env(p, env);
        if (p.pixels)
            for (int side = 0; side < p.n_sides; side++) {
                long long lane = (long long)env * p.n_sides + side;
                draw(image_of(game, side), p.pixels + 8 * WORDS * lane);
            }
    }
}
