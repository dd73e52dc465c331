// Python's door to core/drive.cpp: arrays in, a dict of arrays out, no logic.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <memory>
#include <optional>

#include "bind_array.hpp"
#include "drive_entry.hpp"

using namespace nb::literals;

namespace {

using Vector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Table = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Mask = nb::ndarray<const bool, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Offsets = nb::ndarray<const std::int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Order = nb::ndarray<const std::int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

void need(bool ok, const char* what) {
    if (!ok) throw nb::value_error(what);
}

nb::dict smooth(const Offsets& offsets, const Order& order, const Vector& h, const Vector& d, const Vector& w,
                const Vector& middle, const Vector& S, const Vector& C, const Vector& along, const Vector& aside,
                const Vector& yaw, const Vector& keep, const Vector& fade, const Vector& q_offset, const Vector& q_drift,
                double scale_walk, double bias_walk, const Table& y, const Mask& seen, const Vector& r, const Table& x0,
                const Table& P0, const std::optional<Vector>& turn, const std::optional<Vector>& stay,
                const std::optional<Vector>& q_turn, bool covariances, bool squares) {
    need(offsets.shape(0) >= 1, "offsets has at least one entry");
    const std::size_t n = offsets.shape(0) - 1, R = h.shape(0), size = turn ? 10 : 9;
    hw::DriveArgs a{};
    a.n = static_cast<int>(n);
    a.size = static_cast<int>(size);
    a.offsets = offsets.data();
    need(offsets.data()[0] == 0 && offsets.data()[n] == static_cast<std::int64_t>(R),
         "offsets begin with 0 and end with the number of rows");
    std::int64_t longest = 0;
    for (std::size_t i = 0; i < n; i++) {
        const std::int64_t rows = offsets.data()[i + 1] - offsets.data()[i];
        need(rows >= 1, "each drive has a row");
        longest = rows > longest ? rows : longest;
    }
    need(order.shape(0) == n, "order has an entry for each drive");
    for (std::size_t i = 0; i < n; i++)
        need(order.data()[i] >= 0 && order.data()[i] < a.n, "order has numbers of drives");
    a.order = order.data();
    auto rows_of = [&](const Vector& v) {
        need(v.shape(0) == R, "one number for each row");
        return v.data();
    };
    a.h = rows_of(h); a.d = rows_of(d); a.w = rows_of(w);
    a.middle = rows_of(middle); a.S = rows_of(S); a.C = rows_of(C);
    a.along = rows_of(along); a.aside = rows_of(aside); a.yaw = rows_of(yaw);
    a.keep = rows_of(keep); a.fade = rows_of(fade);
    a.q_offset = rows_of(q_offset); a.q_drift = rows_of(q_drift);
    a.scale_walk = scale_walk;
    a.bias_walk = bias_walk;
    if (turn) {
        need(stay && q_turn, "a turn needs what stays of it and what comes in");
        a.turn = rows_of(*turn); a.stay = rows_of(*stay); a.q_turn = rows_of(*q_turn);
    }
    need(y.shape(0) == R && y.shape(1) == 2 && seen.shape(0) == R, "fixes are (R, 2), seen (R,)");
    a.y = y.data();
    a.seen = reinterpret_cast<const std::uint8_t*>(seen.data());
    need(r.shape(0) == n && x0.shape(0) == n && P0.shape(0) == n && x0.shape(1) == size && P0.shape(1) == size,
         "r is (n,), x0 and P0 are (n, size)");
    a.r = r.data(); a.x0 = x0.data(); a.P0 = P0.data();

    const auto rows = static_cast<std::int64_t>(R), states = static_cast<std::int64_t>(size);
    const auto drives = static_cast<std::int64_t>(n);
    nb::dict out;
    auto give = [&](const char* name, std::initializer_list<std::int64_t> shape) {
        Fresh f(shape);
        out[name] = f.array;
        return f.a;
    };
    a.x = give("x", {rows, states});
    a.P = covariances ? give("P", {rows, states, states}) : nullptr;
    a.squares = squares ? give("squares", {rows, hw::drive_groups}) : nullptr;
    a.spread = squares ? give("spread", {rows, hw::drive_groups}) : nullptr;
    a.misfit = give("misfit", {drives});
    a.unsure = give("unsure", {drives});
    a.counted = give("counted", {drives});
    a.loglik = give("loglik", {drives});
    nb::list code;
    Fresh work({static_cast<std::int64_t>(hw::drive_work(longest, a.size))});
    std::unique_ptr<std::int32_t[]> codes(new std::int32_t[n + 1]());
    a.work = work.a;
    a.code = codes.get();
    {
        nb::gil_scoped_release release;
        HW_PICK(drive_smooth)(a);
    }
    for (std::size_t i = 0; i < n; i++) code.append(codes[i]);
    out["code"] = code;
    return out;
}

}  // namespace

void bind_drive(nb::module_& m) {
    m.def("drive_smooth", &smooth, nb::kw_only(), "offsets"_a, "order"_a, "h"_a, "d"_a, "w"_a, "middle"_a, "S"_a, "C"_a,
          "along"_a, "aside"_a, "yaw"_a, "keep"_a, "fade"_a, "q_offset"_a, "q_drift"_a, "scale_walk"_a, "bias_walk"_a,
          "y"_a, "seen"_a, "r"_a, "x0"_a, "P0"_a, "turn"_a = nb::none(), "stay"_a = nb::none(), "q_turn"_a = nb::none(),
          "covariances"_a = true, "squares"_a = true,
          "One round of the chain of drives; core/drive.hpp says what the numbers are.");
}
