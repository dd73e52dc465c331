// The code of a tape: its operations, numbered, and the arrays that hold a program. No arithmetic here.
#pragma once
#include <cstdint>

namespace hw {

// X(name, number of arguments); the order is the numbering that the Python tracer reads through `tape_operations`.
#define HW_TAPE_OPERATIONS(X)                                                                                          \
    X(constant, 0) X(input, 0)                                                                                         \
    X(negative, 1) X(absolute, 1) X(sqrt, 1) X(cbrt, 1) X(square, 1) X(reciprocal, 1) X(sign, 1)                       \
    X(exp, 1) X(exp2, 1) X(expm1, 1) X(log, 1) X(log2, 1) X(log10, 1) X(log1p, 1)                                      \
    X(sin, 1) X(cos, 1) X(tan, 1) X(arcsin, 1) X(arccos, 1) X(arctan, 1)                                               \
    X(sinh, 1) X(cosh, 1) X(tanh, 1) X(arcsinh, 1) X(arccosh, 1) X(arctanh, 1)                                         \
    X(floor, 1) X(ceil, 1) X(rint, 1) X(trunc, 1)                                                                      \
    X(add, 2) X(subtract, 2) X(multiply, 2) X(divide, 2) X(power, 2) X(arctan2, 2) X(hypot, 2)                         \
    X(maximum, 2) X(minimum, 2) X(remainder, 2) X(fmod, 2) X(floor_divide, 2)                                          \
    X(less, 2) X(less_equal, 2) X(equal, 2) X(not_equal, 2)                                                            \
    X(where, 3)

enum class TapeOp : int32_t {
#define HW_X(name, arity) name##_,
    HW_TAPE_OPERATIONS(HW_X)
#undef HW_X
        count_
};

struct Tape {
    const int32_t* code;      // (n, 4): op, a, b, c
    const double* constant;   // (n,): value of `constant` slots, else unused
    const int32_t* out;       // (n_out,): slots that are the answer
    const uint8_t* active;    // (n,): 1 where the slot depends on one of the first n_d inputs
    int n, n_in, n_out;
};

}  // namespace hw
