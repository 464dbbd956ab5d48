// What every kernel for the GPU includes: KERNEL declares an operation that Python can launch,
// DEVICE a function for the GPU.
#pragma once

#define KERNEL extern "C" __global__ void
#define DEVICE static __device__ __forceinline__

// The first statement of a kernel that may be set up while the one before it in the stream still
// runs (CUDA's programmatic dependent launch, compute capability 9.0 and later; elsewhere this does
// nothing). `wait` returns once that kernel, and so all before it, has completed and its writes are
// visible. `launch_dependents` lets the next kernel start in the same way, once all blocks of this
// one have got here.
//
// Do not read global memory by `__ldg` or through `const __restrict__` pointers in such a kernel:
// the compiler takes it as constant during the launch, and may read it before the wait.
DEVICE void wait_for_previous() {
#if __CUDA_ARCH__ >= 900
    asm volatile("griddepcontrol.wait;\n\tgriddepcontrol.launch_dependents;" ::: "memory");
#endif
}

// A kernel that does what one function does, such as an instance of a template.
#define INSTANCE(operation, Params, ...) \
    KERNEL operation(Params p) {         \
        wait_for_previous();             \
        __VA_ARGS__(p);                  \
    }
