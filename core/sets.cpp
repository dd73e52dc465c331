// Entry points of core/sets.hpp.
#include "sets.hpp"

namespace hw {
namespace HW_ISA {

std::size_t set_state(const SetSizes& size) {
    return with_shape(size, [&](auto* shape) { return shape->state(size); });
}

std::size_t set_workspace(const SetSizes& size) {
    const std::size_t n = size.n;
    return with_shape(size, [&](auto* shape) { return 7 * n + box_doubles(size.n) + shape->work(size); });
}

std::ptrdiff_t set_run(const SetRun& run) {
    return with_shape(run.size, [&](auto* shape) { return run_sets<std::remove_pointer_t<decltype(shape)>>(run); });
}

}  // namespace HW_ISA
}  // namespace hw
