// PPO's loss, with its gradients and metrics, all means over valid rows. One thread per row; a
// block adds up its rows in a fixed order, the caller the blocks.
#include "ppo_row.h"

KERNEL ppo_loss(PpoLossParams p) {
    wait_for_previous();
    int row = blockIdx.x * blockDim.x + threadIdx.x;
    RowLoss loss = {};
    if (row < p.n_rows) {
        float error = p.errors ? p.errors[row] : 0.f;
        loss = loss_of(p, row, p.logprobs[row], p.entropies[row], p.values[row], error);
        p.d_logprobs[row] = loss.d_logprob;
        p.d_values[row] = loss.d_value;
        p.d_entropies[row] = loss.d_entropy;
        if (p.errors)
            p.d_errors[row] = *p.auxiliary_coef * loss.weight;
    }
    add_up<BLOCK>(loss.sums, p.sums + blockIdx.x * N_SUMS);
}
