// Packs many arrays, times a number, into a bucket, and divides the bucket once it is summed over
// the ranks. A thread handles a word of four numbers. Bits are those of PyTorch's operations.
#include "common/constants.h"
#include "common/dependent_launch.h"
#include "constants.h"
#include "params.h"

static_assert(sizeof(PackParams::rows) == PACK_ROWS * sizeof(PackRowParams));

KERNEL pack(PackParams p) {
    wait_for_previous();
    int row = 0, end = p.n_rows;  // the last row that begins at or before this block
    while (end - row > 1) {
        int middle = (row + end) / 2;
        (p.rows[middle].first_block <= blockIdx.x ? row : end) = middle;
    }
    const PackRowParams& its = p.rows[row];
    unsigned int at = 4 * ((blockIdx.x - its.first_block) * PACK_THREADS + threadIdx.x);
    if (at >= its.n_padded)
        return;
    float factor = p.is_float ? *(const float*)p.n_valid : (float)*(const long long*)p.n_valid;
    const float* source = its.source + at;
    float* target = p.bucket + its.first + at;
    if (its.source && at + 4 <= its.n &&
        !(((unsigned long long)source | (unsigned long long)target) % 16)) {
        float4 word = *(const float4*)source;
        *(float4*)target =
            make_float4(word.x * factor, word.y * factor, word.z * factor, word.w * factor);
        return;
    }
    for (unsigned int i = 0; i < 4 && at + i < its.n_padded; i++)
        target[i] = (at + i >= its.n ? 0.f : its.source ? source[i] : 1.f) * factor;
}

KERNEL divide(DivideParams p) {
    wait_for_previous();
    int at = 4 * (blockIdx.x * blockDim.x + threadIdx.x);
    if (at >= p.n)
        return;
    float count = p.bucket[p.count], divisor = count < 1.f ? 1.f : count;
    float4 word = *(const float4*)(p.bucket + at);
    *(float4*)(p.average + at) =
        make_float4(word.x / divisor, word.y / divisor, word.z / divisor, word.w / divisor);
    if (p.count - at >= 0 && p.count - at < 4)
        p.average[p.count] = count;
}
