// One warp per environment: each of its threads tests one wall at a time, and serves one agent.
#include "hideandseek_step.h"
#include "common/warp_cuda.h"

KERNEL hideandseek_step(HideAndSeekStepParams p) {
    wait_for_previous();
    int env = (blockIdx.x * blockDim.x + threadIdx.x) / WARP;
    if (env < p.scenery.n_envs)
        hideandseek_env(p, WholeWarp{(int)threadIdx.x % WARP}, env);
}
