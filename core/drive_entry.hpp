// One round of the chain of drives; see core/drive.hpp.
#pragma once

#include <cstddef>
#include <cstdint>

#include "isa.hpp"

namespace hw {

constexpr int drive_groups = 5;   // residuals along and aside of the way, of yaw, offset and drift
constexpr int drive_broken = 3;   // the code of a drive whose numbers left the range of floating point
constexpr int drive_abreast = 4;  // drives that are solved side by side

struct DriveArgs {
    int n, size;                   // drives; states: 9, or 10 with a turn
    const std::int64_t* offsets;   // (n+1,): rows of drive i are offsets[i] .. offsets[i+1]-1, at least one
    const std::int32_t* order;     // (n,): drives, the longest first: which go side by side
    // (R,) of the step that ends in each row; those of the first row of a drive are not used
    const double *h, *d, *w;                     // seconds, metres, yaw rate
    const double *middle, *S, *C;                // azimuth in its middle, sine and cosine of it
    const double *along, *aside, *yaw;           // variances
    const double *keep, *fade;                   // what is left of offset and drift
    const double *q_offset, *q_drift;            // variances that come in
    double scale_walk, bias_walk;                // the same of scale and bias, a second
    const double *turn, *stay, *q_turn;          // rad/s of one unit of the turn, what is left of it, what comes in; or null
    const double* y;               // (R,2): fixes
    const std::uint8_t* seen;      // (R,)
    const double *r, *x0, *P0;     // (n,) variance of a fix; (n,size) mean and variances before the first row
    // found
    double* x;                     // (R,size)
    double* P;                     // (R,size,size) or null
    double *squares, *spread;      // (R,groups) or null: squares of the residuals' means, their variances; 0 in first rows
    double *misfit, *unsure;       // (n,): sums of squares of what fixes are off the path, both axes; of their variances
    double* counted;               // (n,): number of fixes
    double* loglik;                // (n,)
    std::int32_t* code;            // (n,): 0, or `drive_broken`: then not all of the above is finite
    double* work;                  // drive_work doubles
};

// Doubles of workspace for drives of at most so many rows.
inline std::size_t drive_work(std::int64_t rows, int size) {
    return static_cast<std::size_t>(rows) * drive_abreast * static_cast<std::size_t>(size + size * (size + 1) / 2);
}

}  // namespace hw

HW_KERNEL(void, drive_smooth, const ::hw::DriveArgs& args)
