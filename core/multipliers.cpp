// Entry points of core/multipliers.hpp.
#include "multipliers.hpp"

namespace hw {
namespace HW_ISA {

std::size_t multipliers_workspace(int n, int k, int rows) {
    const std::size_t r = rows;
    const std::size_t squares = 2 * r * r + 2 * r, weights = 4 * (std::size_t(k) + r * (r + 1) / 2 + 2 * r);
    return r * n + 8 + (squares > weights ? squares : weights);
}

void multipliers(const StripSides& s) {
    switch (s.rows) {
        case 1: return all_sides(Dim<1>(), s);
        case 2: return all_sides(Dim<2>(), s);
        case 3: return all_sides(Dim<3>(), s);
        case 4: return all_sides(Dim<4>(), s);
        case 5: return all_sides(Dim<5>(), s);
        case 6: return all_sides(Dim<6>(), s);
        default: return all_sides(Dim<0>(s.rows), s);
    }
}

}  // namespace HW_ISA
}  // namespace hw
