// What every kernel for the GPU includes: KERNEL declares an operation that Python can launch,
// DEVICE a function for the GPU. `wait_for_previous` lets a kernel start before the one before it
// in the stream has ended (CUDA's programmatic dependent launch, compute capability 9.0 and later;
// elsewhere this does nothing).
#pragma once

#define KERNEL extern "C" __global__ void
#define DEVICE static __device__ __forceinline__

// The first statement of a kernel. A kernel that has it is launched early: its blocks may be set up
// while the kernel before is still running. `wait` returns once that kernel has completed and its
// writes are visible, so nothing may read or write global memory before it. Every kernel that
// starts early waits, so a kernel that has completed came after all before it, and they are
// complete too.
//
// `launch_dependents` lets the next kernel start in the same way, once all blocks of this one have
// got here. It says nothing about memory: the next kernel waits until this one has completed.
//
// Do not read global memory by `__ldg` or through `const __restrict__` pointers in such a kernel.
// The compiler takes it as constant during the launch, which now begins while the kernel before
// still writes, and may read it before the wait.
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
