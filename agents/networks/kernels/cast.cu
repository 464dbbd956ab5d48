// Rounds weights to bfloat16, many in one launch, with zeros after each. A thread writes a word of
// eight numbers.
#include "common/rows.h"
#include "common/numbers.h"
#include "params.h"

KERNEL __launch_bounds__(256) cast(CastParams p) {
    wait_for_previous();
    const CastRowParams& its = p.rows[row_of_block(p.rows, p.n_rows)];
    unsigned int at = 8 * ((blockIdx.x - its.first_block) * CAST_THREADS + threadIdx.x);
    if (at >= its.n_padded)
        return;
    const float* source = its.source + at;
    float values[8];
    if (at + 8 <= its.n && (unsigned long long)source % 16 == 0)
        read_eight(values, source);
    else
        for (int i = 0; i < 8; i++)
            values[i] = at + i < its.n ? source[i] : 0.f;
    write<Bfloat16>(its.target, at, values);
}
