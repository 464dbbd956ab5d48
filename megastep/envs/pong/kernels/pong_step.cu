// One thread per environment. Then the block writes its images together, 8 pixels at once.
#include "pong_step.h"

// Pixels 8 * word to 8 * word + 7 of an image, the first one in the lowest byte.
DEVICE unsigned long long pixel_word(const Image& image, int word) {
    int row = word / 5, part = word % 5, first = 8 * word;
    unsigned long long pixels = 0;
    if (part == 0 && (unsigned int)(row - image.own_top) < PADDLE_ROWS)
        pixels = PADDLE_GREY;
    if (part == 4 && (unsigned int)(row - image.other_top) < PADDLE_ROWS)
        pixels = (unsigned long long)PADDLE_GREY << 56;
    int trail = 8 * (image.trail - first), ball = 8 * (image.ball - first);
    if ((unsigned int)trail < 64)
        pixels = (pixels & ~(255ull << trail)) | ((unsigned long long)TRAIL_GREY << trail);
    if ((unsigned int)ball < 64)
        pixels |= (unsigned long long)BALL_GREY << ball;
    return pixels;
}

KERNEL pong_step(PongStepParams p) {
    wait_for_previous();
    __shared__ Image images[2 * BLOCK];
    int first_env = blockIdx.x * BLOCK, env = first_env + threadIdx.x;
    if (env < p.n_envs) {
        Game game = pong_env(p, env);
        for (int side = 0; side < p.n_sides; side++)
            images[threadIdx.x * p.n_sides + side] = image_of(game, side);
    }
    if (!p.pixels)
        return;
    __syncthreads();
    int n_words = WORDS * p.n_sides * mini(BLOCK, p.n_envs - first_env);
    unsigned long long* out =
        (unsigned long long*)p.pixels + (long long)WORDS * p.n_sides * first_env;
    for (int i = threadIdx.x; i < n_words; i += BLOCK)
        out[i] = pixel_word(images[i / WORDS], i % WORDS);
}
