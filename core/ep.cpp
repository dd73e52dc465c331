// Entry points of core/ep.hpp.
#include "ep.hpp"
#include "ep_handover.hpp"
#include "ep_learn.hpp"

namespace hw {
namespace HW_ISA {
namespace {

// two bytes a row, in registers
std::size_t marks(const EpArgs& a) { return (2 * std::size_t(a.rows) + sizeof(V) - 1) / sizeof(V); }

std::size_t block_size(const EpArgs& a) {
    const std::size_t stages = a.T + 1, n = a.n;
    const std::size_t shape = a.k3 ? stages * (6 * n * n + 4 * n) + 2 * std::size_t(a.rows) : 0;
    return stages * (2 * n + n * (n + 1)) + stages * 2 * n + 2 * std::size_t(a.rows) + 5 * std::size_t(a.groups) + 4 + marks(a) + shape;
}

struct Place {
    V* p;
    V* take(std::ptrdiff_t size) {
        V* q = p;
        p += size;
        return q;
    }
};

// the arrays of a block; `f` gets its slopes
template <class N>
void settle_in(Ep<N>& ep, EpFound& f, Place& place) {
    const EpArgs& a = ep.a;
    const std::ptrdiff_t n = ep.n, stages = a.T + 1, tri = n * (n + 1) / 2, square = stages * n * n;
    EpState& s = ep.s;
    s.mp = place.take(stages * n);
    s.eb = place.take(stages * n);
    s.Pp = place.take(stages * tri);
    s.Lb = place.take(stages * tri);
    s.m = place.take(stages * n);
    s.D = place.take(stages * n);
    s.tau = place.take(a.rows);
    s.nu = place.take(a.rows);
    s.s = place.take(a.groups + 1);
    s.log_box = place.take(a.groups);
    s.axis = reinterpret_cast<signed char*>(place.take(marks(a)));
    s.bends = s.axis + a.rows;
    ep.axes();
    f.slope = place.take(a.groups + 1);
    f.learned = place.take(a.groups);
    if (!a.k3) return;
    EpCross& c = ep.cross;
    c.S = place.take(square);
    c.Pf = place.take(square);
    c.B = place.take(square);
    c.X0 = place.take(square);
    c.X1 = place.take(square);
    c.W = place.take(square);
    c.w3 = place.take(stages * n);
    c.w4 = place.take(stages * n);
    c.r3 = place.take(a.rows);
    c.r4 = place.take(a.rows);
    c.x3 = place.take(stages * n);
    c.x4 = place.take(stages * n);
}

template <class N>
int run(N n, const EpArgs& a) {
    for (int first = 0; first < a.members; first += wide_lanes) {
        Ep<N> ep{n, a, {first, a.members - 1}, {}, {}, 0};
        ep.lone = a.members == 1;
        EpFound f{};
        Place place{reinterpret_cast<V*>(a.work)};
        settle_in(ep, f, place);
        const EpCross wanted = ep.cross;
        ep.cross = EpCross{};
        EpState& s = ep.s;
        const std::ptrdiff_t stages = a.T + 1;
        const auto member = [&](int l) { return first + l < a.members ? first + l : a.members - 1; };
        for (int l = 0; l < wide_lanes; l++) {
            for (int g = 0; g < a.groups; g++) s.s[g].set(l, a.s[std::ptrdiff_t(member(l)) * a.groups + g]);
            s.eps.set(l, a.eps[member(l)]);
        }
        if (a.warm) {
            for (int l = 0; l < wide_lanes; l++) {
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
            ep.hear();
        } else {
            ep.start();
        }
        const int used = a.sweeps > 0 ? ep.settle(f, a.sweeps, a.tol, a.damping) : 0;
        ep.cross = wanted;
        ep.look(f);
        const V more = a.k3 ? ep.second(a.k3, a.k4) : V(0.0);
        for (int l = 0; l < wide_lanes && first + l < a.members; l++) {
            const std::ptrdiff_t k = first + l;
            a.log_z[k] = ep.sound(f, l) ? f.log_z[l] : minus_inf;
            if (a.more) a.more[k] = more[l];
            a.residual[k] = f.residual[l];
            a.worst[k] = f.worst[l];
            for (int g = 0; g < a.groups; g++) a.learned[k * a.groups + g] = f.learned[g][l];
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

std::size_t learner_parameters(const EpLearnArgs& a) {
    std::size_t q = a.learn_eps ? 1 : 0;
    for (int g = 0; g < a.base.groups; g++) q += a.free[g] ? 1 : 0;
    return q;
}

template <class N>
int learn(N n, const EpLearnArgs& a) {
    Ep<N> ep{n, a.base, {0, wide_lanes - 1}, {}, {}, a.shaped};
    EpLearner<N> learner{ep, a};
    Place place{reinterpret_cast<V*>(a.base.work)};
    settle_in(ep, learner.f, place);
    const std::ptrdiff_t size = std::ptrdiff_t(a.base.T + 1) * n;
    double* p = reinterpret_cast<double*>(place.p);
    learner.keep_m = p;
    learner.keep_D = learner.keep_m + size;
    learner.keep_tau = learner.keep_D + size;
    learner.keep_nu = learner.keep_tau + a.base.rows;
    learner.lead = learner.keep_nu + a.base.rows;  // 2 * sites * parameters
    if (!a.outside) return learner.run();
    place.p += (2 * std::size_t(size + a.base.rows) * (1 + learner_parameters(a)) + wide_lanes - 1) / wide_lanes;
    Ep<N> outside{n, *a.outside, {0, wide_lanes - 1}, {}, {}, a.base.T + 1};
    settle_in(outside, learner.fo, place);
    learner.around = outside.cross;
    outside.cross = EpCross{};
    learner.outside = &outside;
    return learner.run();
}

}  // namespace

std::size_t ep_workspace(const EpArgs& a) { return block_size(a) * wide_lanes; }

int ep_run(const EpArgs& a) {
    const FlushTiny flush;
    switch (a.n) {
#ifndef HW_FEW_SIZES
        case 1: return run(Dim<1>(), a);
        case 2: return run(Dim<2>(), a);
        case 4: return run(Dim<4>(), a);
#endif
        case 3: return run(Dim<3>(), a);
        default: return run(Dim<0>(a.n), a);
    }
}

namespace {

int learn_any(const EpLearnArgs& a) {
    switch (a.base.n) {
#ifndef HW_FEW_SIZES
        case 1: return learn(Dim<1>(), a);
        case 2: return learn(Dim<2>(), a);
        case 4: return learn(Dim<4>(), a);
#endif
        case 3: return learn(Dim<3>(), a);
        default: return learn(Dim<0>(a.base.n), a);
    }
}

// numbers that taking over and handing on need, in whole registers
std::size_t handover_size(const EpLearnArgs& a) {
    const std::size_t p = a.base.groups, n = a.base.n;
    const std::size_t size = 6 * p * (p + 1) + p + a.nodes * (2 * learner_parameters(a) + 2) + 4 * n * n + 2 * n;
    return (size + wide_lanes - 1) / wide_lanes * wide_lanes;
}

}  // namespace

std::size_t ep_learn_workspace(const EpLearnArgs& a) {
    const std::size_t sites = std::size_t(a.base.T + 1) * a.base.n + a.base.rows;
    const std::size_t own = handover_size(a) + ep_workspace(a.base) + 2 * sites * (1 + learner_parameters(a));
    return a.outside ? own + wide_lanes + ep_workspace(*a.outside) : own;
}

void ep_taken_part(int p, const bool* free, const double* start, const double* pull, const double* precision, const double* power,
                   double* found_pull, double* found_precision, double* found_power, double* work) {
    ep_taken(p, free, start, pull, precision, power, found_pull, found_precision, found_power, work);
}

int ep_learn(const EpLearnArgs& given) {
    const FlushTiny flush;
    EpLearnArgs a = given;
    double* const work = a.base.work;
    a.base.work += handover_size(a);
    const int p = a.base.groups;
    double* rest = work;
    if (a.pull) {
        rest = work + p * (p + 2);
        ep_taken(p, a.free, a.start, given.pull, given.precision, given.known_power, work, work + p, work + p * (p + 1), rest);
        a.pull = work;
        a.precision = work + p;
        a.known_power = work + p * (p + 1);
    }
    EpBefore before{};
    a.before = nullptr;
    if (given.before) {
        before = *given.before;
        if (ep_shift(a.base, before)) a.before = &before;
    }
    a.base.warm = a.before != nullptr;
    if (a.before) {
        ep_moved(a);
        a.close = a.near;
    }
    const int code = learn_any(a);
    if (code >= 2) return code;
    const int q = static_cast<int>(learner_parameters(a));
    *a.finite = ep_sound(a);
    ep_widths(a, q, rest);
    if (*a.tells) ep_told(a, q, rest);
    double own[ep_states] = {};
    for (int g = 0, j = 0; g < p && a.base.group_Q; g++) {
        const double s = a.free[g] ? std::exp(a.mode[j++]) : a.start[g];
        for (int i = 0; i < a.base.n; i++)
            if (a.base.group_Q[i] == g) own[i] = s * s;
    }
    ep_edge(a.base, own, a.base.m, a.base.D, a.base.tau, a.base.nu, a.held->edge_x, a.held->edge_P, rest);
    return code;
}

}  // namespace HW_ISA
}  // namespace hw
