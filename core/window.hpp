// What a sliding window does to the rows it holds, whatever its method; plain loops over few rows and states.
#pragma once

#include <cmath>
#include <cstddef>

namespace hw {

// x (rows,n) <- x A' + u'B', kept in [lo, hi]; A (n,n), B (n,nu), u (nu,); B and lo, hi may be null. work (2 n)
inline void window_forecast(std::size_t rows, std::size_t n, std::size_t nu, double* x, const double* A, const double* B, const double* u,
                            const double* lo, const double* hi, double* work) {
    double *added = work, *moved = work + n;
    for (std::size_t i = 0; i < n; i++) {
        added[i] = 0.0;
        for (std::size_t j = 0; B && j < nu; j++) added[i] += B[i * nu + j] * u[j];
    }
    for (std::size_t k = 0; k < rows; k++, x += n) {
        for (std::size_t i = 0; i < n; i++) {
            double v = added[i];
            for (std::size_t j = 0; j < n; j++) v += A[i * n + j] * x[j];
            if (lo && v < lo[i]) v = lo[i];
            if (hi && v > hi[i]) v = hi[i];
            moved[i] = v;
        }
        for (std::size_t i = 0; i < n; i++) x[i] = moved[i];
    }
}

// least and largest of x (rows,n), each (n,), moved apart by grown (n,)
inline void window_ends(std::size_t rows, std::size_t n, const double* x, const double* grown, double* low, double* high) {
    for (std::size_t i = 0; i < n; i++) {
        low[i] = INFINITY;
        high[i] = -INFINITY;
    }
    for (std::size_t k = 0; k < rows; k++, x += n)
        for (std::size_t i = 0; i < n; i++) {
            if (x[i] < low[i]) low[i] = x[i];
            if (x[i] > high[i]) high[i] = x[i];
        }
    for (std::size_t i = 0; i < n; i++) {
        low[i] -= grown[i];
        high[i] += grown[i];
    }
}

// low, high (size,) take in x (size,)
inline void window_note(std::size_t size, const double* x, double* low, double* high) {
    for (std::size_t k = 0; k < size; k++) {
        if (x[k] < low[k]) low[k] = x[k];
        if (x[k] > high[k]) high[k] = x[k];
    }
}

// Whether x (n,) and P (n,n) are a Gaussian's: finite, with variances above 0, which are lifted by their rounding.
inline bool window_state(std::size_t n, const double* x, double* P) {
    bool good = true;
    for (std::size_t i = 0; i < n; i++) good = good && std::isfinite(x[i]) && P[i * n + i] > 0.0;
    for (std::size_t k = 0; k < n * n; k++) good = good && std::isfinite(P[k]);
    for (std::size_t i = 0; i < n; i++) P[i * n + i] += 1e-12 * P[i * n + i];
    return good;
}

// Size of an output y (count,), of this stride: its mean step from one to the next, 1 where it never moves.
inline double window_size(std::size_t count, std::ptrdiff_t stride, const double* y) {
    double sum = 0.0;
    for (std::size_t k = 1; k < count; k++) sum += std::fabs(y[stride * k] - y[stride * (k - 1)]);
    return sum > 0.0 ? sum / (count - 1) : 1.0;
}

// Sizes of the states, (nx,), by those of the outputs that have counts: what moves them by as much; effect (ny,nx)
inline void window_sizes(std::size_t nx, std::size_t ny, const double* effect, const std::size_t* counts, const double* outputs,
                         double* states) {
    for (std::size_t i = 0; i < nx; i++) {
        double gram = 0.0;
        for (std::size_t j = 0; j < ny; j++)
            if (counts[j]) gram += effect[j * nx + i] / (outputs[j] * outputs[j]);
        states[i] = gram > 0.0 ? 1.0 / std::sqrt(gram) : 1.0;
    }
}

// Where a search for half-widths begins, (p,): at `start` within its bounds, others at what they are.
inline void window_first(std::size_t p, const bool* free, const double* floor, const double* cap, const double* start, double* first) {
    for (std::size_t g = 0; g < p; g++) {
        const double s = start[g] > floor[g] ? start[g] : floor[g];
        first[g] = free[g] ? (s < cap[g] ? s : cap[g]) : floor[g] < cap[g] ? floor[g] : cap[g];
    }
}

// Half-widths at the mode, (p,): those that are not free at their caps. mode (free,) holds logarithms
inline void window_mode(std::size_t p, const bool* free, const double* cap, const double* mode, double* s) {
    for (std::size_t g = 0, j = 0; g < p; g++) s[g] = free[g] ? std::exp(mode[j++]) : cap[g];
}

}  // namespace hw
