// What common/tensor_cores.h has, for kernels that blocks_on_cpu.h runs on a CPU. A GPU copies and
// sends in its own time. Here it is done at once, as late as it may be (`is_late`), or either
// (`is_mixed`): whoever reads too early, or overwrites what is still to be read, gets other numbers
// in one of these.
// What a barrier makes visible is not modelled, and loads and products of matrices are barriers of
// a warp.
#pragma once

#define __cluster_dims__(...)
#define __align__(n) alignas(n)

// ---- Numbers ----

typedef unsigned short Bits;

DEVICE float low_half(unsigned int pair) { return __uint_as_float(pair << 16); }

DEVICE float high_half(unsigned int pair) { return __uint_as_float(pair & 0xffff0000u); }

DEVICE unsigned int bfloat16_bits(float x) {
    unsigned int bits = __float_as_uint(x);
    return isnan(x) ? 0x7fffu : (bits + 0x7fffu + (bits >> 16 & 1)) >> 16;
}

DEVICE unsigned int pack_bfloat16(float low, float high) {
    return bfloat16_bits(low) | bfloat16_bits(high) << 16;
}

DEVICE unsigned int pack_relu(float low, float high) {
    return pack_bfloat16(low < 0.f ? 0.f : low, high < 0.f ? 0.f : high);
}

DEVICE unsigned int where_active(unsigned int activated, unsigned int pair) {
    unsigned int mask = low_half(activated) <= 0.f ? 0u : 0xffffu;
    mask |= high_half(activated) <= 0.f ? 0u : 0xffff0000u;
    return pair & mask;
}

DEVICE float tanh_of(float x) { return tanhf(x); }

DEVICE float sigmoid(float x) { return 0.5f * tanh_of(0.5f * x) + 0.5f; }

DEVICE void check_aligned(const void* address, int n_bytes) {
    if ((Bits64)address % n_bytes)
        fail("uses an address that is not aligned", current);
}

// ---- Tensor cores ----

// Lanes 8 i to 8 i + 7 of the warp give the rows of matrix i. Thread 4 g + q gets numbers 2 q and
// 2 q + 1 of row g; transposed, row g of columns 2 q and 2 q + 1.
template <int N>
DEVICE void load_rows(unsigned int (&parts)[N], const void* row, bool is_transposed) {
    check_aligned(row, 16);
    int lane = current % WARP, g = lane / 4, q = lane % 4;
    Bits64* rows = meet(~0u, (Bits64)row, LOAD_MATRICES);
    for (int i = 0; i < N; i++) {
        auto number = [&](int r, int column) -> unsigned int {
            return ((const unsigned short*)rows[8 * i + r])[column];
        };
        parts[i] = is_transposed ? number(2 * q, g) | number(2 * q + 1, g) << 16
                                 : number(g, 2 * q) | number(g, 2 * q + 1) << 16;
    }
    __syncwarp();  // no thread goes on before all have read
}

DEVICE void load_matrices(unsigned int (&parts)[2], const void* row) {
    load_rows(parts, row, false);
}

DEVICE void load_transposed(unsigned int (&parts)[2], const void* row) {
    load_rows(parts, row, true);
}

DEVICE void load_four(unsigned int (&first)[2], unsigned int (&second)[2], const void* row,
                      bool is_transposed) {
    unsigned int parts[4];
    load_rows(parts, row, is_transposed);
    first[0] = parts[0];
    first[1] = parts[1];
    second[0] = parts[2];
    second[1] = parts[3];
}

DEVICE void load_matrices(unsigned int (&parts)[4], const void* row) {
    load_rows(parts, row, false);
}

DEVICE void load_matrices(unsigned int (&first)[2], unsigned int (&second)[2], const void* row) {
    load_four(first, second, row, false);
}

DEVICE void load_transposed(unsigned int (&first)[2], unsigned int (&second)[2], const void* row) {
    load_four(first, second, row, true);
}

DEVICE float dot(unsigned int a, unsigned int b) {
    return low_half(a) * low_half(b) + high_half(a) * high_half(b);
}

DEVICE void multiply_add(float (&sum)[4], const unsigned int (&a)[4], unsigned int b0,
                         unsigned int b1) {
    int lane = current % WARP, g = lane / 4, q = lane % 4;
    unsigned int left[2][2][4], right[2][2][4];  // by row or column, half of the inner axis
    for (int half = 0; half < 2; half++) {
        Bits64* words = meet(~0u, a[2 * half] | (Bits64)a[2 * half + 1] << 32, MULTIPLY);
        for (int i = 0; i < 4; i++) {
            left[0][half][i] = (unsigned int)words[4 * g + i];
            left[1][half][i] = words[4 * g + i] >> 32;
        }
    }
    Bits64* words = meet(~0u, b0 | (Bits64)b1 << 32, MULTIPLY);
    for (int e = 0; e < 2; e++)
        for (int i = 0; i < 4; i++) {
            right[e][0][i] = (unsigned int)words[4 * (2 * q + e) + i];
            right[e][1][i] = words[4 * (2 * q + e) + i] >> 32;
        }
    for (int row = 0; row < 2; row++)
        for (int e = 0; e < 2; e++)
            for (int half = 0; half < 2; half++)
                for (int i = 0; i < 4; i++)
                    sum[2 * row + e] += dot(left[row][half][i], right[e][half][i]);
}

// ---- Copies and clusters ----

DEVICE void begin_job(std::vector<Job>& list, Job job) {
    if (is_late && !(is_mixed && random_below(2)))
        list.push_back(job);
    else
        job();
}

DEVICE void begin_copy(void* shared, const void* global) {
    check_aligned(shared, 16);
    check_aligned(global, 16);
    begin_job(fibers[current].copies.back(), [=] { memcpy(shared, global, 16); });
}

template <int n_bytes>
DEVICE void begin_copy_or_clear(void* shared, const void* global, bool exists) {
    check_aligned(shared, n_bytes);
    if (exists)
        check_aligned(global, n_bytes);
    begin_job(fibers[current].copies.back(), [=] {
        if (exists)
            memcpy(shared, global, n_bytes);
        else
            memset(shared, 0, n_bytes);
    });
}

DEVICE void end_group() { fibers[current].copies.emplace_back(); }

template <int n>
DEVICE void wait_for_copies() {
    std::deque<std::vector<Job>>& groups = fibers[current].copies;
    while (groups.size() > n + 1) {
        for (Job& job : groups.front())
            job();
        groups.pop_front();
    }
}

DEVICE unsigned int cluster_rank() { return block_rank(); }

DEVICE void cluster_barrier() { meet_all(cluster_barriers, 0, n_fibers, 0); }

struct Arrivals {
    int bytes;  // to come in this phase
    short is_announced, phase;
};

DEVICE void end_phase(Arrivals* arrivals) {
    n_events++;
    if (!arrivals->is_announced || arrivals->bytes)
        return;
    arrivals->is_announced = 0;
    arrivals->phase++;
}

DEVICE void init(Arrivals* arrivals) { *arrivals = {0, 0, 0}; }

DEVICE void expect(Arrivals* arrivals, int n_bytes) {
    if (arrivals->is_announced)
        fail("announces bytes before those of the last phase have come", current);
    arrivals->is_announced = 1;
    arrivals->bytes += n_bytes;
    end_phase(arrivals);
}

DEVICE void wait_for(Arrivals* arrivals, int phase) {
    while ((arrivals->phase & 1) == (phase & 1))
        yield();
}

// Shared memory lives until all threads of its block have ended.
DEVICE void check_alive(unsigned int rank) {
    for (int i = 0; i < n_threads_of_block; i++)
        if (!fibers[rank * n_threads_of_block + i].is_done)
            return;
    snprintf(failure, sizeof failure, "block %u: something arrives after its end",
             first_block + rank);
}

DEVICE void begin_copy(void* shared, const void* global, int n_bytes, Arrivals* arrivals) {
    check_aligned(shared, 16);
    check_aligned(global, 16);
    if (n_bytes % 16)
        fail("copies no multiple of 16 bytes", current);
    unsigned int rank = block_rank();
    begin_job(jobs, [=] {
        check_alive(rank);
        memcpy(shared, global, n_bytes);
        arrivals->bytes -= n_bytes;
        end_phase(arrivals);
    });
}

DEVICE unsigned int address_in(const void* shared, unsigned int rank) {
    return rank * SHARED_BYTES + (unsigned int)((const unsigned char*)shared - dynamic_shared);
}

DEVICE void publish() {}

DEVICE void send(unsigned int target, const void* source, int n_bytes, unsigned int arrivals) {
    check_aligned(cluster_shared[0] + target, 16);
    check_aligned(source, 16);
    if (n_bytes % 16)
        fail("sends no multiple of 16 bytes", current);
    begin_job(jobs, [=] {
        check_alive(target / SHARED_BYTES);
        memcpy(cluster_shared[0] + target, source, n_bytes);
        Arrivals* there = (Arrivals*)(cluster_shared[0] + arrivals);
        there->bytes -= n_bytes;
        end_phase(there);
    });
}
