// Adam with decoupled weight decay for many parameters in one launch, the norm of their gradients,
// whether a step is taken, and what ranks do with gradients before and after they sum them. A block
// handles neighbouring numbers of one parameter, a thread a word of four.
#include "common/numbers.h"
#include "common/rows.h"
#include "common/sums.h"
#include "params.h"

// Where a thread's word is: in a row, from a number on, `n` of its four numbers exist.
struct WordIndex {
    int row;
    long long first;
    int n;
    bool is_word;  // one instruction moves it
};

template <class Row>
DEVICE WordIndex find_index(const Row* rows, int n_rows) {
    int row = row_of_block(rows, n_rows);
    const Row& its = rows[row];
    unsigned int at = 4 * ((blockIdx.x - its.first_block) * ADAM_THREADS + threadIdx.x);
    int n = at < its.n ? (int)min(its.n - at, 4u) : 0;
    return {row, at, n, its.is_aligned && n == 4};
}

DEVICE void read_word(float (&values)[4], const float* array, const WordIndex& index) {
    if (index.is_word)
        return read<float>(values, array, index.first);
    for (int i = 0; i < 4; i++)
        values[i] = i < index.n ? array[index.first + i] : 0.f;
}

DEVICE void write_word(float* array, const WordIndex& index, const float (&values)[4]) {
    if (index.is_word)
        return write<float>(array, index.first, values);
    for (int i = 0; i < 4; i++)
        if (i < index.n)
            array[index.first + i] = values[i];
}

KERNEL __launch_bounds__(256) pack(PackParams p) {
    wait_for_previous();
    WordIndex index = find_index(p.rows, p.n_rows);
    const BucketRowParams& row = p.rows[index.row];
    float values[4], n_valid = *p.n_valid;
    read_word(values, row.source, index);
    for (int i = 0; i < 4; i++)
        values[i] *= n_valid;
    write_word(row.target, index, values);
    if (!blockIdx.x && !threadIdx.x)
        *p.total = n_valid;
}

KERNEL __launch_bounds__(256) divide(DivideParams p) {
    wait_for_previous();
    int at = 4 * (blockIdx.x * ADAM_THREADS + threadIdx.x);
    float values[4], total = *p.total;
    if (!at)
        *p.n_valid = total;
    if (at >= p.n)
        return;
    read<float>(values, p.bucket, at);
    for (int i = 0; i < 4; i++)
        values[i] /= fmaxf(total, 1.f);
    write<float>(p.bucket, at, values);
}

KERNEL __launch_bounds__(256) squared_norm(SquaredNormParams p) {
    wait_for_previous();
    WordIndex index = find_index(p.rows, p.n_rows);
    float values[4], sum[1] = {};
    read_word(values, p.rows[index.row].gradient, index);
    for (int i = 0; i < 4; i++)
        sum[0] += values[i] * values[i];
    add_up<ADAM_THREADS>(sum, p.sums + p.first_sum + blockIdx.x);
}

// One block. Decides whether a step is taken, and counts it and its metrics.
KERNEL __launch_bounds__(256) judge(JudgeParams p) {
    wait_for_previous();
    int n_totals = p.n_metrics + 3;
    __shared__ float total;
    float sum[1] = {};
    for (int i = threadIdx.x; i < p.n_sums; i += ADAM_THREADS)
        sum[0] += p.sums[i];
    add_up<ADAM_THREADS>(sum, &total);
    __syncthreads();
    float grad_norm = sqrtf(total);
    bool is_finite = isfinite(grad_norm) && *p.is_finite;
    bool is_enabled = !p.is_enabled || *p.is_enabled;
    bool is_taken = is_finite && is_enabled && *p.n_valid > 0;
    for (int i = threadIdx.x; i < n_totals; i += ADAM_THREADS) {
        float value = i < p.n_metrics ? *p.metrics[i].values : grad_norm;
        if (i == p.n_metrics + 1)
            value = 1.f;
        value = is_taken ? value : 0.f;
        if (i == p.n_metrics + 2)
            value = !is_finite && is_enabled ? 1.f : 0.f;
        p.totals[i] = p.is_first ? value : p.totals[i] + value;
    }
    if (threadIdx.x)
        return;
    *p.grad_norm = grad_norm;
    *p.is_taken = is_taken;
    *p.n_steps += is_taken ? 1.f : 0.f;
}

KERNEL __launch_bounds__(256) adam(AdamParams p) {
    wait_for_previous();
    if (!*p.is_taken)
        return;
    WordIndex index = find_index(p.rows, p.n_rows);
    const AdamRowParams& row = p.rows[index.row];
    float gradients[4], means[4], squares[4], parameters[4];
    read_word(gradients, row.gradient, index);
    read_word(means, row.mean, index);
    read_word(squares, row.square, index);
    read_word(parameters, row.parameter, index);
    float clip = fminf(p.max_norm / (*p.grad_norm + 1e-6f), 1.f);
    float lr = *p.lr * row.lr_factor, n_steps = *p.n_steps;
    float step = lr / (1.f - powf(p.beta1, n_steps));
    float scale = 1.f / sqrtf(1.f - powf(p.beta2, n_steps));
    for (int i = 0; i < 4; i++) {
        float gradient = gradients[i] * clip;
        means[i] += (1.f - p.beta1) * (gradient - means[i]);
        squares[i] = p.beta2 * squares[i] + (1.f - p.beta2) * gradient * gradient;
        parameters[i] = parameters[i] * (1.f - lr * row.weight_decay) -
                        step * means[i] / (sqrtf(squares[i]) * scale + p.eps);
    }
    write_word(row.mean, index, means);
    write_word(row.square, index, squares);
    write_word(row.parameter, index, parameters);
}
