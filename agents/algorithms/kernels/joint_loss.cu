// The heads of a policy with one agent and a plain critic, PPO's loss, and its gradients back to
// the features, in one kernel. The heads are 16 columns: up to eight scores of actions, the value,
// and zeros. A warp has 16 rows. Of a 16 x 8 result, a thread holds rows g and g + 8 and columns
// 2 q and 2 q + 1, with g = thread / 4 and q = thread % 4 of the warp: four threads hold all
// columns of a row.
//
// A product adds up its inner axis in any order. So of 32 features a thread takes eight neighbours,
// which one instruction loads, and of the gradients of 32 features it computes eight neighbours.
#include "common/tensor_cores.h"
#include "ppo_row.h"

constexpr int COLUMNS = 8;    // of a result
constexpr int FEATURES = 32;  // at once
constexpr int PAD = 2;        // words after a row of weights, so that rows start in other banks

extern __shared__ __align__(16) unsigned char shared_memory[];

DEVICE float max_of_row(float x) {
    x = fmaxf(x, __shfl_xor_sync(~0u, x, 1));
    return fmaxf(x, __shfl_xor_sync(~0u, x, 2));
}

DEVICE const Bits* weights_of(const JointLossParams& p, int column) {
    const void* weights = column < COLUMNS ? p.weight : p.value_weight;
    return (const Bits*)weights + column % COLUMNS * p.width;
}

// Pairs of neighbouring columns' weights of each feature.
DEVICE void share_weights(const JointLossParams& p) {
    unsigned int* pairs = (unsigned int*)shared_memory;
    for (int i = threadIdx.x; i < COLUMNS * p.width; i += JOINT_THREADS) {
        int pair = i / p.width, feature = i % p.width;
        unsigned int low = weights_of(p, 2 * pair)[feature];
        unsigned int high = weights_of(p, 2 * pair + 1)[feature];
        pairs[pair * (p.width + PAD) + feature] = low | high << 16;
    }
}

DEVICE void multiply(float (&scores)[4], float (&values)[4], const Bits* const (&rows)[2],
                     const JointLossParams& p) {
    int g = threadIdx.x % WARP / 4, q = threadIdx.x % 4;
    for (int first = COLUMNS * q; first < p.width; first += FEATURES) {
        uint4 upper = *(const uint4*)(rows[0] + first), lower = *(const uint4*)(rows[1] + first);
        uint4 score = *(const uint4*)(weights_of(p, g) + first);
        uint4 value = *(const uint4*)(weights_of(p, COLUMNS + g) + first);
        unsigned int left[4] = {upper.x, lower.x, upper.y, lower.y};
        multiply_add(scores, left, score.x, score.y);
        multiply_add(values, left, value.x, value.y);
        unsigned int right[4] = {upper.z, lower.z, upper.w, lower.w};
        multiply_add(scores, right, score.z, score.w);
        multiply_add(values, right, value.z, value.w);
    }
}

// The gradients of one row's columns. Adds its shares to `sums`.
DEVICE void row_backward(unsigned int (&d)[2], float (&sums)[N_JOINT_SUMS], float first,
                         float second, float value, int row, const JointLossParams& p) {
    int q = threadIdx.x % 4, leader = threadIdx.x % WARP - q, at = min(row, p.n_rows - 1);
    bool exist[2] = {2 * q < p.n_choices, 2 * q + 1 < p.n_choices};
    float scores[2] = {first, second}, total = 0.f, entropy = 0.f, logprob = 0.f;
    for (int i = 0; i < 2; i++)
        scores[i] = exist[i] ? scores[i] : -__int_as_float(0x7f800000);
    float largest = max_of_row(fmaxf(scores[0], scores[1]));
    for (int i = 0; i < 2; i++)
        total += exist[i] ? expf(scores[i] - largest) : 0.f;
    float log_total = logf(sum_of_threads<4>(total));
    int action = (int)p.actions[at];
    for (int i = 0; i < 2; i++) {
        scores[i] -= largest + log_total;
        entropy -= exist[i] ? expf(scores[i]) * scores[i] : 0.f;
        logprob += action == 2 * q + i ? scores[i] : 0.f;
    }
    entropy = sum_of_threads<4>(entropy);
    logprob = sum_of_threads<4>(logprob);
    float scale = *p.value_scale;
    value = __shfl_sync(~0u, value, leader) * scale + *p.value_mean;
    RowLoss loss = loss_of(p, at, logprob, entropy, value, 0.f);
    float of_row = row < p.n_rows ? 1.f : 0.f, d_scores[2];
    for (int i = 0; i < 2; i++) {
        float probability = expf(scores[i]);
        float of_entropy = loss.d_entropy * probability * (scores[i] + entropy);
        float of_logprob = loss.d_logprob * ((action == 2 * q + i ? 1.f : 0.f) - probability);
        d_scores[i] = exist[i] && of_row ? of_logprob - of_entropy : 0.f;
    }
    d[0] = pack_bfloat16(d_scores[0], d_scores[1]);
    d[1] = pack_bfloat16(!q && of_row ? loss.d_value * scale : 0.f, 0.f);
    for (int i = 0; i < N_SUMS; i++)
        sums[i] += !q && of_row ? loss.sums[i] : 0.f;
    for (int i = 0; i < COLUMNS; i++)
        sums[N_SUMS + i] += i / 2 != q ? 0.f : i % 2 ? high_half(d[0]) : low_half(d[0]);
    sums[N_SUMS + COLUMNS] += low_half(d[1]);
}

DEVICE void features_backward(const unsigned int (&d)[2][2], const bool (&exist)[2],
                              const long long (&rows)[2], const JointLossParams& p) {
    int g = threadIdx.x % WARP / 4, q = threadIdx.x % 4;
    const unsigned int* pairs = (const unsigned int*)shared_memory + q * (p.width + PAD);
    unsigned int left[4] = {d[0][0], d[1][0], d[0][1], d[1][1]};
    for (int first = 0; first < p.width; first += FEATURES) {
        unsigned int upper[4], lower[4];
        for (int i = 0; i < 4; i++) {
            const unsigned int* weight = pairs + first + g / 2 * COLUMNS + 2 * i + g % 2;
            float results[4] = {};
            multiply_add(results, left, weight[0], weight[4 * (p.width + PAD)]);
            upper[i] = pack_bfloat16(results[0], results[1]);
            lower[i] = pack_bfloat16(results[2], results[3]);
        }
        uint4* target = (uint4*)((Bits*)p.d_features + first + COLUMNS * q);
        if (exist[0])
            target[rows[0] * p.width / 8] = {upper[0], upper[1], upper[2], upper[3]};
        if (exist[1])
            target[rows[1] * p.width / 8] = {lower[0], lower[1], lower[2], lower[3]};
    }
}

KERNEL __launch_bounds__(256) joint_loss(JointLossParams p) {
    wait_for_previous();
#if !defined(__CUDA_ARCH__) || __CUDA_ARCH__ >= 800
    share_weights(p);
    int q = threadIdx.x % 4;
    int first = JOINT_ROWS * blockIdx.x + threadIdx.x / WARP * 16 + threadIdx.x % WARP / 4;
    const Bits* features[2];
    long long rows[2];
    bool exist[2];
    for (int i = 0; i < 2; i++) {
        rows[i] = first + 8 * i;
        exist[i] = rows[i] < p.n_rows;
        features[i] = (const Bits*)p.features + min(rows[i], p.n_rows - 1ll) * p.width;
    }
    float scores[4], values[4], sums[N_JOINT_SUMS] = {};
    unsigned int bias = ((const unsigned int*)p.bias)[q];
    scores[0] = scores[2] = low_half(bias);
    scores[1] = scores[3] = high_half(bias);
    values[0] = values[1] = values[2] = values[3] = low_half(*(const Bits*)p.value_bias);
    multiply(scores, values, features, p);
    unsigned int d[2][2];
    for (int i = 0; i < 2; i++) {
        // rounded, as outputs of layers are
        unsigned int pair = pack_bfloat16(scores[2 * i], scores[2 * i + 1]);
        float value = low_half(pack_bfloat16(values[2 * i], 0.f));
        row_backward(d[i], sums, low_half(pair), high_half(pair), value, (int)rows[i], p);
        unsigned int* target = (unsigned int*)p.d_columns + rows[i] * COLUMNS + q;
        if (exist[i]) {
            target[0] = d[i][0];
            target[4] = d[i][1];
        }
    }
    __syncthreads();  // the weights are there
    features_backward(d, exist, rows, p);
    add_up<JOINT_THREADS>(sums, p.sums + blockIdx.x * N_JOINT_SUMS);
#endif
}
