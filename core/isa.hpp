// One binary, several instruction sets: each kernel file is compiled once per set into its own namespace
// (`hw::base`, `hw::avx2`), and the binding asks here which one this machine runs.
//
//     kalman.hpp        HW_KERNEL(int, kalman_filter, const KalmanArgs&)      declares hw::base::..., hw::avx2::...
//     kalman.cpp        namespace hw { namespace HW_ISA { int kalman_filter(const KalmanArgs& k) { ... } } }
//     bind_kalman.cpp   HW_PICK(kalman_filter)(args)
//
// Kernel files must not use standard templates (std::vector, std::max, ...): the linker merges equal inline functions
// of different object files, so an AVX2 body could be what an old machine runs. core/small.hpp holds what is needed.
#pragma once

#ifndef HW_ISA
#define HW_ISA base
#endif

#if defined(__x86_64__)
#define HW_IF_AVX2(...) __VA_ARGS__
#else
#define HW_IF_AVX2(...)
#endif

#define HW_KERNEL(ret, name, ...)                     \
    namespace hw {                                    \
    namespace base { ret name(__VA_ARGS__); }         \
    HW_IF_AVX2(namespace avx2 { ret name(__VA_ARGS__); }) \
    }

namespace hw {

enum class Isa { base = 0, avx2 = 1 };

// The set in use: the best this machine has, unless the environment or `use_isa` asked for less. core/isa.cpp.
Isa isa();
bool use_isa(Isa wanted);  // false if this machine cannot run it

}  // namespace hw

#if defined(__x86_64__)
#define HW_PICK(name) (::hw::isa() == ::hw::Isa::avx2 ? &::hw::avx2::name : &::hw::base::name)
#else
#define HW_PICK(name) (&::hw::base::name)
#endif
