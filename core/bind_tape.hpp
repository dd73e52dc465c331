// Tapes at the border: arrays of Python checked once, so that no kernel can read outside its memory.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <vector>

#include "tape_code.hpp"

namespace hw {

namespace nb = nanobind;
using CodeArray = nb::ndarray<const int32_t, nb::shape<-1, 4>, nb::c_contig, nb::device::cpu>;
using SlotArray = nb::ndarray<const int32_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using VectorIn = nb::ndarray<const double, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using MatrixIn = nb::ndarray<const double, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;

// A tape with the memory it points to. `active` marks the slots that depend on the first n_d inputs.
struct OwnedTape {
    Tape tape;
    std::vector<uint8_t> active;
};

inline int tape_arity(int32_t op) {
    switch ((TapeOp)op) {
#define HW_X(name, arity) \
    case TapeOp::name##_: return arity;
        HW_TAPE_OPERATIONS(HW_X)
#undef HW_X
        default: return -1;
    }
}

inline OwnedTape own_tape(const CodeArray& code, const VectorIn& constant, const SlotArray& out, int n_in, int n_d) {
    const int n = (int)code.shape(0), n_out = (int)out.shape(0);
    if (n < 1 || n_out < 1 || n_in < 0 || (int)constant.shape(0) != n) throw nb::value_error("tape: sizes do not fit");
    OwnedTape owned{{code.data(), constant.data(), out.data(), nullptr, n, n_in, n_out}, std::vector<uint8_t>(n, 0)};
    for (int k = 0; k < n; ++k) {
        const int32_t* row = code.data() + 4 * k;
        const int arity = tape_arity(row[0]);
        if (arity < 0) throw nb::value_error("tape: unknown operation");
        if ((TapeOp)row[0] == TapeOp::input_) {
            if (row[1] < 0 || row[1] >= n_in) throw nb::value_error("tape: no such input");
            owned.active[k] = row[1] < n_d;
            continue;
        }
        for (int i = 1; i <= 3; ++i) {
            // Arguments come first; unused ones are 0, which is always a slot.
            if (row[i] < 0 || (i <= arity ? row[i] >= k : row[i] != 0)) throw nb::value_error("tape: argument out of order");
            if (i <= arity) owned.active[k] |= owned.active[row[i]];
        }
    }
    for (int i = 0; i < n_out; ++i)
        if (out.data()[i] < 0 || out.data()[i] >= n) throw nb::value_error("tape: no such slot");
    owned.tape.active = owned.active.data();
    return owned;
}

template <class T>
nb::ndarray<nb::numpy, T> fresh(std::initializer_list<size_t> shape) {
    size_t size = 1;
    for (size_t s : shape) size *= s;
    T* data = new T[size ? size : 1]();
    nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<T*>(p); });
    return nb::ndarray<nb::numpy, T>(data, shape.size(), shape.begin(), owner);
}

}  // namespace hw
