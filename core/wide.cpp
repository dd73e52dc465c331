#include "wide.hpp"

#include <atomic>
#include <cstdlib>

namespace hw {
namespace {

bool able() {
#if defined(__x86_64__)
    __builtin_cpu_init();
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("avx512f") &&
           __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
#else
    return false;
#endif
}

std::atomic<bool> wanted_wide{able() && !std::getenv("HALFWIDTH_ISA")};

}  // namespace

bool wide() { return wanted_wide.load(std::memory_order_relaxed) && isa() != Isa::base; }

bool use_wide(bool wanted) {
    if (wanted && !able()) return false;
    wanted_wide.store(wanted, std::memory_order_relaxed);
    return true;
}

}  // namespace hw
