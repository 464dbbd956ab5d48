// One thread per environment; then the block writes its pictures together, 8 pixels at once.
#include "pong.h"

// The 8 pixels of a picture from `first` on, the first in the lowest place.
DEVICE unsigned long long pixel_word(const Picture& picture, int word) {
    int row = word / 5, part = word % 5, first = 8 * word;
    unsigned long long pixels = 0;
    if (part == 0 && (unsigned int)(row - picture.own) < PADDLE / CELL)
        pixels = PADDLE_GREY;
    if (part == 4 && (unsigned int)(row - picture.other) < PADDLE / CELL)
        pixels = (unsigned long long)PADDLE_GREY << 56;
    int trail = 8 * (picture.trail - first), ball = 8 * (picture.ball - first);
    if ((unsigned int)trail < 64)
        pixels = (pixels & ~(255ull << trail)) | ((unsigned long long)TRAIL << trail);
    if ((unsigned int)ball < 64)
        pixels |= (unsigned long long)BALL << ball;
    return pixels;
}

KERNEL pong(PongParams p) {
    __shared__ Picture pictures[2 * BLOCK];
    int first_env = blockIdx.x * BLOCK, env = first_env + threadIdx.x;
    if (env < p.n_envs) {
        Game game = pong_env(p, env);
        for (int side = 0; side < p.n_sides; side++)
            pictures[threadIdx.x * p.n_sides + side] = picture_of(game, side);
    }
    if (!p.pixels)
        return;
    __syncthreads();
    int n_words = WORDS * p.n_sides * mini(BLOCK, p.n_envs - first_env);
    unsigned long long* out =
        (unsigned long long*)p.pixels + (long long)WORDS * p.n_sides * first_env;
    for (int i = threadIdx.x; i < n_words; i += BLOCK)
        out[i] = pixel_word(pictures[i / WORDS], i % WORDS);
}
