// Pieces of one workspace that the caller gives.
#pragma once

#include "small.hpp"

namespace hw {
namespace HW_ISA {

// hands out pieces of the caller's workspace, aligned to 64 bytes; with base == null it only counts
struct Carver {
    char* base;
    std::size_t used = 0;
    template <class V>
    V* take(std::ptrdiff_t count) {
        used = (used + 63) / 64 * 64;
        V* p = base ? reinterpret_cast<V*>(base + used) : nullptr;
        used += static_cast<std::size_t>(count) * sizeof(V);
        return p;
    }
    template <class... Vs>
    void many(std::ptrdiff_t count, Vs*&... arrays) {
        ((arrays = take<Vs>(count)), ...);
    }
};

}  // namespace HW_ISA
}  // namespace hw
