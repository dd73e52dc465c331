// Python name of the filter for bounded plus Gaussian noise: mixed_run.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <optional>
#include <tuple>

#include "bind_tape.hpp"
#include "mixed_args.hpp"

using namespace hw;

namespace {

using StackIn = nb::ndarray<const double, nb::shape<-1, -1, -1>, nb::c_contig, nb::device::cpu>;
using IndexIn = nb::ndarray<const int32_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using MaskIn = nb::ndarray<const bool, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using Chosen = std::tuple<StackIn, std::optional<IndexIn>>;  // (K, ., .) and which of them each row uses

void expect(bool fits, const char* what) {
    if (!fits) throw nb::value_error(what);
}

Stack stacked(const Chosen& given, size_t rows, size_t columns, size_t T) {
    const auto& [value, index] = given;
    expect(value.shape(0) >= 1 && value.shape(1) == rows && value.shape(2) == columns, "mixed_run: size of a matrix");
    Stack s;
    s.a = value.data();
    if (index) {
        expect(index->shape(0) == T, "mixed_run: size of an index");
        for (size_t t = 0; t < T; ++t)
            expect(index->data()[t] >= 0 && (size_t)index->data()[t] < value.shape(0), "mixed_run: index out of range");
        s.index = index->data();
        s.step = (std::ptrdiff_t)(rows * columns);
    } else if (value.shape(0) != 1) {
        expect(value.shape(0) == T, "mixed_run: length of a stack");
        s.step = (std::ptrdiff_t)(rows * columns);
    }
    return s;
}

}  // namespace

void bind_mixed(nb::module_& m) {
    m.def("mixed_run", [](Chosen A, std::optional<MatrixIn> b, Chosen Q, Chosen G, Chosen C, Chosen r, Chosen half, MatrixIn y,
                          MaskIn seen, VectorIn m0, MatrixIn P0, MatrixIn X0, MatrixIn Z0, int form, int criterion, bool set_gain,
                          bool truncate, bool shrink, int capacity, double kappa, double a_fixed, double output) {
        const size_t T = y.shape(0), ny = y.shape(1), n = m0.shape(0), ng = std::get<0>(G).shape(2);
        expect(n >= 1 && ny >= 1, "mixed_run: nothing to estimate");
        expect(seen.shape(0) == T && seen.shape(1) == ny, "mixed_run: size of seen");
        expect(!b || (b->shape(0) == T && b->shape(1) == n), "mixed_run: size of b");
        expect(P0.shape(0) == n && P0.shape(1) == n && X0.shape(0) == n && X0.shape(1) == n, "mixed_run: size of P0 or X0");
        expect(capacity >= (int)n && Z0.shape(1) == n && Z0.shape(0) <= (size_t)capacity, "mixed_run: generators");
        MixedArgs a{};
        a.T = (long)T;
        a.n = (int)n;
        a.ny = (int)ny;
        a.ng = (int)ng;
        a.A = stacked(A, n, n, T);
        a.Q = stacked(Q, n, n, T);
        a.G = stacked(G, n, ng, T);
        a.C = stacked(C, ny, n, T);
        a.r = stacked(r, 1, ny, T);
        a.half = stacked(half, 1, ny, T);
        a.b = b ? b->data() : nullptr;
        a.y = y.data();
        a.seen = reinterpret_cast<const uint8_t*>(seen.data());
        a.m0 = m0.data();
        a.P0 = P0.data();
        a.X0 = X0.data();
        a.Z0 = Z0.data();
        a.count0 = (int)Z0.shape(0);
        a.form = form;
        a.criterion = criterion;
        a.set_gain = set_gain;
        a.truncate = truncate;
        a.shrink = shrink;
        a.capacity = capacity;
        a.kappa = kappa;
        a.a = a_fixed;
        a.output = output;
        auto mean = fresh<double>({T, n});
        auto P = fresh<double>({T, n, n});
        auto X = fresh<double>({T, n, n});
        auto width = fresh<double>({T, n});
        auto used = fresh<double>({T, ny});
        std::vector<double> Z(((size_t)capacity + ng + ny) * n), work(HW_PICK(mixed_workspace)(a));
        a.m = mean.data();
        a.P = P.data();
        a.X = X.data();
        a.width = width.data();
        a.a_used = used.data();
        a.Z = Z.data();
        {
            nb::gil_scoped_release free;
            HW_PICK(mixed_run)(a, work.data());
        }
        auto left = fresh<double>({(size_t)a.count, n});
        std::copy(Z.begin(), Z.begin() + a.count * (long)n, left.data());
        nb::dict answer;
        answer["m"] = mean;
        answer["P"] = P;
        answer["X"] = X;
        answer["half"] = width;
        answer["a"] = used;
        answer["Z"] = left;
        answer["contradicted"] = nb::make_tuple(a.contradicted, a.first_contradicted);
        answer["broken"] = a.broken;
        return answer;
    }, nb::arg("A"), nb::arg("b").none(), nb::arg("Q"), nb::arg("G"), nb::arg("C"), nb::arg("r"), nb::arg("half"), nb::arg("y"),
       nb::arg("seen"), nb::arg("m0"), nb::arg("P0"), nb::arg("X0"), nb::arg("Z0"), nb::arg("form"), nb::arg("criterion"),
       nb::arg("set_gain"), nb::arg("truncate"), nb::arg("shrink"), nb::arg("capacity"), nb::arg("kappa"), nb::arg("a"),
       nb::arg("output"),
       "Filter for x[t] = A x[t-1] + b[t] + w + G d, y_i = C_i x + v_i + e_i with Gaussian w, v and |d| <= 1, |e_i| <= half_i.\n"
       "Matrices are (stack (K, ., .), index or None). m (T, n), P and X (T, n, n), half-widths of the set (T, n), the scalar\n"
       "of each correction (T, ny), generators after the last row, contradicted (rows, first), first broken row or -1.");
}
