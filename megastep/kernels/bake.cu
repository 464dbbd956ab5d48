// One thread a static texel: ambient light, and every light of its design that no wall of the design hides.
KERNEL bake(Bake p) {
    int texel = blockIdx.x * blockDim.x + threadIdx.x;
    if (texel >= p.n_texels) return;
    const World& w = p.world;
    int wall = p.texel_wall[texel], design = p.wall_design[wall];
    int first = w.texel_starts[wall], width = w.texel_starts[wall + 1] - first;
    float u = ((float)(texel - first) + 0.5f) / (float)width;
    const float* line = w.walls + 4 * (long long)wall;
    float x = mix(line[0], line[2], u), y = mix(line[1], line[3], u), sum = AMBIENT;
    for (int l = w.light_starts[design]; l < w.light_starts[design + 1]; l++) {
        const float* light = w.lights + 3 * l;
        float dx = x - light[0], dy = y - light[1];
        int hidden = 0;
        for (int j = w.wall_starts[design]; j < w.wall_starts[design + 1] && !hidden; j++) {
            float4 b = ((const float4*)w.walls)[j];
            hidden = blocks(blind_of(light[0], light[1], b.x, b.y, b.z, b.w), dx, dy);
        }
        if (!hidden) sum += glow(light[2], dx, dy);
    }
    w.texels[4 * (long long)texel + 3] = low(sum, 1.f);
}
