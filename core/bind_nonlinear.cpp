// Python name of the extended and unscented filters and smoothers: nonlinear_run.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <optional>
#include <tuple>

#include "bind_tape.hpp"
#include "nonlinear_args.hpp"

using namespace hw;

namespace {

using StackIn = nb::ndarray<const double, nb::shape<-1, -1, -1>, nb::c_contig, nb::device::cpu>;
using IndexIn = nb::ndarray<const int32_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using MaskIn = nb::ndarray<const bool, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
using FlagIn = nb::ndarray<const bool, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
using TapeIn = std::tuple<CodeArray, VectorIn, SlotArray>;

void expect(bool fits, const char* what) {
    if (!fits) throw nb::value_error(what);
}

// (K, n, n): one matrix for all rows, one for each, or chosen by index.
Stack stacked(const StackIn& value, const std::optional<IndexIn>& index, size_t n, size_t T) {
    expect(value.shape(0) >= 1 && value.shape(1) == n && value.shape(2) == n, "nonlinear_run: size of Q or R");
    Stack s;
    s.a = value.data();
    if (index) {
        expect(index->shape(0) == T, "nonlinear_run: size of an index");
        for (size_t t = 0; t < T; ++t)
            expect(index->data()[t] >= 0 && (size_t)index->data()[t] < value.shape(0), "nonlinear_run: index out of range");
        s.index = index->data();
        s.step = (std::ptrdiff_t)(n * n);
    } else if (value.shape(0) != 1) {
        expect(value.shape(0) == T, "nonlinear_run: length of Q or R");
        s.step = (std::ptrdiff_t)(n * n);
    }
    return s;
}

}  // namespace

void bind_nonlinear(nb::module_& m) {
    m.def("nonlinear_run", [](TapeIn g, TapeIn h, MatrixIn gu, MatrixIn hu, StackIn Q, std::optional<IndexIn> Q_index, StackIn R,
                              std::optional<IndexIn> R_index, VectorIn x0, MatrixIn P0, MatrixIn y, MaskIn seen, FlagIn wrap_x,
                              FlagIn wrap_y, double spread, double centre, double weight, int iterations,
                              std::optional<MatrixIn> about, bool smooth) {
        const size_t T = y.shape(0), nx = x0.shape(0), ny = y.shape(1);
        expect(nx >= 1 && ny >= 1, "nonlinear_run: nothing to estimate");
        expect(std::get<2>(g).shape(0) == nx && std::get<2>(h).shape(0) == ny, "nonlinear_run: outputs of g or h");
        expect(gu.shape(0) == T && hu.shape(0) == T, "nonlinear_run: rows of gu or hu");
        expect(P0.shape(0) == nx && P0.shape(1) == nx, "nonlinear_run: size of P0");
        expect(seen.shape(0) == T && seen.shape(1) == ny, "nonlinear_run: size of seen");
        expect(wrap_x.shape(0) == nx && wrap_y.shape(0) == ny, "nonlinear_run: size of wrap_x or wrap_y");
        expect(!about || (about->shape(0) == T + 1 && about->shape(1) == nx), "nonlinear_run: size of about");
        expect(spread >= 0.0 && iterations >= 1, "nonlinear_run: spread or iterations");

        OwnedTape tape_g = own_tape(std::get<0>(g), std::get<1>(g), std::get<2>(g), (int)(nx + gu.shape(1)), (int)nx);
        OwnedTape tape_h = own_tape(std::get<0>(h), std::get<1>(h), std::get<2>(h), (int)(nx + hu.shape(1)), (int)nx);
        auto x = fresh<double>({T, nx});
        auto P = fresh<double>({T, nx, nx});
        auto x0s = fresh<double>({nx});
        auto P0s = fresh<double>({nx, nx});
        auto loglik = fresh<double>({T});
        auto nis = fresh<double>({T});
        NonlinearArgs a{};
        a.T = (long)T;
        a.nx = (int)nx;
        a.ny = (int)ny;
        a.g = tape_g.tape;
        a.h = tape_h.tape;
        a.gu = gu.data();
        a.hu = hu.data();
        a.Q = stacked(Q, Q_index, nx, T);
        a.R = stacked(R, R_index, ny, T);
        a.x0 = x0.data();
        a.P0 = P0.data();
        a.y = y.data();
        a.seen = reinterpret_cast<const uint8_t*>(seen.data());
        a.wrap_x = reinterpret_cast<const uint8_t*>(wrap_x.data());
        a.wrap_y = reinterpret_cast<const uint8_t*>(wrap_y.data());
        a.spread = spread;
        a.centre = centre;
        a.weight = weight;
        a.iterations = iterations;
        a.about = about ? about->data() : nullptr;
        a.smooth = smooth;
        a.x = x.data();
        a.P = P.data();
        a.x0s = x0s.data();
        a.P0s = P0s.data();
        a.loglik = loglik.data();
        a.nis = nis.data();
        std::vector<double> kept(smooth ? T * nx * (1 + 2 * nx) : 0);
        a.xp = kept.data();
        a.G = a.xp + (smooth ? T * nx : 0);
        a.M = a.G + (smooth ? T * nx * nx : 0);
        std::vector<double> work(HW_PICK(nonlinear_workspace)(a));
        {
            nb::gil_scoped_release free;
            HW_PICK(nonlinear_run)(a, work.data());
        }
        nb::dict answer;
        answer["x"] = x;
        answer["P"] = P;
        answer["loglik"] = loglik;
        answer["nis"] = nis;
        if (smooth) {
            answer["x0"] = x0s;
            answer["P0"] = P0s;
        }
        auto put = [&](const char* name, const NonlinearArgs::Count& c) { answer[name] = nb::make_tuple(c.rows, c.first); };
        put("bad_g", a.bad_g);
        put("bad_h", a.bad_h);
        put("repaired", a.repaired);
        put("contradicted", a.contradicted);
        return answer;
    }, nb::arg("g"), nb::arg("h"), nb::arg("gu"), nb::arg("hu"), nb::arg("Q"), nb::arg("Q_index").none(), nb::arg("R"),
       nb::arg("R_index").none(), nb::arg("x0"), nb::arg("P0"), nb::arg("y"), nb::arg("seen"), nb::arg("wrap_x"),
       nb::arg("wrap_y"), nb::arg("spread"), nb::arg("centre"), nb::arg("weight"), nb::arg("iterations"),
       nb::arg("about").none(), nb::arg("smooth"),
       "Extended (spread = 0) or unscented filter, and smoother if asked, of x[t] = g(x[t-1], gu[t]) + w[t],\n"
       "y[t] = h(x[t], hu[t]) + e[t] on tapes (code, constant, out). x (T, nx), P (T, nx, nx), loglik and nis (T,),\n"
       "smoothed x0 and P0, and for each trouble (rows, first row or -1).");
}
