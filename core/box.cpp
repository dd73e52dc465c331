// Entry points of core/box.hpp.
#include "box.hpp"

namespace hw {
namespace HW_ISA {

std::size_t box_workspace(int n) { return box_doubles(n); }

std::ptrdiff_t box_chain(const BoxChain& chain) { return box_contract(chain); }

}  // namespace HW_ISA
}  // namespace hw
