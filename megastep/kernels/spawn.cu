// One thread a world.
KERNEL spawn(Spawn p) {
    int world = blockIdx.x * blockDim.x + threadIdx.x;
    if (world < p.world.n_worlds) spawn_world(p, world);
}
