// Entry point of the chain of drives: the number of states to a template, once per instruction set.
#include "drive.hpp"

namespace hw {
namespace HW_ISA {
namespace {

template <int N>
void run(const DriveArgs& a) {
    for (int first = 0; first < a.n; first += abreast) {
        Drives<N> some(a, first);
        some.filter();
        some.smooth();
    }
}

}  // namespace

void drive_smooth(const DriveArgs& a) {
    FlushTiny scope;
    if (a.size > d_turn) run<d_turn + 1>(a);
    else run<d_turn>(a);
}

}  // namespace HW_ISA
}  // namespace hw
