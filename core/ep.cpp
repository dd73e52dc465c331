// Entry points of core/ep.hpp.
#include "ep.hpp"

namespace hw {
namespace HW_ISA {
namespace {

std::size_t block_size(const EpArgs& a) {
    const std::size_t stages = a.T + 1, n = a.n;
    const std::size_t shape = a.k3 ? stages * (5 * n * n + 2 * n) + 2 * std::size_t(a.rows) : 0;
    return stages * (2 * n + n * (n + 1)) + stages * 2 * n + 2 * std::size_t(a.rows) + 3 * std::size_t(a.groups) + 4 + shape;
}

template <class N>
int run(N n, const EpArgs& a) {
    for (int first = 0; first < a.members; first += lanes) {
        Ep<N> ep{n, a, {first, a.members - 1}, {}, {}};
        const std::ptrdiff_t stages = a.T + 1, tri = n * (n + 1) / 2;
        V* p = reinterpret_cast<V*>(a.work);
        const auto take = [&p](std::ptrdiff_t size) {
            V* q = p;
            p += size;
            return q;
        };
        EpState& s = ep.s;
        s.mp = take(stages * n);
        s.eb = take(stages * n);
        s.Pp = take(stages * tri);
        s.Lb = take(stages * tri);
        s.m = take(stages * n);
        s.D = take(stages * n);
        s.tau = take(a.rows);
        s.nu = take(a.rows);
        s.s = take(a.groups + 1);
        EpFound f{};
        f.slope = take(a.groups + 1);
        if (a.k3) {
            EpCross& c = ep.cross;
            const std::ptrdiff_t square = stages * n * n;
            c.S = take(square);
            c.Pf = take(square);
            c.B = take(square);
            c.X0 = take(square);
            c.X1 = take(square);
            c.w3 = take(stages * n);
            c.w4 = take(stages * n);
            c.r3 = take(a.rows);
            c.r4 = take(a.rows);
        }
        const EpCross wanted = ep.cross;
        ep.cross = EpCross{};
        const auto member = [&](int l) { return first + l < a.members ? first + l : a.members - 1; };
        for (int l = 0; l < lanes; l++) {
            for (int g = 0; g < a.groups; g++) s.s[g].set(l, a.s[std::ptrdiff_t(member(l)) * a.groups + g]);
            s.eps.set(l, a.eps[member(l)]);
        }
        if (a.warm) {
            for (int l = 0; l < lanes; l++) {
                const std::ptrdiff_t k = member(l);
                for (std::ptrdiff_t i = 0; i < stages * n; i++) {
                    s.m[i].set(l, a.m[k * stages * n + i]);
                    s.D[i].set(l, a.D[k * stages * n + i]);
                }
                for (int i = 0; i < a.rows; i++) {
                    s.tau[i].set(l, a.tau[k * a.rows + i]);
                    s.nu[i].set(l, a.nu[k * a.rows + i]);
                }
            }
            ep.forget();
            EpFound none = f;
            ep.clear(none);
            ep.template forward<false>(none, 1.0);  // the message of the sites that were given
            ep.template backward<false>(none);
        } else {
            ep.start();
        }
        int used = 0;
        while (used < a.sweeps) {
            ep.sweep(f, a.damping);
            used++;
            if (max_lanes(f.residual) < a.tol) break;
        }
        ep.cross = wanted;
        ep.look(f);
        if (a.k3) ep.shapes(a.k3, a.k4);
        for (int l = 0; l < lanes && first + l < a.members; l++) {
            const std::ptrdiff_t k = first + l;
            a.log_z[k] = f.log_z[l];
            a.residual[k] = f.residual[l];
            a.worst[k] = f.worst[l];
            a.used[k] = used;
            for (int g = 0; g <= a.groups; g++) a.slope[k * (a.groups + 1) + g] = f.slope[g][l];
            for (std::ptrdiff_t i = 0; i < stages * n; i++) {
                a.m[k * stages * n + i] = s.m[i][l];
                a.D[k * stages * n + i] = s.D[i][l];
            }
            for (int i = 0; i < a.rows; i++) {
                a.tau[k * a.rows + i] = s.tau[i][l];
                a.nu[k * a.rows + i] = s.nu[i][l];
            }
        }
    }
    return 0;
}

}  // namespace

std::size_t ep_workspace(const EpArgs& a) { return block_size(a) * lanes; }

int ep_run(const EpArgs& a) {
    const FlushTiny flush;
    switch (a.n) {
        case 1: return run(Dim<1>(), a);
        case 2: return run(Dim<2>(), a);
        case 3: return run(Dim<3>(), a);
        case 4: return run(Dim<4>(), a);
        default: return run(Dim<0>(a.n), a);
    }
}

}  // namespace HW_ISA
}  // namespace hw
