// Entry points of the structured linear program: the size is chosen here, once; n <= 8 are compiled for it.
#include "banded_ipm.hpp"
#include "lp.hpp"

namespace hw {
namespace HW_ISA {
namespace {

constexpr int lanes = 4;

template <int N, int M = 0, bool Boxed = false>
struct Run {
    static std::size_t bytes(const LpProblem& lp, const LpSettings& set) {
        BandedIpm<lanes, N, M, Boxed> ipm(lp, set);
        Carver c{nullptr};
        ipm.carve(c);
        return c.used + 64;
    }
    static int solve(const LpProblem& lp, const LpSettings& set, LpOut& out, void* workspace) {
        BandedIpm<lanes, N, M, Boxed> ipm(lp, set);
        Carver c{static_cast<char*>(workspace)};
        ipm.carve(c);
        return ipm.solve(out);
    }
};

}  // namespace

#ifdef HW_FEW_SIZES
#define HW_SIZES(what, ...) \
    case 3: return Run<3>::what(__VA_ARGS__);
#else
#define HW_SIZES(what, ...)                       \
    case 1: return Run<1>::what(__VA_ARGS__);     \
    case 2: return Run<2>::what(__VA_ARGS__);     \
    case 3: return Run<3>::what(__VA_ARGS__);     \
    case 4: return Run<4>::what(__VA_ARGS__);     \
    case 5: return Run<5>::what(__VA_ARGS__);     \
    case 6: return Run<6>::what(__VA_ARGS__);     \
    case 7: return Run<7>::what(__VA_ARGS__);     \
    case 8: return Run<8>::what(__VA_ARGS__);
#endif
#define HW_PLAIN(n, m, what, ...)                                                             \
    if (Shape<n, m, false>::fits(lp)) return Run<n, m, false>::what(__VA_ARGS__);              \
    if (Shape<n, m, true>::fits(lp)) return Run<n, m, true>::what(__VA_ARGS__);
#define HW_BY_SIZE(what, ...)                                              \
    HW_PLAIN(2, 1, what, __VA_ARGS__)                                      \
    HW_PLAIN(3, 2, what, __VA_ARGS__)                                      \
    HW_PLAIN(4, 2, what, __VA_ARGS__)                                      \
    switch (lp.n) {                                                        \
        HW_SIZES(what, __VA_ARGS__)                                        \
        default: return Run<0>::what(__VA_ARGS__);                         \
    }

std::size_t lp_workspace(const LpProblem& lp, const LpSettings& set) { HW_BY_SIZE(bytes, lp, set) }

int lp_solve(const LpProblem& lp, const LpSettings& set, LpOut& out, void* workspace) {
    HW_BY_SIZE(solve, lp, set, out, workspace)
}

}  // namespace HW_ISA
}  // namespace hw
