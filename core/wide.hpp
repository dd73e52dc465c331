// Kernels that run the members of a family abreast, one a lane, are compiled for AVX-512 as well (namespace
// `hw::avx512`, eight lanes); elsewhere they have four. See core/isa.hpp.
#pragma once

#include "isa.hpp"

#define HW_WIDE_KERNEL(ret, name, ...) \
    HW_KERNEL(ret, name, __VA_ARGS__)  \
    HW_IF_AVX2(namespace hw { namespace avx512 { ret name(__VA_ARGS__); } })

#if defined(__x86_64__)
#define HW_PICK_WIDE(name) (::hw::wide() ? &::hw::avx512::name : HW_PICK(name))
#else
#define HW_PICK_WIDE(name) HW_PICK(name)
#endif

namespace hw {

// Whether AVX-512 runs them: where this machine has it, unless the environment or `use_wide` asked for less, and while
// `isa` is not the base set. core/wide.cpp.
bool wide();
bool use_wide(bool wanted);  // false if this machine cannot

#if defined(__AVX512F__)
constexpr int wide_lanes = 8;
#else
constexpr int wide_lanes = 4;
#endif

}  // namespace hw
