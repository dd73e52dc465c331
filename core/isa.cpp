#include "isa.hpp"

#include <atomic>
#include <cstdlib>
#include <cstring>

namespace hw {
namespace {

Isa best() {
#if defined(__x86_64__)
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) return Isa::avx2;
#endif
    return Isa::base;
}

Isa first() {
    const char* asked = std::getenv("HALFWIDTH_ISA");
    return asked && std::strcmp(asked, "base") == 0 ? Isa::base : best();
}

std::atomic<Isa> current{first()};

}  // namespace

Isa isa() { return current.load(std::memory_order_relaxed); }

bool use_isa(Isa wanted) {
    if (static_cast<int>(wanted) > static_cast<int>(best())) return false;
    current.store(wanted, std::memory_order_relaxed);
    return true;
}

}  // namespace hw
