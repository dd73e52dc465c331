// Binding of loss.hpp: a whole record at once (`loss_filter`) and row by row (`LossStream`).
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <cmath>
#include <cstring>
#include <memory>
#include <new>
#include <optional>
#include <stdexcept>
#include <vector>

#include "loss.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using In = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using InBool = nb::ndarray<const bool, nb::c_contig, nb::device::cpu>;

// Doubles on a 32-byte boundary, zeroed.
struct Buffer {
    explicit Buffer(std::size_t size = 0) : n(size) {
        if (n) {
            p = static_cast<double*>(::operator new(n * sizeof(double), std::align_val_t(32)));
            std::memset(p, 0, n * sizeof(double));
        }
    }
    ~Buffer() { ::operator delete(p, std::align_val_t(32)); }
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    std::size_t n;
    double* p = nullptr;
};

nb::object give(std::vector<std::size_t> shape, double** p) {
    std::size_t size = 1;
    for (std::size_t s : shape) size *= s;
    *p = new double[size ? size : 1]();
    nb::capsule owner(*p, [](void* q) noexcept { delete[] static_cast<double*>(q); });
    return nb::cast(nb::ndarray<nb::numpy, double>(*p, shape.size(), shape.data(), owner));
}

void want(bool ok, const char* what) {
    if (!ok) throw std::invalid_argument(what);
}

hw::LossState settings(int n, int m, int M, int G, int K, int rule, int depth, bool spread, int learn, double threshold,
                       std::uint64_t seed) {
    want(n > 0 && m > 0 && M > 0 && G > 0 && K > 0, "sizes must be positive");
    want(rule >= hw::loss_decide && rule <= hw::loss_beam, "no such rule");
    want(!learn || M == 1 << G, "a learned law needs one mode per pattern of received sensors");
    if (rule == hw::loss_average) {
        K = 1;
        for (int i = 0; i < depth; i++) K *= M;
    }
    hw::LossState s;
    s.n = n;
    s.m = m;
    s.M = M;
    s.G = G;
    s.K = K;
    s.rule = rule;
    s.depth = depth;
    s.spread = spread;
    s.learn = learn;
    s.threshold = threshold;
    s.rng = seed;
    return s;
}

// A state together with its memory.
struct Memory {
    explicit Memory(const hw::LossState& sizes) : s(sizes) {
        long n_int = 0;
        const long n = HW_PICK(loss_place)(s, nullptr, nullptr, &n_int);
        d = std::make_unique<Buffer>(static_cast<std::size_t>(n));
        i.assign(static_cast<std::size_t>(n_int), 0);
        HW_PICK(loss_place)(s, d->p, i.data(), &n_int);
    }
    hw::LossState s;
    std::unique_ptr<Buffer> d;
    std::vector<int> i;
};

long stride(const In& a, std::size_t T, std::size_t part) {  // (1 or T, ...) arrays: 0 or the size of one row's part
    want(a.ndim() > 0 && (a.shape(0) == 1 || a.shape(0) == T) && a.size() == a.shape(0) * part, "array of a wrong shape");
    return a.shape(0) == 1 ? 0 : static_cast<long>(part);
}

nb::dict filter(In A, std::optional<In> b, In Q, In C, std::optional<In> d, In R, In Pi, In y, InBool seen, In x0, In P0,
                In pi0, std::optional<In> count, int groups, int rule, int components, int depth, bool spread, int learn,
                double threshold, std::uint64_t seed, bool prior_predicted, int smooth, int lag) {
    want(y.ndim() == 2 && seen.size() == y.size() && C.ndim() == 4, "y (T, m), seen (T, m), C (1 or T, M, m, n)");
    const std::size_t T = y.shape(0), m = y.shape(1), M = C.shape(1), n = x0.size(), G = static_cast<std::size_t>(groups);
    Memory own(settings(int(n), int(m), int(M), groups, components, rule, depth, spread, learn, threshold, seed));
    hw::LossState& s = own.s;
    hw::LossArgs k{};
    k.T = static_cast<int>(T);
    k.A = A.data(); k.sA = stride(A, T, n * n);
    if (b) { k.b = b->data(); k.sb = stride(*b, T, n); }
    k.Q = Q.data(); k.sQ = stride(Q, T, n * n);
    k.C = C.data(); k.sC = stride(C, T, M * m * n);
    if (d) { k.d = d->data(); k.sd = stride(*d, T, M * m); }
    k.R = R.data(); k.sR = stride(R, T, M * m * m);
    k.Pi = Pi.data(); k.sPi = stride(Pi, T, M * M);
    k.y = y.data();
    k.seen = seen.data();
    k.prior_predicted = prior_predicted;
    k.smooth = smooth;
    k.lag = lag;
    want(P0.size() == n * n && pi0.size() == M, "P0 (n, n), pi0 (M,)");
    want(!learn || (count && count->size() == G * 4), "count (G, 2, 2)");
    want(!smooth || s.rule == hw::loss_average || s.rule == hw::loss_decide, "this rule does not smooth");
    want(smooth != 2 || lag > 0, "a fixed lag must be positive");
    const std::size_t cells = s.rule == hw::loss_decide ? 1 : M * static_cast<std::size_t>(s.K);
    const std::size_t slots = smooth == 0 ? 0 : smooth == 1 ? T : static_cast<std::size_t>(lag) + 1;
    Buffer past(slots * cells * (1 + n + n * n));
    Buffer smoother(smooth ? (cells + static_cast<std::size_t>(s.K)) * (1 + n + n * n) : 0);
    if (smooth) {
        k.past = {past.p, past.p + slots * cells, past.p + slots * cells * (1 + n), int(cells), int(slots)};
        k.sw = smoother.p;
        k.sx = k.sw + cells;
        k.sP = k.sx + cells * n;
        k.pw = k.sP + cells * n * n;
        k.px = k.pw + s.K;
        k.pP = k.px + static_cast<std::size_t>(s.K) * n;
    }
    nb::dict out;
    out["x"] = give({T, n}, &k.x);
    out["P"] = give({T, n, n}, &k.P);
    out["modes"] = give({T, M}, &k.modes);
    out["loglik"] = give({T}, &k.loglik);
    if (learn) out["law"] = give({T, G, 2}, &k.law);
    if (smooth == 1) out["pairs"] = give({M, M}, &k.pairs);
    int bad_row = -1, void_rows = 0, code = 0;
    k.bad_row = &bad_row;
    k.void_rows = &void_rows;
    {
        nb::gil_scoped_release release;
        HW_PICK(loss_start)(s, x0.data(), P0.data(), pi0.data(), count ? count->data() : nullptr);
        if (T) code = HW_PICK(loss_filter)(s, k);
    }
    out["code"] = code;
    out["bad_row"] = bad_row;
    out["void_rows"] = void_rows;
    return out;
}

// A filter fed row by row. The model's matrices are kept between rows and may be replaced at any row.
class LossStream {  // not just Stream: nanobind tells types apart by name, across files
  public:
    LossStream(int n, int m, int M, int groups, int rule, int components, int depth, bool spread, int learn,
           double threshold, std::uint64_t seed, In x0, In P0, In pi0, std::optional<In> count)
        : own(settings(n, m, M, groups, components, rule, depth, spread, learn, threshold, seed)),
          A(n * n), Q(n * n), b(n), C(M * m * n), d(M * m), R(M * m * m), logPi(M * M), y(m), seen(m) {
        want(x0.size() == std::size_t(n) && P0.size() == std::size_t(n) * n && pi0.size() == std::size_t(M),
             "x0 (n,), P0 (n, n), pi0 (M,)");
        want(!learn || (count && count->size() == std::size_t(groups) * 4), "count (G, 2, 2)");
        HW_PICK(loss_start)(own.s, x0.data(), P0.data(), pi0.data(), count ? count->data() : nullptr);
    }

    void motion(In A_, In Q_) {
        want(A_.size() == A.size() && Q_.size() == Q.size(), "A (n, n), Q (n, n)");
        A.assign(A_.data(), A_.data() + A.size());
        Q.assign(Q_.data(), Q_.data() + Q.size());
    }

    void output(In C_, In R_) {
        want(C_.size() == C.size() && R_.size() == R.size(), "C (M, m, n), R (M, m, m)");
        C.assign(C_.data(), C_.data() + C.size());
        R.assign(R_.data(), R_.data() + R.size());
        own.s.fresh = 1;
    }

    void chain(In Pi) {
        want(Pi.size() == logPi.size(), "Pi (M, M)");
        for (std::size_t i = 0; i < logPi.size(); i++) logPi[i] = Pi.data()[i] > 0 ? std::log(Pi.data()[i]) : -INFINITY;
    }

    // One row: y (m,) with NaN where missing, b (n,) what the input adds, d (M, m) the modes' offsets.
    nb::tuple push(In y_, std::optional<In> b_, std::optional<In> d_, bool predict) {
        hw::LossState& s = own.s;
        want(y_.size() == y.size(), "y (m,)");
        want(!b_ || b_->size() == b.size(), "b (n,)");
        want(!d_ || d_->size() == d.size(), "d (M, m)");
        for (std::size_t i = 0; i < y.size(); i++) {
            const double v = y_.data()[i];
            seen[i] = !std::isnan(v);
            want(!std::isinf(v), "an output is infinite");
            y[i] = seen[i] ? v : 0.0;
        }
        double *x, *P, *modes, *law = nullptr;
        const std::size_t n = std::size_t(s.n), M = std::size_t(s.M);
        nb::object ox = give({n}, &x), oP = give({n, n}, &P), om = give({M}, &modes), ol = nb::none();
        if (s.learn) ol = give({std::size_t(s.G), 2}, &law);
        hw::LossRow r{predict ? A.data() : nullptr, b_ ? b_->data() : nullptr, Q.data(), C.data(),
                      d_ ? d_->data() : nullptr, R.data(), y.data(), reinterpret_cast<const bool*>(seen.data()),
                      logPi.data()};
        hw::LossOut o{x, P, modes, law, 0.0};
        const int code = HW_PICK(loss_step)(s, r, o, nullptr, 0);
        return nb::make_tuple(ox, oP, om, o.loglik, code, ol);
    }

    // Everything a later process needs to go on from here.
    nb::bytes state() const {
        const hw::LossState& s = own.s;
        std::vector<char> out;
        auto add = [&](const void* p, std::size_t size) {
            const char* c = static_cast<const char*>(p);
            out.insert(out.end(), c, c + size);
        };
        const long swapped = s.x > s.x2;  // which bank is the current one
        const long head[4] = {swapped, s.live, s.started, 0};
        add(head, sizeof head);
        add(&s.rng, sizeof s.rng);
        add(own.d->p, own.d->n * sizeof(double));
        add(own.i.data(), own.i.size() * sizeof(int));
        for (const auto* v : {&A, &Q, &C, &R, &logPi}) add(v->data(), v->size() * sizeof(double));
        return nb::bytes(out.data(), out.size());
    }

    void restore(nb::bytes from) {
        hw::LossState& s = own.s;
        const char* p = from.c_str();
        long head[4];
        std::size_t size = sizeof head + sizeof s.rng + own.d->n * sizeof(double) + own.i.size() * sizeof(int);
        for (const auto* v : {&A, &Q, &C, &R, &logPi}) size += v->size() * sizeof(double);
        want(from.size() == size, "this state belongs to another model or method");
        auto get = [&](void* to, std::size_t bytes) {
            std::memcpy(to, p, bytes);
            p += bytes;
        };
        get(head, sizeof head);
        want((head[0] == 0 || head[0] == 1) && head[1] > 0 && head[1] <= s.K, "this state is damaged");
        get(&s.rng, sizeof s.rng);
        get(own.d->p, own.d->n * sizeof(double));
        get(own.i.data(), own.i.size() * sizeof(int));
        for (auto* v : {&A, &Q, &C, &R, &logPi}) get(v->data(), v->size() * sizeof(double));
        if (head[0] != static_cast<long>(s.x > s.x2)) {
            std::swap(s.x, s.x2);
            std::swap(s.P, s.P2);
            std::swap(s.count, s.count2);
            std::swap(s.mode, s.mode2);
        }
        s.live = static_cast<int>(head[1]);
        s.started = static_cast<int>(head[2]);
        for (int j = 0; j < s.K; j++) want(s.mode[j] >= 0 && s.mode[j] < s.M, "this state is damaged");
        s.fresh = 1;
    }

  private:
    Memory own;
    std::vector<double> A, Q, b, C, d, R, logPi, y;
    std::vector<unsigned char> seen;
};

}  // namespace

void bind_loss(nb::module_& m) {
    m.def("loss_filter", &filter, "A"_a, "b"_a.none(), "Q"_a, "C"_a, "d"_a.none(), "R"_a, "Pi"_a, "y"_a, "seen"_a, "x0"_a, "P0"_a,
          "pi0"_a, "count"_a.none(), nb::kw_only(), "groups"_a, "rule"_a, "components"_a, "depth"_a, "spread"_a, "learn"_a,
          "threshold"_a, "seed"_a, "prior_predicted"_a, "smooth"_a, "lag"_a,
          "Filter or smooth a record under a switching-measurement model.");
    nb::class_<LossStream>(m, "LossStream")
        .def(nb::init<int, int, int, int, int, int, int, bool, int, double, std::uint64_t, In, In, In, std::optional<In>>(),
             nb::kw_only(), "n"_a, "m"_a, "modes"_a, "groups"_a, "rule"_a, "components"_a, "depth"_a, "spread"_a, "learn"_a,
             "threshold"_a, "seed"_a, "x0"_a, "P0"_a, "pi0"_a, "count"_a.none())
        .def("motion", &LossStream::motion, "A"_a, "Q"_a)
        .def("output", &LossStream::output, "C"_a, "R"_a)
        .def("chain", &LossStream::chain, "Pi"_a)
        .def("push", &LossStream::push, "y"_a, "b"_a.none(), "d"_a.none(), "predict"_a = true)
        .def("state", &LossStream::state)
        .def("restore", &LossStream::restore, "state"_a);
}
