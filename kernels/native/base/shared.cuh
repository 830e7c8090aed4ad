// Entries of lists whose address kernels hand on: on CUDA of shared memory, 32 bits; on the CPU of any memory.
#pragma once
#include "builtin.h"

template <class T>
inline CUDA_CALLABLE T* entry(wp::uint64 list, int i) {
#if defined(__CUDA_ARCH__)
    return (T*)__cvta_shared_to_generic((unsigned int)list) + i;
#else
    return (T*)list + i;
#endif
}
