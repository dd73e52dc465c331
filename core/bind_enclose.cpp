// Python names of the enclosures of tapes: tape_derivatives, tape_affine.
#include "bind_tape.hpp"
#include "enclose_kernels.hpp"

using namespace hw;

namespace {

// Lower and upper ends side by side, (n_in, 2).
std::vector<double> box(const VectorIn& lo, const VectorIn& hi) {
    if (lo.shape(0) != hi.shape(0)) throw nb::value_error("tape: lo and hi differ in size");
    std::vector<double> in(2 * lo.shape(0));
    for (size_t i = 0; i < lo.shape(0); ++i) {
        if (!(lo.data()[i] <= hi.data()[i])) throw nb::value_error("tape: a box needs lo <= hi");
        in[2 * i] = lo.data()[i];
        in[2 * i + 1] = hi.data()[i];
    }
    return in;
}

void judge(int n_d, size_t n_in) {
    if (n_d < 0 || n_d > (int)n_in || n_d > enclose_most) throw nb::value_error("tape: n_d must be 0...n_in, 64 at most");
}

}  // namespace

void bind_enclose(nb::module_& m) {
    m.def("tape_derivatives", [](CodeArray code, VectorIn constant, SlotArray out, VectorIn lo, VectorIn hi, int n_d) {
        judge(n_d, lo.shape(0));
        const std::vector<double> in = box(lo, hi);
        OwnedTape owned = own_tape(code, constant, out, (int)lo.shape(0), n_d);
        const size_t h = (size_t)n_d * (n_d + 1) / 2, m_out = out.shape(0);
        auto value = fresh<double>({m_out, 2});
        auto slope = fresh<double>({m_out, (size_t)n_d, 2});
        auto bend = fresh<double>({m_out, h, 2});
        std::vector<double> work(2 * (size_t)owned.tape.n * (1 + n_d + h));
        {
            nb::gil_scoped_release free;
            HW_PICK(enclose_derivatives)(owned.tape, n_d, in.data(), value.data(), slope.data(), bend.data(), work.data());
        }
        return nb::make_tuple(value, slope, bend);
    }, nb::arg("code"), nb::arg("constant"), nb::arg("out"), nb::arg("lo"), nb::arg("hi"), nb::arg("n_d"),
       "Enclosures over the box lo <= x <= hi: values (n_out, 2), Jacobian (n_out, n_d, 2), upper triangles of Hessians.");

    m.def("tape_affine", [](CodeArray code, VectorIn constant, SlotArray out, VectorIn lo, VectorIn hi, int n_d) {
        judge(n_d, lo.shape(0));
        const std::vector<double> in = box(lo, hi);
        OwnedTape owned = own_tape(code, constant, out, (int)lo.shape(0), n_d);
        const size_t h = (size_t)n_d * (n_d + 1) / 2, m_out = out.shape(0);
        auto J = fresh<double>({m_out, (size_t)n_d});
        auto k = fresh<double>({m_out});
        auto half = fresh<double>({m_out});
        auto value = fresh<double>({m_out, 2});
        std::vector<double> work(2 * ((size_t)owned.tape.n * (2 + 2 * n_d + h) + lo.shape(0)));
        {
            nb::gil_scoped_release free;
            HW_PICK(enclose_affine)(owned.tape, n_d, in.data(), J.data(), k.data(), half.data(), value.data(), work.data());
        }
        return nb::make_tuple(J, k, half, value);
    }, nb::arg("code"), nb::arg("constant"), nb::arg("out"), nb::arg("lo"), nb::arg("hi"), nb::arg("n_d"),
       "J (n_out, n_d), k, half (n_out,) with |f - J x - k| <= half over the box, and values (n_out, 2) of f there.");
}
