// Half-widths (and the rate of outliers) by evidence, and what is not known of them carried into the beliefs.
//
// phi = log s of the free half-widths, logit eps last if it is learned. The prior of a rate is a beta law. That of log s is
// s^power told^reference on (floor, cap), told^2 = mean over the rows of (1 - posterior variance / (s^2 / 3))^2: the square
// root of what a row tells of log s (Jeffreys) and a power, 0 where the noise drowns and steady where it is seen. It has
// no scale of its own. What other data have told is a factor s^known_power exp(pull's - s'precision s / 2) beside it.
// log p(phi | y) = log Z(phi) + log prior(phi) is climbed by Newton steps: of the lanes one holds phi, the others
// phi + h e_j, whose slopes give columns of the Hessian, other coordinates at the next step where there are more
// coordinates than lanes. Then points are evaluated, `stage` by `stage`: the first stage around the mode with the
// covariance H^-1, each later one with the weighted moments of all points so far. A point's weight is its evidence over
// the mixture of all stages' Gaussians (adaptive multiple importance sampling, Cornuet et al. 2012), the answer the points'
// mixture; no more stages are asked for once their number leaves less than `enough` standard deviations in doubt. The
// evidence of a point is that of expectation propagation and what that lacks to second order (Ep::second).
//
// In a stream the mode is searched for now and then only, and the nodes of the windows between lie about the same centre. Where
// the window before leaves little in doubt, a window between is light: its first stage is a design of its own, the first rows
// of z, with mean 0 and covariance 1. No more points are asked for unless it leaves more in doubt than was expected, and it
// tells later windows nothing (`tells`): that takes a regression.
//
// A half-width that may as well be 0 has an exponential tail in log s and none in a power of s, so the search and the nodes live in u =
// s^warp (its density has the prior s^(a-warp) in log s, and at its mode the two Hessians differ by du/dphi only). Sites
// follow phi from point to point, so a point costs few sweeps.
//
// Bounds as a factor count as an event that small half-widths make likely: within few rows that keeps half-widths from
// growing until bounds alone shape the path, over hundreds it shrinks them. So Z(phi) is divided by a power, `condition`,
// of the evidence of the chain with its bounds alone (`outside`), to second order as well: with the power 1 bounds are a
// condition.
#pragma once

#include "ep.hpp"
#include "ep_handover.hpp"

namespace hw {
namespace HW_ISA {

constexpr int ep_alone = 10;  // sweeps of a chain with its bounds alone, which starts afresh
constexpr int ep_stages = 8;  // most stages of points
constexpr double ep_lean = 4.0;  // points that a first guess of their covariance is worth
constexpr double ep_wide = 1.15;  // by how much a stage reaches farther than the posterior is thought to
constexpr double ep_least = 3.0;   // effective points without which nothing is to be trusted
constexpr double ep_some = 10.0;  // effective points without which the evidence itself is in doubt
constexpr int ep_few = 2;     // rows that may come or go while the mode stays
constexpr int ep_turns = 20;  // rounds over the parameters of a step that is held in a box
constexpr int ep_never = 1 << 20; // of windows since a search: the next one searches
constexpr double ep_sure = 0.25;  // standard deviations in which a step of Newton errs by no more than the mode may
constexpr double ep_apart = 1.0;  // disagreement of moments, in standard deviations, beyond which no step is taken
constexpr double ep_near = 0.05;  // how near the mode must be where it stands alone for the parameters

template <class N>
struct EpLearner {
    Ep<N>& ep;
    const EpLearnArgs& a;
    EpFound f{};
    double *keep_m = nullptr, *keep_D = nullptr, *keep_tau = nullptr, *keep_nu = nullptr;  // sites of the best point
    Ep<N>* outside = nullptr;       // bounds alone, or null
    EpFound fo{};
    EpCross around{};               // what their second order needs
    int q = 0;                                // parameters
    int group[ep_free] = {};                  // half-width of a parameter, -1: the rate
    double lo[ep_free] = {}, hi[ep_free] = {};
    long sweeps = 0;

    std::ptrdiff_t stage_count() const { return static_cast<std::ptrdiff_t>(a.base.T + 1) * ep.n; }

    int parameters() {
        const EpArgs& b = a.base;
        for (int g = 0; g < b.groups; g++)
            if (a.free[g]) {
                if (q == ep_free) return -1;
                group[q] = g;
                lo[q] = std::log(max2(a.floor[g], 1e-12 * a.scale[g]));
                hi[q] = std::log(min2(a.cap[g], 1e3 * a.scale[g]));
                q++;
            }
        if (a.learn_eps) {
            if (q == ep_free) return -1;
            group[q] = -1;
            lo[q] = -14.0;
            hi[q] = 1.5;
            q++;
        }
        return q;
    }

    // share of a half-width's noise that the data tell, of lane l: 0 nothing, 1 all
    double told(int j, int l) const {
        return std::sqrt(min2(max2(f.learned[group[j]][l] / max2(a.count[group[j]], 1.0), 1e-12), 1.0));
    }
    // logarithm of the prior's part that the data decide
    double log_told(int l) const {
        double p = 0.0;
        for (int j = 0; j < q; j++)
            if (group[j] >= 0) p += a.reference * std::log(told(j, l));
        return p;
    }
    double log_prior(const double* phi, int l) const {
        double p = known(phi) + log_told(l);
        for (int j = 0; j < q; j++)
            p += group[j] >= 0 ? (a.power - a.warp) * phi[j]
                               : a.beta_a * phi[j] - (a.beta_a + a.beta_b) * std::log1p(std::exp(phi[j]));
        return p;
    }
    // the slope of the rest
    double prior_slope(int j, const double* phi) const {
        return group[j] >= 0 ? a.power - a.warp + known_slope(j, phi)
                             : a.beta_a - (a.beta_a + a.beta_b) / (1.0 + std::exp(-phi[j]));
    }

    // What is known already of the half-widths: its logarithm up to a constant, its slope in log s_j, and minus its
    // curvature in s times s_i s_j.
    double precision(int i, int j) const { return a.precision[group[i] * a.base.groups + group[j]]; }
    double known(const double* phi) const {
        double p = 0.0;
        if (a.pull)
            for (int i = 0; i < q; i++)
                if (group[i] >= 0) {
                    double half = a.pull[group[i]];
                    for (int j = 0; j < q; j++)
                        if (group[j] >= 0) half -= 0.5 * precision(i, j) * std::exp(phi[j]);
                    p += half * std::exp(phi[i]) + a.known_power[group[i]] * phi[i];
                }
        return p;
    }
    double known_slope(int i, const double* phi) const {
        if (!a.pull) return 0.0;
        double d = a.pull[group[i]];
        for (int j = 0; j < q; j++)
            if (group[j] >= 0) d -= precision(i, j) * std::exp(phi[j]);
        return std::exp(phi[i]) * d + a.known_power[group[i]];
    }
    double known_curve(int i, int j, const double* phi) const {
        if (!a.pull || group[i] < 0 || group[j] < 0) return 0.0;
        return std::exp(phi[i] + phi[j]) * precision(i, j) + (i == j ? a.known_power[group[i]] : 0.0);
    }

    // parameters of lane l
    void put(int l, const double* phi) {
        for (int j = 0; j < q; j++) {
            if (group[j] >= 0) {
                ep.s.s[group[j]].set(l, std::exp(phi[j]));
                if (outside) outside->s.s[group[j]].set(l, std::exp(phi[j]));
            } else ep.s.eps.set(l, 1.0 / (1.0 + std::exp(-phi[j])));
        }
    }
    // ---- sites follow the parameters: log-linear in D and tau, linear in means ------------------------------------

    // lead[(site * 2 + i) * q + j] = d (log precision, mean) / d phi_j of the site, w's first, then the rows'
    double* lead = nullptr;
    double kept[ep_free] = {};      // parameters of the sites that are kept
    bool followed[ep_free] = {};    // lead was measured; else sites keep their shape over their own half-width

    int group_of(std::ptrdiff_t site) const {
        const std::ptrdiff_t k = site - stage_count();
        if (k < 0) return site < ep.n ? -1 : a.base.group_w[site % ep.n];
        return a.base.kind[k] == noise_gaussian || a.base.kind[k] == ep_truncation ? -1 : a.base.group[k];
    }
    // a row with two explanations may change between them: its site is not led along
    bool steady(std::ptrdiff_t site) const {
        const std::ptrdiff_t k = site - stage_count();
        return k < 0 || a.base.kind[k] < noise_contaminated || a.base.kind[k] == ep_truncation;
    }
    // keep the sites of lane l, which belong to phi
    void remember(int l, const double* phi) {
        for (std::ptrdiff_t k = 0; k < stage_count(); k++) {
            keep_m[k] = ep.s.m[k][l];
            keep_D[k] = ep.s.D[k][l];
        }
        for (int k = 0; k < a.base.rows; k++) {
            keep_tau[k] = ep.s.tau[k][l];
            keep_nu[k] = ep.s.nu[k][l];
        }
        keep(phi);
    }
    void keep(const double* phi) {
        const std::ptrdiff_t stages = stage_count(), sites = stages + a.base.rows;
        for (int j = 0; j < q; j++) {
            kept[j] = phi[j];
            for (std::ptrdiff_t site = 0; site < sites; site++) {
                if (followed[j] && steady(site)) continue;
                const bool own = group[j] >= 0 && group_of(site) == group[j];
                const std::ptrdiff_t k = site - stages;
                const double mean = k < 0 ? keep_m[site] : keep_tau[k] > 0.0 ? keep_nu[k] / keep_tau[k] : 0.0;
                lead[2 * site * q + j] = own ? -2.0 : 0.0;
                lead[(2 * site + 1) * q + j] = own ? mean : 0.0;
            }
        }
    }
    // measure how the sites follow: lane l has parameter along[l] moved by h[l] from those of lane 0
    void follow(const int* along, const double* h, const double* value) {
        const std::ptrdiff_t stages = stage_count(), sites = stages + a.base.rows;
        V over(0.0);
        int lane[wide_lanes], count = 0;
        for (int l = 1; l < wide_lanes; l++)
            if (along[l] >= 0 && value[l] > minus_inf) {
                over.set(l, 1.0 / h[l]);
                followed[along[l]] = true;
                lane[count++] = l;
            }
        for (std::ptrdiff_t site = 0; site < sites; site++) {
            if (!steady(site)) continue;
            const std::ptrdiff_t k = site - stages;
            const V own = k < 0 ? ep.s.D[site] : ep.s.tau[k];
            V turn(0.0), move(0.0);
            if (own[0] > 0.0) {
                const V log_own = log_of(own), mean = k < 0 ? ep.s.m[site] : ep.s.nu[k] / larger(own, V(1e-300));
                turn = (log_own - V(log_own[0])) * over * V(k < 0 ? -1.0 : 1.0);
                move = (mean - V(mean[0])) * over;
                turn = V::of(own.v > X{} ? max4(min4(turn.v, all<X>(20.0)), all<X>(-20.0)) : X{});
                move = V::of(own.v > X{} ? move.v : X{});
            }
            for (int c = 0; c < count; c++) {
                lead[2 * site * q + along[lane[c]]] = turn[lane[c]];
                lead[(2 * site + 1) * q + along[lane[c]]] = move[lane[c]];
            }
        }
    }
    // every lane starts from the sites that are kept, drawn along to its own parameters
    void recall(const double (*phi)[ep_free]) {
        const std::ptrdiff_t stages = stage_count(), sites = stages + a.base.rows;
        V d[ep_free];
        for (int j = 0; j < q; j++)
            for (int l = 0; l < wide_lanes; l++) d[j].set(l, phi[l][j] - kept[j]);
        for (std::ptrdiff_t site = 0; site < sites; site++) {
            const std::ptrdiff_t k = site - stages;
            const double own = k < 0 ? keep_D[site] : keep_tau[k];
            V turn(0.0), mean(k < 0 ? keep_m[site] : own > 0.0 ? keep_nu[k] / own : 0.0);
            if (own > 0.0 && (k < 0 || a.base.kind[k] != noise_gaussian))
                for (int j = 0; j < q; j++) {
                    turn += V(lead[2 * site * q + j]) * d[j];
                    mean += V(lead[(2 * site + 1) * q + j]) * d[j];
                }
            turn = V::of(exp4(max4(min4(turn.v, all<X>(6.0)), all<X>(-6.0))));
            if (k < 0) {
                ep.s.D[site] = V(own) / turn;
                ep.s.m[site] = mean;
            } else {
                ep.s.tau[k] = V(own) * turn;
                ep.s.nu[k] = ep.s.tau[k] * mean;
            }
        }
    }

    // ---- lanes go on where those of the window before were ---------------------------------------------------------

    // how the sites of an evaluation begin: afresh, where they were left, or so but for rows that have come and gone
    enum Begin { afresh, led, resumed };

    static inline V load(const double* p) {
        V v;
        __builtin_memcpy(&v, p, sizeof v);
        return v;
    }
    // The lanes' sites are those of `column` and the next ones in the window before, led along from their parameters to
    // phi; those of the mode where there are none near. Returns whether they are of any use.
    bool resume(int column, const double (*phi)[ep_free]) {
        if (!a.base.warm || !a.before->lanes) return false;
        V d[ep_free], near(1.0);
        int lost = 0;
        for (int l = 0; l < wide_lanes; l++) {
            bool close = true;
            for (int j = 0; j < q; j++) close = close && std::fabs(phi[l][j] - a.before->lane_phi[(column + l) * q + j]) < 0.5;
            for (int j = 0; j < q; j++) d[j].set(l, close ? phi[l][j] - a.before->lane_phi[(column + l) * q + j] : 0.0);
            if (!close) near.set(l, 0.0);
            lost += !close;
        }
        if (2 * lost > wide_lanes) return false;
        if (lost) recall(phi);
        const std::ptrdiff_t old = std::ptrdiff_t(a.before->stages) * ep.n, olds = old + a.before->start[a.before->stages];
        const auto own = [&](std::ptrdiff_t site, std::ptrdiff_t from, bool row, V* to_first, V* to_second) {
            const double* p = a.before->lanes + from * a.columns + column;
            V first = load(p), second = load(p + olds * a.columns), turn(0.0), move(0.0);
            for (int j = 0; j < q; j++) {
                turn += V(lead[2 * site * q + j]) * d[j];
                move += V(lead[(2 * site + 1) * q + j]) * d[j];
            }
            if (any4((turn.v != X{}) | (move.v != X{}))) {
                turn = V::of(exp4(max4(min4(turn.v, all<X>(6.0)), all<X>(-6.0))));
                second = row ? second * turn : second / turn;
                first = row ? first * turn + second * move : first + move;
            }
            *to_first = lost ? either(near.v > X{}, first, *to_first) : first;
            *to_second = lost ? either(near.v > X{}, second, *to_second) : second;
        };
        for (int t = 0; t <= a.base.T; t++)
            for (int i = 0; i < ep.n; i++) {
                const std::ptrdiff_t from = ep_origin(*a.before, ep.n, t, i), to = std::ptrdiff_t(t) * ep.n + i;
                if (from < 0) ep.start_noise(t, i);
                else own(to, from, false, ep.s.m + to, ep.s.D + to);
            }
        for (int k = 0; k < a.base.rows; k++) {
            const std::ptrdiff_t from = ep_origin(*a.before, k);
            if (from < 0) ep.start_row(k);
            else own(stage_count() + k, old + from, true, ep.s.nu + k, ep.s.tau + k);
        }
        return true;
    }
    // keep the lanes' sites, which belong to phi, for the window after
    void hold(int column, const double (*phi)[ep_free]) {
        const std::ptrdiff_t stages = stage_count(), sites = stages + a.base.rows;
        for (std::ptrdiff_t site = 0; site < sites; site++) {
            const V first = site < stages ? ep.s.m[site] : ep.s.nu[site - stages];
            const V second = site < stages ? ep.s.D[site] : ep.s.tau[site - stages];
            double* p = a.held->lanes + site * a.columns + column;
            __builtin_memcpy(p, &first, sizeof first);
            __builtin_memcpy(p + sites * a.columns, &second, sizeof second);
        }
        for (int l = 0; l < wide_lanes; l++)
            for (int j = 0; j < q; j++) a.held->lane_phi[(column + l) * q + j] = Ep<N>::alive(f, l) ? phi[l][j] : __builtin_nan("");
    }

    // evaluate the lanes; value[l] = log posterior up to a constant, slope[l][j]
    void evaluate(const double (*phi)[ep_free], int most, double tol, double* value, double (*slope)[ep_free], Begin begin) {
        bool done = false;
        if (begin == resumed) {
            sweeps += ep.settle_ends(f, most, tol, a.base.damping) / (a.base.T + 1) + 1;
            ep.look(f);
            done = ep.within(f, f.residual, tol);
        } else if (begin == led) {
            ep.hear();
        }
        if (!done) {
            sweeps += ep.settle(f, most, tol, a.base.damping) + 1;
            ep.look(f);
        }
        for (int l = 0; l < wide_lanes; l++) {
            const bool sound = ep.sound(f, l);
            value[l] = sound ? f.log_z[l] + log_prior(phi[l], l) : minus_inf;
            for (int j = 0; j < q; j++)
                slope[l][j] = f.slope[group[j] >= 0 ? group[j] : a.base.groups][l] + prior_slope(j, phi[l]);
        }
    }
    // the same with the bounds as a condition; where they alone have no evidence at the start they
    // are left a factor
    void evaluate_inside(const double (*phi)[ep_free], int most, double tol, double* value, double (*slope)[ep_free],
                         Begin begin, bool first) {
        if (outside) {
            outside->start();
            sweeps += outside->settle(fo, most > ep_alone ? most : ep_alone, max2(tol, 0.3 * a.tol), a.base.damping) + 1;
            outside->look(fo);
        }
        evaluate(phi, most, tol, value, slope, begin);
        if (outside && first && value[0] > minus_inf && !outside->sound(fo, 0)) outside = nullptr;
        if (!outside) return;
        for (int l = 0; l < wide_lanes; l++) {
            if (!outside->sound(fo, l)) value[l] = minus_inf;
            value[l] -= a.condition * fo.log_z[l];
            for (int j = 0; j < q; j++)
                if (group[j] >= 0) slope[l][j] -= a.condition * fo.slope[group[j]][l];
        }
    }

    // H (q,q) from its measured columns: symmetric, with every curvature at least `least` of the mean one
    void hessian(const double (*column)[ep_free], double (*H)[ep_free]) const {
        for (int i = 0; i < q; i++)
            for (int j = 0; j < q; j++) H[i][j] = 0.5 * (column[i][j] + column[j][i]);
        for (int i = 0; i < q; i++) H[i][i] = max2(H[i][i], a.least);
        // shrink couplings until the factor exists
        for (double keep = 1.0; keep > 0.01; keep *= 0.7) {
            double L[ep_free][ep_free];
            if (factor(H, keep, L)) {
                for (int i = 0; i < q; i++)
                    for (int j = 0; j < q; j++)
                        if (i != j) H[i][j] *= keep;
                return;
            }
        }
        for (int i = 0; i < q; i++)
            for (int j = 0; j < q; j++)
                if (i != j) H[i][j] = 0.0;
    }
    bool factor(const double (*H)[ep_free], double keep, double (*L)[ep_free]) const {
        for (int j = 0; j < q; j++) {
            double p = H[j][j];
            for (int k = 0; k < j; k++) p -= L[j][k] * L[j][k];
            if (!(p > 0.05 * H[j][j])) return false;
            L[j][j] = std::sqrt(p);
            for (int i = j + 1; i < q; i++) {
                double s = keep * H[i][j];
                for (int k = 0; k < j; k++) s -= L[i][k] * L[j][k];
                L[i][j] = s / L[j][j];
            }
        }
        return true;
    }

    // Newton step: to the top of the quadratic of slope g and curvature H within the bounds and 0.8 of phi in each
    // parameter; returns its length in standard deviations.
    double step(const double (*H)[ep_free], const double* phi, const double* g, double* d) const {
        double from[ep_free], to[ep_free];
        int open[ep_free], k = 0;
        for (int j = 0; j < q; j++) {
            d[j] = 0.0;
            from[j] = max2(lo[j] - phi[j], -0.8);
            to[j] = min2(hi[j] - phi[j], 0.8);
            const bool held = (to[j] <= 1e-9 && g[j] > 0) || (from[j] >= -1e-9 && g[j] < 0);
            if (!held) open[k++] = j;
        }
        double M[ep_free * ep_free], L[ep_free * ep_free], p[ep_free], pi[ep_free], x[ep_free];
        for (int i = 0; i < k; i++) {
            x[i] = g[open[i]];
            for (int j = 0; j < k; j++) M[i * k + j] = H[open[i]][open[j]];
        }
        if (k == 0) return 0.0;
        ldl(Dim<0>(k), M, L, p, pi);
        ldl_solve(Dim<0>(k), Dim<1>(), L, pi, x);
        bool within = true;
        for (int i = 0; i < k; i++) within = within && x[i] >= from[open[i]] && x[i] <= to[open[i]];
        // A step that is cut where it reaches too far may lead downhill, however short it is made: parameter by parameter
        // from 0 it cannot.
        for (int i = 0; i < k && !within; i++) x[i] = 0.0;
        for (int sweep = 0; sweep < ep_turns && !within; sweep++)
            for (int i = 0; i < k; i++) {
                double rest = g[open[i]];
                for (int j = 0; j < k; j++) rest -= j == i ? 0.0 : H[open[i]][open[j]] * x[j];
                x[i] = min2(max2(rest / H[open[i]][open[i]], from[open[i]]), to[open[i]]);
            }
        double far = 0.0;
        for (int i = 0; i < k; i++) {
            d[open[i]] = x[i];
            far = max2(far, std::fabs(x[i]) * std::sqrt(H[open[i]][open[i]]));
        }
        return far;
    }

    // little is left to be known of the parameters, or no more is asked for: one node does
    bool alone(const double (*H)[ep_free]) const {
        double wide = 0.0;
        for (int j = 0; j < q; j++) wide = max2(wide, 1.0 / std::sqrt(H[j][j]));
        return q == 0 || wide < a.narrow || a.nodes == 1;
    }

    // the kept sites follow their parameters a step d
    void draw(const double* d) {
        const std::ptrdiff_t stages = stage_count(), sites = stages + a.base.rows;
        for (std::ptrdiff_t site = 0; site < sites; site++) {
            const std::ptrdiff_t k = site - stages;
            double &own = k < 0 ? keep_D[site] : keep_tau[k], &first = k < 0 ? keep_m[site] : keep_nu[k], turn = 0.0, move = 0.0;
            if (!(own > 0.0) || (k >= 0 && a.base.kind[k] == noise_gaussian)) continue;
            for (int j = 0; j < q; j++) {
                turn += lead[2 * site * q + j] * d[j];
                move += lead[(2 * site + 1) * q + j] * d[j];
            }
            const double mean = (k < 0 ? first : first / own) + move;
            own *= std::exp(k < 0 ? -turn : turn);
            first = k < 0 ? mean : own * mean;
        }
        for (int j = 0; j < q; j++) kept[j] += d[j];
    }
    // a step d from phi of slope g to the mode, by the quadratic that led to it
    void go(double* phi, const double* d, const double* g, double* best) {
        for (int j = 0; j < q; j++) {
            const double told_slope = group[j] >= 0 ? 2.0 * a.reference * (1.0 - told(j, 0)) : 0.0;
            a.held->log_prior += (prior_slope(j, phi) + told_slope) * d[j];
            *best += 0.5 * g[j] * d[j];
            phi[j] += d[j];
        }
        draw(d);
    }

    // climb from phi to the mode, whose last step of at most `sure` is not looked back from; H at the end; returns 0, 1: not
    // converged, 2: no sound point
    int climb(double* phi, double (*H)[ep_free], double* best, bool warm, double sure) {
        double column[ep_free][ep_free] = {}, g[ep_free] = {};
        bool measured[ep_free] = {};
        for (int j = 0; j < q; j++) {
            for (int i = 0; i < q; i++) column[j][i] = known_curve(i, j, phi);
            column[j][j] += max2(group[j] >= 0 ? 0.3 * a.count[group[j]] : 1.0, a.least);
        }
        // Of told only its own half-width's slope is climbed: it grows with s^2 / (s^2 + what blurs it), so d log told / d log s
        // = 2 (1 - told). What it loses to the others would lead to modes of next to no noise, far from where the mass is.
        double kept_value = minus_inf;  // without told
        int next = 0, missing = q;
        *best = minus_inf;
        double d[ep_free] = {}, trial[ep_free];
        double length = 1e9;
        int refused = 0;
        for (int k = 0; k < a.steps; k++) {
            double at[wide_lanes][ep_free], value[wide_lanes], slope[wide_lanes][ep_free], h[wide_lanes] = {};
            int along[wide_lanes];
            for (int& j : along) j = -1;
            for (int j = 0; j < q; j++) trial[j] = min2(max2(phi[j] + d[j], lo[j]), hi[j]);
            for (int l = 0; l < wide_lanes; l++) {
                for (int j = 0; j < q; j++) at[l][j] = trial[j];
                if (l == 0 || l > q) continue;
                const int j = next;
                next = (next + 1) % q;
                h[l] = min2(max2(0.5 / std::sqrt(column[j][j]), 0.01), 0.15);
                if (trial[j] + h[l] > hi[j]) h[l] = -h[l];
                along[l] = j;
                at[l][j] += h[l];
            }
            for (int l = 0; l < wide_lanes; l++) put(l, at[l]);
            const Begin begin = k > 0 || warm ? led : afresh;
            if (begin == led) recall(at);
            else ep.start();
            evaluate_inside(at, begin == afresh ? a.many : a.few, 0.3 * a.tol, value, slope, begin, *best == minus_inf);
            double may = 0.05 * q;
            for (int j = 0; j < q; j++) may += 2.0 * a.reference * std::fabs(d[j]);
            // too far, or no trajectory fits: where moments run apart the evidence says nothing
            const bool lost = !(value[0] > minus_inf) || (*best > minus_inf && !(f.residual[0] < ep_apart));
            if ((lost || !(value[0] - log_told(0) > kept_value - may)) && refused < 6) {
                refused++;
                if (*best == minus_inf) {  // the start itself: wider half-widths fit more
                    for (int j = 0; j < q; j++) phi[j] = min2(max2(phi[j] + (group[j] >= 0 ? 0.7 : 0.0), lo[j]), hi[j]);
                    warm = false;
                    k = -1;
                    if (refused == 6) return 2;
                } else {
                    for (int j = 0; j < q; j++) d[j] *= 0.3;
                }
                continue;
            }
            if (lost) return 1;  // stays where it was
            refused = 0;
            *best = value[0];
            kept_value = value[0] - log_told(0);
            a.held->log_prior = log_prior(trial, 0);
            for (int j = 0; j < q; j++) {
                phi[j] = trial[j];
                g[j] = slope[0][j] + (group[j] >= 0 ? 2.0 * a.reference * (1.0 - told(j, 0)) : 0.0);
            }
            for (int l = 1; l < wide_lanes; l++)
                if (along[l] >= 0 && value[l] > minus_inf) {
                    for (int i = 0; i < q; i++) {
                        const double saturates = group[i] >= 0 ? 2.0 * a.reference * (told(i, l) - told(i, 0)) : 0.0;
                        column[along[l]][i] = -(slope[l][i] - slope[0][i] - saturates) / h[l];
                    }
                    // an unmeasured column mirrors a measured one
                    for (int i = 0; i < q; i++)
                        if (!measured[i] && i != along[l]) column[i][along[l]] = column[along[l]][i];
                    if (!measured[along[l]]) missing--;
                    measured[along[l]] = true;
                }
            remember(0, phi);
            follow(along, h, value);
            hessian(column, H);
            length = step(H, phi, g, d);
            if (missing > 0) continue;
            if (length < (alone(H) ? min2(a.close, ep_near) : a.close)) return 0;
            if (length < sure && !alone(H)) {
                go(phi, d, g, best);
                return 0;
            }
        }
        return length < 1.0 ? 0 : 1;
    }

    // ---- the points' mixture ---------------------------------------------------------------------------------------

    // Gaussian that a stage's points are drawn from, about the mode: v = m + K z
    struct Stage {
        int count;
        double m[ep_free], K[ep_free][ep_free], log_det;  // of K
    };
    Stage stage[ep_stages] = {};
    int stages_used = 0;
    bool light = false;

    // v, 0 at the mode, of a parameter
    double place_of(int j, double phi, double mode) const {
        return group[j] < 0 ? phi - mode : (std::exp(a.warp * (phi - mode)) - 1.0) / a.warp;
    }
    // from mean and covariance; couplings shrink until the factor exists
    void plan(Stage& at, const double* m, const double (*S)[ep_free], double wide = ep_wide) const {
        for (double keep = 1.0; !factor(S, keep, at.K); keep *= 0.7) {}
        at.log_det = 0.0;
        for (int j = 0; j < q; j++) {
            at.m[j] = m[j];
            for (int i = 0; i <= j; i++) at.K[j][i] *= wide;
            at.log_det += std::log(at.K[j][j]);
        }
    }
    // log of the mixture of the stages' densities over the first stage's unit
    double log_drawn(const double* v, int total) const {
        double term[ep_stages], top = minus_inf, sum = 0.0;
        for (int k = 0; k < stages_used; k++) {
            const Stage& at = stage[k];
            double z[ep_free], square = 0.0;
            for (int i = 0; i < q; i++) {
                z[i] = v[i] - at.m[i];
                for (int j = 0; j < i; j++) z[i] -= at.K[i][j] * z[j];
                z[i] /= at.K[i][i];
                square += z[i] * z[i];
            }
            term[k] = std::log(static_cast<double>(at.count) / total) - 0.5 * square - (at.log_det - stage[0].log_det);
            top = max2(top, term[k]);
        }
        for (int k = 0; k < stages_used; k++) sum += std::exp(term[k] - top);
        return top + std::log(sum) - 0.5 * q * log_2pi;
    }
    // weights of the points so far, their sum one, into `share`; returns the effective number, 0: none is sound
    double weigh(const double* mode, int total, double* share, double* log_sum) const {
        double top = minus_inf, sum = 0.0, squares = 0.0;
        bool settled = false;  // a point that did not settle counts only where none did
        for (int k = 0; k < total; k++) settled = settled || (a.value[k] > minus_inf && a.residuals[k] < a.usable);
        for (int k = 0; k < total; k++) {
            double v[ep_free];
            for (int j = 0; j < q; j++) v[j] = place_of(j, a.phi[k * q + j], mode[j]);
            const bool counts = a.value[k] > minus_inf && (!settled || a.residuals[k] < a.usable);
            a.log_weight[k] = !counts ? minus_inf : stages_used ? a.value[k] - log_drawn(v, total) : a.value[k];
            top = max2(top, a.log_weight[k]);
        }
        if (top == minus_inf) return 0.0;
        for (int k = 0; k < total; k++) sum += share[k] = std::exp(a.log_weight[k] - top);
        for (int k = 0; k < total; k++) {
            share[k] /= sum;
            squares += share[k] * share[k];
        }
        *log_sum = top + std::log(sum);
        return 1.0 / squares;
    }
    // the next stage: moments of the weighted points, leaning on the first stage where few carry the weight
    void refit(const double* mode, int total, const double* share, double effective, const double (*first)[ep_free]) {
        double m[ep_free] = {}, S[ep_free][ep_free] = {};
        const double lean = effective / (effective + ep_lean), wider = lean * (1.0 + 1.0 / effective);
        for (int k = 0; k < total; k++)
            for (int j = 0; j < q; j++)
                if (share[k] > 0.0) m[j] += share[k] * place_of(j, a.phi[k * q + j], mode[j]);
        for (int k = 0; k < total; k++) {
            if (!(share[k] > 0.0)) continue;
            double d[ep_free];
            for (int j = 0; j < q; j++) d[j] = place_of(j, a.phi[k * q + j], mode[j]) - m[j];
            for (int i = 0; i < q; i++)
                for (int j = 0; j < q; j++) S[i][j] += wider * share[k] * d[i] * d[j];
        }
        for (int i = 0; i < q; i++)
            for (int j = 0; j < q; j++) S[i][j] += (1.0 - lean) * first[i][j];
        plan(stage[stages_used], m, S);
    }
    // mean over the states of the share of their variance that lies between points
    double between(int total) const {
        const double* share = a.share;
        const EpArgs& b = a.base;
        const std::ptrdiff_t size = stage_count();
        double all = 0.0;
        for (std::ptrdiff_t i = 0; i < size; i++) {
            double mean = 0.0, within = 0.0, apart = 0.0;
            for (int k = 0; k < total; k++)
                if (share[k] > 0.0) mean += share[k] * b.x[k * size + i];
            for (int k = 0; k < total; k++)
                if (share[k] > 0.0) {
                    const double d = b.x[k * size + i] - mean;
                    apart += share[k] * d * d;
                    within += share[k] * max2(b.P[(k * size + i) * ep.n + i % ep.n], 0.0);
                }
            all += apart / max2(apart + within, 1e-300);
        }
        return all / size;
    }

    // What a number of points leaves in doubt of the states, in standard deviations, by what `total` points found. A stage
    // has the mean and the covariance of its law, so with even weights what is linear in s^warp would be exact: points err
    // by as much as their weights are uneven.
    double doubt(int total, double effective, int count) const {
        return std::sqrt(between(total) * max2(total / effective - 1.0, 0.0) / count);
    }

    // weighted raw moments about `centre`
    void add(int l, double weight) {
        const EpArgs& b = a.base;
        const int n = ep.n;
        for (int t = 0; t <= b.T; t++) {
            const std::ptrdiff_t from = (static_cast<std::ptrdiff_t>(l) * (b.T + 1) + t) * n, to = static_cast<std::ptrdiff_t>(t) * n;
            for (int i = 0; i < n; i++) {
                const double d = b.x[from + i] - a.centre[to + i], v = max2(b.P[(from + i) * n + i], 0.0), sd = std::sqrt(v);
                const double m3 = b.k3[from + i] * v * sd, m4 = (b.k4[from + i] + 3.0) * v * v;
                a.x[to + i] += weight * d;
                a.k3[to + i] += weight * (m3 + 3.0 * v * d + d * d * d);
                a.k4[to + i] += weight * (m4 + 4.0 * m3 * d + 6.0 * v * d * d + d * d * d * d);
                for (int j = 0; j < n; j++)
                    a.P[(to + i) * n + j] += weight * (b.P[(from + i) * n + j] + d * (b.x[from + j] - a.centre[to + j]));
            }
        }
        if (a.out)
            for (int k = 0; k < b.rows; k++) a.out[k] += weight * b.out[static_cast<std::ptrdiff_t>(l) * b.rows + k];
    }
    void finish() {
        const int n = ep.n;
        for (int t = 0; t <= a.base.T; t++) {
            const std::ptrdiff_t to = static_cast<std::ptrdiff_t>(t) * n;
            for (int i = 0; i < n; i++) {
                const double d = a.x[to + i], raw2 = a.P[(to + i) * n + i], v = max2(raw2 - d * d, 1e-300);
                const double m3 = a.k3[to + i] - 3.0 * d * raw2 + 2.0 * d * d * d;
                const double m4 = a.k4[to + i] - 4.0 * d * a.k3[to + i] + 6.0 * d * d * raw2 - 3.0 * d * d * d * d;
                a.k3[to + i] = m3 / (v * std::sqrt(v));
                a.k4[to + i] = m4 / (v * v) - 3.0;
            }
            for (int i = 0; i < n; i++)
                for (int j = 0; j < n; j++) a.P[(to + i) * n + j] -= a.x[to + i] * a.x[to + j];
            for (int i = 0; i < n; i++) a.P[(to + i) * n + i] = max2(a.P[(to + i) * n + i], 0.0);
            for (int i = 0; i < n; i++) a.x[to + i] += a.centre[to + i];
        }
    }

    // the lanes' worth of points from k on, those before `end` that a stage asks for; found are their members, `phi`, `value`
    void evaluate_nodes(int k, int end, const Stage& now, const double* mode) {
        double at[wide_lanes][ep_free], value[wide_lanes], slope[wide_lanes][ep_free];
        bool inside[wide_lanes];
        const int column = light ? k : k + a.light;
        for (int l = 0; l < wide_lanes; l++) {
            inside[l] = k + l < end;
            for (int j = 0; j < q; j++) at[l][j] = mode[j];
            if (now.count > 1 && inside[l]) {
                for (int i = 0; i < q; i++) {
                    double v = now.m[i];
                    for (int j = 0; j <= i; j++) v += now.K[i][j] * a.z[(column + l) * q + j];
                    const double u = 1.0 + a.warp * v;  // s^warp over the mode's
                    at[l][i] = group[i] < 0 ? mode[i] + v : u > 0.0 ? mode[i] + std::log(u) / a.warp : lo[i] - 1.0;
                    if (at[l][i] > hi[i] || at[l][i] < lo[i]) inside[l] = false;
                }
                if (!inside[l])
                    for (int j = 0; j < q; j++) at[l][j] = mode[j];
            }
            put(l, at[l]);
        }
        ep.block = {k, k + wide_lanes - 1};
        if (outside) outside->block = ep.block;
        const Begin begin = now.count > 1 && resume(column, at) ? resumed : led;
        if (begin == led) recall(at);
        evaluate_inside(at, a.most, a.tol_nodes, value, slope, begin, false);
        if (now.count > 1) hold(column, at);
        const V more = ep.second(a.base.k3, a.base.k4);
        const V less = outside ? V(a.condition) * outside->second(nullptr, nullptr) : V(0.0);
        for (int l = 0; l < wide_lanes && k + l < end; l++) {
            for (int j = 0; j < q; j++) {
                a.phi[(k + l) * q + j] = at[l][j];
                a.node_slope[(k + l) * q + j] = f.slope[group[j] >= 0 ? group[j] : a.base.groups][l];
            }
            a.second[k + l] = finite(more[l]) ? more[l] : 0.0;  // so sharp a box that its cumulants overflow
            a.residuals[k + l] = f.residual[l];
            const double corrected = value[l] + a.second[k + l] - (finite(less[l]) ? less[l] : 0.0);
            a.value[k + l] = inside[l] && value[l] > minus_inf ? corrected : minus_inf;
        }
    }

    // The centre of the window after's nodes: that of these, moved to their mean where that lies too far. Whether it is to
    // be trusted: not the weight of a few.
    bool next_centre(int count, const double* mode, const double (*H)[ep_free], double effective) const {
        double mean[ep_free] = {};
        bool near = true;
        for (int j = 0; j < q; j++) {
            for (int k = 0; k < count; k++)
                if (a.share[k] > 0.0) mean[j] += a.share[k] * place_of(j, a.phi[k * q + j], mode[j]);
            near = near && std::fabs(mean[j]) * std::sqrt(H[j][j]) < a.near;
        }
        for (int j = 0; j < q; j++) {
            const double d = group[j] < 0 ? mean[j] : std::log(max2(1.0 + a.warp * mean[j], 0.1)) / a.warp;
            a.held->centre[j] = near ? mode[j] : min2(max2(mode[j] + d, lo[j]), hi[j]);
        }
        return effective > ep_least;
    }

    int run() {
        const EpArgs& b = a.base;
        if (parameters() < 0) return 3;
        double phi[ep_free] = {}, H[ep_free][ep_free] = {}, L[ep_free][ep_free] = {};
        for (int j = 0; j < q; j++) {
            const double start = group[j] >= 0 ? std::log(max2(a.start[group[j]], 1e-300)) : a.start_eps;
            phi[j] = min2(max2(start, lo[j]), hi[j]);
        }
        for (int l = 0; l < wide_lanes; l++) {
            for (int g = 0; g < b.groups; g++) {
                ep.s.s[g].set(l, a.start[g]);
                if (outside) outside->s.s[g].set(l, a.start[g]);
            }
            ep.s.eps.set(l, a.rate);
            put(l, phi);
        }
        for (int k = 0; k < a.columns * q; k++) a.held->lane_phi[k] = __builtin_nan("");
        const bool warm = b.warm;
        if (warm) {
            double from[ep_free];
            for (std::ptrdiff_t k = 0; k < stage_count(); k++) {
                keep_m[k] = b.m[k];
                keep_D[k] = b.D[k];
            }
            for (int k = 0; k < b.rows; k++) {
                keep_tau[k] = b.tau[k];
                keep_nu[k] = b.nu[k];
            }
            for (int j = 0; j < q; j++) from[j] = group[j] >= 0 ? std::log(max2(a.start[group[j]], 1e-300)) : phi[j];
            keep(from);
        }
        const EpCross wanted = ep.cross;
        ep.cross = EpCross{};
        double best = minus_inf;
        a.held->log_prior = 0.0;
        int code = 0;
        const bool calm = a.light > 0 && warm && a.before->lanes && a.before->doubt < a.enough;  // a light window may do
        const bool again = q > 0 && warm && a.before->lanes && a.before->since < (calm ? a.calm : a.again) &&
                           a.before->drop <= ep_few && b.T - a.before->common <= ep_few;
        if (again) {  // about where the nodes of the window before were
            double d[ep_free];
            for (int j = 0; j < q; j++) {
                phi[j] = min2(max2(a.before->centre[j], lo[j]), hi[j]);
                for (int i = 0; i < q; i++) H[j][i] = a.before->H[j * q + i];
                d[j] = phi[j] - kept[j];
            }
            draw(d);
            best = a.before->log_mode;  // in log s already
            a.held->log_prior = a.before->log_prior;
        } else if (q > 0) {
            // far from the mode the evidence of the bounds alone misleads: first without it
            Ep<N>* const bounds = outside;
            outside = nullptr;
            code = climb(phi, H, &best, warm, bounds ? 1.0 : ep_sure);
            if (code == 2) return 2;
            if (bounds) {
                outside = bounds;
                code = climb(phi, H, &best, true, ep_sure);
                if (code == 2) return 2;
            }
        } else {
            double at[wide_lanes][ep_free] = {}, value[wide_lanes], slope[wide_lanes][ep_free];
            if (warm) recall(at);
            else ep.start();
            evaluate_inside(at, a.most, a.tol_nodes, value, slope, warm ? led : afresh, true);
            if (value[0] == minus_inf) return 2;
            best = value[0];
            if (!(f.residual[0] < a.tol_nodes)) code = 1;
            remember(0, phi);
        }
        if (q > 0)
            for (double keep = 1.0; !factor(H, keep, L); keep *= 0.7) {}
        for (int j = 0; j < q; j++) {
            a.mode[j] = a.held->centre[j] = phi[j];
            for (int i = 0; i < q; i++) a.H[j * q + i] = a.held->H[j * q + i] = H[j][i];
        }
        // sites of the mode, for a warm start
        for (std::ptrdiff_t k = 0; k < stage_count(); k++) {
            b.m[k] = keep_m[k];
            b.D[k] = keep_D[k];
        }
        for (int k = 0; k < b.rows; k++) {
            b.tau[k] = keep_tau[k];
            b.nu[k] = keep_nu[k];
        }
        light = again && calm && !alone(H);
        const int nodes = alone(H) ? 1 : light ? a.nodes : a.nodes - a.light;
        ep.cross = wanted;
        if (outside) outside->cross = around;
        const std::ptrdiff_t size = stage_count();
        for (std::ptrdiff_t k = 0; k < size; k++) a.x[k] = a.k3[k] = a.k4[k] = 0.0;
        for (std::ptrdiff_t k = 0; k < size * ep.n; k++) a.P[k] = 0.0;
        if (a.out)
            for (int k = 0; k < b.rows; k++) a.out[k] = 0.0;
        double S[ep_free][ep_free] = {};  // H^-1
        if (nodes > 1) {
            for (int c = 0; c < q; c++) {
                double x[ep_free];
                for (int i = 0; i < q; i++) {
                    x[i] = i == c ? 1.0 : 0.0;
                    for (int j = 0; j < i; j++) x[i] -= L[i][j] * x[j];
                    x[i] /= L[i][i];
                }
                for (int i = q - 1; i >= 0; i--) {
                    for (int j = i + 1; j < q; j++) x[i] -= L[j][i] * x[j];
                    x[i] /= L[i][i];
                    S[i][c] = x[i];
                }
            }
            const double none[ep_free] = {};
            plan(stage[0], none, S, light ? 1.0 : ep_wide);
        }
        int done = 0;
        double effective = 0.0, log_sum = 0.0;
        while (done < nodes) {
            Stage& now = stage[stages_used];
            const int from = done, left = nodes - done;
            now.count = light && done == 0 ? a.light : left < 2 * a.stage || stages_used == ep_stages - 1 ? left : a.stage;
            for (; done < from + now.count; done += wide_lanes) evaluate_nodes(done, from + now.count, now, phi);
            done = from + now.count;
            if (nodes > 1) stages_used++;
            effective = weigh(phi, done, a.share, &log_sum);
            if (done == nodes) break;
            // elsewhere half-widths are asked for as well, which want points enough even if those were drawn at random
            const double least = light && done == a.light ? ep_least : ep_some;
            const double left_open = calm ? doubt(done, effective, done) : std::sqrt(between(done) / effective);
            if (effective > least && left_open < a.enough) break;
            if (effective > 0.0) refit(phi, done, a.share, effective, S);
            else stage[stages_used] = now;
        }
        *a.used = done;
        if (!(effective > 0.0)) return 2;
        *a.tells = !light || done > a.light;
        a.held->doubt = a.light ? doubt(done, effective, a.light) : 0.0;
        ep.block = {0, wide_lanes - 1};
        int heaviest = 0;
        for (int k = 1; k < done; k++)
            if (a.share[k] > a.share[heaviest]) heaviest = k;
        for (std::ptrdiff_t i = 0; i < size; i++) a.centre[i] = b.x[heaviest * size + i];
        *a.residual = 0.0;
        for (int k = 0; k < done; k++)
            if (a.share[k] > 0.0) {
                add(k, a.share[k]);
                *a.residual += a.share[k] * a.residuals[k];
            }
        finish();
        double half_log_det = 0.0;
        for (int j = 0; j < q; j++) {
            const double to_phi = group[j] >= 0 ? a.warp * phi[j] : 0.0;
            half_log_det += (nodes > 1 ? -std::log(stage[0].K[j][j]) : std::log(L[j][j])) - to_phi;
            if (again) continue;
            a.held->log_prior += to_phi;
            best += to_phi;
        }
        a.held->log_mode = best;
        *a.log_evidence = log_sum + (nodes > 1 ? -std::log(static_cast<double>(done)) : 0.5 * q * log_2pi) - half_log_det;
        *a.sweeps_used = sweeps;
        a.held->since = again ? a.before->since + 1 : 0;
        if (!next_centre(done, phi, H, effective) || nodes == 1) a.held->since = ep_never;
        return code;
    }
};

}  // namespace HW_ISA
}  // namespace hw
