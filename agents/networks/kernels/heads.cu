// The heads of an update, from one product of the features with the weights of all of them: the
// log-probability of the actions and the entropy, the value, the error of the auxiliary prediction,
// and the gradient of that product. A row of the gradient has the prediction, the scores of the
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

// Eight threads per row, of which one is for the actions.
KERNEL __launch_bounds__(256) heads_forward(HeadsForwardParams p) {
    wait_for_previous();
    int start = (int)blockIdx.x * HEADS_ROWS, first_score = padded(p.n_predicted);

    int row = start + (int)threadIdx.x;
    if (p.logprobs && threadIdx.x < HEADS_ROWS && row < p.n_rows) {
        float logprob = 0.f, entropy = 0.f;
        long long at = (long long)row * p.product_stride + first_score;
        const Bfloat16* scores = (const Bfloat16*)p.product + at;
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
    bool exists = start + (int)threadIdx.x / 8 < p.n_rows;
    row = min(start + (int)threadIdx.x / 8, p.n_rows - 1);  // all threads of a warp shuffle
    float value = 0.f, error = 0.f;
#pragma unroll 4
    for (int column = WORD * part; column < p.width; column += 8 * WORD) {
        float hidden[WORD], weight[WORD];
        read<Bfloat16>(hidden, p.hidden, (long long)row * p.hidden_stride + column);
        read_value_weight(weight, p.value_weight, column);
        for (int n = 0; n < WORD; n++)
            value += is_cleared(hidden[n], p.value_weight) ? 0.f : hidden[n] * weight[n];
    }
    for (int column = WORD * part; column < p.n_predicted; column += 8 * WORD) {
        float predicted[WORD], expected[WORD];
        read<Bfloat16>(predicted, p.product, (long long)row * p.product_stride + column);
        read<Bfloat16>(expected, p.target, (long long)row * first_score + column);
        for (int n = 0; n < WORD; n++) {
            float difference = predicted[n] - expected[n];
            error += column + n < p.n_predicted ? difference * difference : 0.f;
        }
    }
    value = sum_of_threads<8>(value);
    error = sum_of_threads<8>(error);
    if (part || !exists)
        return;
    value += p.value_bias ? *p.value_bias : 0.f;
    p.values[row] = value * *p.value_scale + *p.value_mean;
    if (p.errors)
        p.errors[row] = error / (float)p.n_predicted;
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
    long long at = (long long)row * p.product_stride + index.first_score;
    const Bfloat16* scores = (const Bfloat16*)p.product + at;
    at = (long long)row * index.n_columns + index.first_score;
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
        Pack<Bfloat16, WORD> words[AT_ONCE], targets[AT_ONCE];
        float d_errors[AT_ONCE];
        auto load_row = [&](int i, long long row) {
            load(words[i], is_score ? p.d_product : p.product,
                 row * (is_score ? index.n_columns : p.product_stride) + column);
            // a score has no target: reads whatever is in the first columns
            int target = is_score ? 0 : column;
            if (index.first_score)
                load(targets[i], p.target, row * index.first_score + target);
            d_errors[i] = index.first_score ? p.d_errors[row] : 0.f;
        };
        for_rows(strip, load_row, [&](int i, int row) {
            float values[WORD], expected[WORD];
            unpack(values, words[i]);
            if (!is_score) {
                unpack(expected, targets[i]);
                float d_error = d_errors[i] * 2.f / (float)p.n_predicted;
                for (int n = 0; n < WORD; n++) {
                    float d = d_error * (values[n] - expected[n]);
                    values[n] = column + n < p.n_predicted ? d : 0.f;
                }
                write<Bfloat16>(p.d_product, (long long)row * index.n_columns + column, values);
            }
            for (int n = 0; n < WORD; n++)
                sums[n] += values[n];
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
    Pack<Bfloat16, WORD> words[AT_ONCE];
    float d_values[AT_ONCE];
    auto load_row = [&](int i, long long row) {
        load(words[i], p.hidden, row * p.hidden_stride + column);
        d_values[i] = p.d_values[row];
    };
    for_rows(strip, load_row, [&](int i, int row) {
        float hidden[WORD], d_value = d_values[i] * scale;
        unpack(hidden, words[i]);
        bias_sum[0] += d_value;
        for (int n = 0; n < WORD; n++) {
            bool is_off = is_cleared(hidden[n], p.value_weight);
            weight_sums[n] += is_off ? 0.f : d_value * hidden[n];
            hidden[n] = is_off ? 0.f : d_value * weight[n];
            sums[n] += hidden[n];
        }
        write<Bfloat16>(p.d_product, (long long)row * index.n_columns + index.first_hidden + column,
                        hidden);
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
