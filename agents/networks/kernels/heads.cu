// The heads of an update, from one product of the features with the weights of all of them: the
// log-probability of the actions and the entropy, the value, the error of the auxiliary prediction,
// and the gradient of that product. A row of the product has the prediction, the scores of the
// actions, and the critic's hidden layer before its ReLU, each padded to a multiple of 8. A plain
// critic, whose last layer has no weight here, has its value in place of that layer. Blocks are
// strips of rows.
#include "common/sums.h"
#include "strips.h"

constexpr int WORD = 8;  // bfloat16 numbers that a thread reads at once

DEVICE int padded(int n) { return (n + WORD - 1) / WORD * WORD; }

// The weights of the value of a word of hidden units, or of the word with a plain critic's value.
DEVICE void read_value_weight(float (&weight)[WORD], const float* from, int column) {
    if (from)
        return read_eight(weight, from + column);
    for (int n = 0; n < WORD; n++)
        weight[n] = column || n ? 0.f : 1.f;
}

// Whether the ReLU, which a plain critic has not, clears a hidden unit.
DEVICE bool is_cleared(float hidden, const float* value_weight) {
    return hidden <= 0.f && value_weight;
}

struct Softmax {
    float largest, log_total, entropy;
};

DEVICE float logit_of(Bfloat16 score, const Softmax& softmax) {
    return to_float(score) - softmax.largest - softmax.log_total;
}

DEVICE Softmax softmax_of(const Bfloat16* scores, int n) {
    Softmax softmax = {to_float(scores[0]), 0.f, 0.f};
    for (int k = 1; k < n; k++)
        softmax.largest = fmaxf(softmax.largest, to_float(scores[k]));
    float total = 0.f;
    for (int k = 0; k < n; k++)
        total += expf(to_float(scores[k]) - softmax.largest);
    softmax.log_total = logf(total);
    for (int k = 0; k < n; k++) {
        float logit = logit_of(scores[k], softmax);
        softmax.entropy -= expf(logit) * logit;
    }
    return softmax;
}

// One thread per row for the actions; eight threads per row for the rest.
KERNEL __launch_bounds__(256) heads_forward(HeadsForwardParams p) {
    wait_for_previous();
    int start = (int)blockIdx.x * STRIP;
    int first_score = padded(p.n_predicted);
    int first_hidden = first_score + padded(p.n_agents * p.n_choices);
    int n_columns = first_hidden + p.width;
    const Bfloat16* product = (const Bfloat16*)p.product;

    int row = start + (int)threadIdx.x;
    if (p.logprobs && threadIdx.x < STRIP && row < p.n_rows) {
        float logprob = 0.f, entropy = 0.f;
        const Bfloat16* scores = product + (long long)row * n_columns + first_score;
        for (int agent = 0; agent < p.n_agents; agent++, scores += p.n_choices) {
            Softmax softmax = softmax_of(scores, p.n_choices);
            long long action = p.actions[(long long)row * p.n_agents + agent];
            logprob += logit_of(scores[action], softmax);
            entropy += softmax.entropy;
        }
        p.logprobs[row] = logprob;
        p.entropies[row] = entropy;
    }

    int part = threadIdx.x % 8;
    for (int i = threadIdx.x / 8; i < STRIP; i += STRIP_THREADS / 8) {
        row = min(start + i, p.n_rows - 1);  // all threads of a warp shuffle
        const Bfloat16* columns = product + (long long)row * n_columns;
        float value = 0.f, error = 0.f;
#pragma unroll 4
        for (int column = WORD * part; column < p.width; column += 8 * WORD) {
            float hidden[WORD], weight[WORD];
            read<Bfloat16>(hidden, columns, first_hidden + column);
            read_value_weight(weight, p.value_weight, column);
            for (int n = 0; n < WORD; n++)
                value += is_cleared(hidden[n], p.value_weight) ? 0.f : hidden[n] * weight[n];
        }
        for (int column = WORD * part; column < p.n_predicted; column += 8 * WORD) {
            float predicted[WORD], expected[WORD];
            read<Bfloat16>(predicted, columns, column);
            read<Bfloat16>(expected, p.target, (long long)row * first_score + column);
            for (int n = 0; n < WORD; n++) {
                float difference = predicted[n] - expected[n];
                error += column + n < p.n_predicted ? difference * difference : 0.f;
            }
        }
        value = sum_of_threads<8>(value);
        error = sum_of_threads<8>(error);
        if (part || start + i >= p.n_rows)
            continue;
        value += p.value_bias ? *p.value_bias : 0.f;
        p.values[row] = value * *p.value_scale + *p.value_mean;
        if (p.errors)
            p.errors[row] = error / (float)p.n_predicted;
    }
}

// ---- Backward ----

struct HeadsIndex {
    int strip;
    int first_score, first_hidden, n_columns;
    float* sums;  // of this block's strip
};

// The gradient of the scores, one thread per row. The entropy's is -p (logit + entropy).
DEVICE void scores_backward(const HeadsBackwardParams& p, const HeadsIndex& index) {
    int row = index.strip * STRIP + (int)threadIdx.x;
    if (threadIdx.x >= STRIP || row >= p.n_rows)
        return;
    long long at = (long long)row * index.n_columns + index.first_score;
    const Bfloat16* scores = (const Bfloat16*)p.product + at;
    Bfloat16* d_scores = (Bfloat16*)p.d_product + at;
    float d_logprob = p.d_logprobs[row], d_entropy = p.d_entropies[row];
    int n = p.n_choices, n_scores = p.n_agents * n;
    for (int agent = 0; agent < p.n_agents; agent++) {
        Softmax softmax = softmax_of(scores + agent * n, n);
        long long action = p.actions[(long long)row * p.n_agents + agent];
        for (int k = 0; k < n; k++) {
            float logit = logit_of(scores[agent * n + k], softmax), probability = expf(logit);
            float d = d_logprob * ((action == k ? 1.f : 0.f) - probability) -
                      d_entropy * probability * (logit + softmax.entropy);
            assign(d_scores[agent * n + k], d);
        }
    }
    for (int k = n_scores; k < padded(n_scores); k++)
        assign(d_scores[k], 0.f);
}

// The gradients of the prediction and of the scores, and their sums.
DEVICE void actor_backward(const HeadsBackwardParams& p, const HeadsIndex& index) {
    scores_backward(p, index);
    __syncthreads();
    int n_words = index.first_hidden / WORD;
    for (int first_word = 0; first_word < n_words; first_word += WARP) {
        Strip strip = find_strip(index.strip, min(n_words - first_word, WARP), p.n_rows);
        int column = WORD * (first_word + strip.word);
        bool is_score = column >= index.first_score;
        float sums[WORD];
        clear(sums);
        float values[AT_ONCE][WORD], expected[AT_ONCE][WORD], d_errors[AT_ONCE];
        auto load = [&](int i, long long row) {
            read<Bfloat16>(values[i], is_score ? p.d_product : p.product,
                           row * index.n_columns + column);
            // a score has no target: reads whatever is in the first columns
            int target = is_score ? 0 : column;
            if (index.first_score)
                read<Bfloat16>(expected[i], p.target, row * index.first_score + target);
            d_errors[i] = index.first_score ? p.d_errors[row] * 2.f / (float)p.n_predicted : 0.f;
        };
        for_rows(strip, load, [&](int i, int row) {
            if (!is_score) {
                for (int n = 0; n < WORD; n++) {
                    float d = d_errors[i] * (values[i][n] - expected[i][n]);
                    values[i][n] = column + n < p.n_predicted ? d : 0.f;
                }
                write<Bfloat16>(p.d_product, (long long)row * index.n_columns + column, values[i]);
            }
            for (int n = 0; n < WORD; n++)
                sums[n] += values[i][n];
        });
        add_up(sums, strip, index.sums + WORD * first_word, WORD * strip.words);
    }
}

// The gradients of 32 words of the critic's hidden layer and of the value's weights.
DEVICE void critic_backward(const HeadsBackwardParams& p, const HeadsIndex& index, int part) {
    int first_word = WARP * part;
    Strip strip = find_strip(index.strip, min(p.width / WORD - first_word, WARP), p.n_rows);
    int column = WORD * (first_word + strip.word);
    float weight[WORD], sums[WORD], weight_sums[WORD], bias_sum[1];
    read_value_weight(weight, p.value_weight, column);
    clear(sums);
    clear(weight_sums);
    clear(bias_sum);
    float scale = *p.value_scale;
    float hidden[AT_ONCE][WORD], d_values[AT_ONCE];
    auto load = [&](int i, long long row) {
        read<Bfloat16>(hidden[i], p.product, row * index.n_columns + index.first_hidden + column);
        d_values[i] = p.d_values[row] * scale;
    };
    for_rows(strip, load, [&](int i, int row) {
        bias_sum[0] += d_values[i];
        for (int n = 0; n < WORD; n++) {
            bool is_off = is_cleared(hidden[i][n], p.value_weight);
            weight_sums[n] += is_off ? 0.f : d_values[i] * hidden[i][n];
            hidden[i][n] = is_off ? 0.f : d_values[i] * weight[n];
            sums[n] += hidden[i][n];
        }
        write<Bfloat16>(p.d_product, (long long)row * index.n_columns + index.first_hidden + column,
                        hidden[i]);
    });
    float* target = index.sums + WORD * first_word;
    add_up(sums, strip, target + index.first_hidden, WORD * strip.words);
    if (!p.value_weight)
        return;
    add_up(weight_sums, strip, target + index.n_columns, WORD * strip.words);
    if (!part)
        add_up(bias_sum, strip, index.sums + index.n_columns + p.width, 1);
}

// Neighbouring blocks have one strip: one has prediction and scores, the others the hidden layer.
KERNEL __launch_bounds__(256) heads_backward(HeadsBackwardParams p) {
    wait_for_previous();
    int n_parts = 1 + (p.width / WORD + WARP - 1) / WARP, part = blockIdx.x % n_parts;
    HeadsIndex index;
    index.strip = blockIdx.x / n_parts;
    index.first_score = padded(p.n_predicted);
    index.first_hidden = index.first_score + padded(p.n_agents * p.n_choices);
    index.n_columns = index.first_hidden + p.width;
    index.sums = p.sums + index.strip * (long long)(index.n_columns + p.width + WORD);
    if (part)
        critic_backward(p, index, part - 1);
    else
        actor_backward(p, index);
}
