"""Fixed-width vector types for numba kernels, emitted as LLVM vectors."""
