// One thread a lane.
KERNEL draw(Draw p) {
    int lane = blockIdx.x * blockDim.x + threadIdx.x;
    if (lane < p.n_lanes) draw_lane(p, lane);
}
