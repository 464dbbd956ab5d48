// Philox 4x32-10 (Salmon et al. 2011), a random generator without state. The key is the seed and
// the counter is (lane, draw), so a lane's k-th draw is the same on every device and in any order.
#pragma once
#include "common/backend.h"

struct Philox {
    unsigned int a, b, c, d;
};

HD Philox philox(unsigned int lane, unsigned int draw, unsigned int key0, unsigned int key1) {
    Philox x = {lane, draw, 0u, 0u};
    for (int round = 0; round < 10; round++) {
        unsigned long long p = 0xD2511F53ull * x.a;
        unsigned long long q = 0xCD9E8D57ull * x.c;
        x = {(unsigned int)(q >> 32) ^ x.b ^ key0, (unsigned int)q,
             (unsigned int)(p >> 32) ^ x.d ^ key1, (unsigned int)p};
        key0 += 0x9E3779B9u;
        key1 += 0xBB67AE85u;
    }
    return x;
}

RARE unsigned int random_word(int lane, int draw, unsigned int key0, unsigned int key1) {
    return philox((unsigned int)lane, (unsigned int)draw, key0, key1).a;
}

// A number in [0, 1) from the upper 24 bits, which a float holds exactly.
HD float unit_float(unsigned int bits) { return (float)(bits >> 8) * (1.f / 16777216.f); }

// An integer in [0, n) from the same bits.
HD int below(unsigned int bits, int n) { return (int)(unit_float(bits) * (float)n); }

// A lane's next random bits, by the number of its draws so far, which it counts. That wraps, as the
// counter does.
HD Philox next_draw(int* counts, int lane, unsigned int key0, unsigned int key1) {
    unsigned int draw = (unsigned int)counts[lane];
    counts[lane] = (int)(draw + 1u);
    return philox((unsigned int)lane, draw, key0, key1);
}
