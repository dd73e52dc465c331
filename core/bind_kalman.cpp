// Binding of the Kalman family: arrays in, a dict of arrays out; and the online object `KalmanStream`.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <atomic>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "bind_array.hpp"
#include "kalman.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Array = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Index = nb::ndarray<const std::int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Mask = nb::ndarray<const bool, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Offsets = nb::ndarray<const std::int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

void need(bool ok, const char* what) {
    if (!ok) throw nb::value_error(what);
}

// (m,n), (K,m,n) with K = 1, K = T (one per row), or any K with an index
hw::Stack stack(const Array& a, const std::optional<Index>& index, std::int64_t T, std::int64_t m, std::int64_t n) {
    hw::Stack s;
    s.a = a.data();
    need(a.ndim() == 2 || a.ndim() == 3, "a matrix has 2 axes, a stack of matrices 3");
    const std::size_t d = a.ndim() - 2;
    need(static_cast<std::int64_t>(a.shape(d)) == m && static_cast<std::int64_t>(a.shape(d + 1)) == n,
         "a matrix does not have the size the others imply");
    const std::int64_t K = d ? static_cast<std::int64_t>(a.shape(0)) : 1;
    if (index) {
        need(static_cast<std::int64_t>(index->shape(0)) == T, "an index has one entry per row");
        for (std::int64_t t = 0; t < T; t++) {
            const std::int32_t i = index->data()[t];
            need(i >= 0 && i < K, "an index points outside its stack");
        }
        s.index = index->data();
        s.step = m * n;
    } else if (K != 1 || d) {
        need(K == T || K == 1, "a stack without index has one matrix, or one per row");
        s.step = K == 1 ? 0 : m * n;
    }
    return s;
}

std::int64_t entries(const Array& a) { return a.ndim() == 3 ? static_cast<std::int64_t>(a.shape(0)) : 1; }

hw::Stack shifted(hw::Stack s, std::int64_t t) {
    if (s.index) s.index += t;
    else s.a += s.step * t;
    return s;
}

using Kernel = void (*)(hw::Kalman&, hw::Kalman*);

nb::dict run(const std::string& mode, const Array& A, const std::optional<Array>& B, const Array& C, const Array& Q,
             const Array& R, const Array& y, const Mask& seen, const Array& x0, const Array& P0,
             const std::optional<Array>& u, const std::optional<Array>& b, const std::optional<Array>& d,
             const std::optional<Index>& iA, const std::optional<Index>& iB, const std::optional<Index>& iC,
             const std::optional<Index>& iQ, const std::optional<Index>& iR, const std::optional<Offsets>& offsets,
             std::int64_t lag, bool predicted, bool outputs, bool rows, bool initial, bool lag_one, bool sums,
             int threads) {
    need(y.ndim() == 2, "y has 2 axes");
    const std::int64_t T = static_cast<std::int64_t>(y.shape(0)), ny = static_cast<std::int64_t>(y.shape(1));
    need(x0.ndim() == 1 || x0.ndim() == 2, "x0 has 1 axis, or 2 with one row per series");
    const std::int64_t nx = static_cast<std::int64_t>(x0.shape(x0.ndim() - 1));
    need(nx >= 1 && nx <= 4096 && ny <= 4096, "sizes must be between 1 and 4096");
    need(static_cast<std::int64_t>(seen.shape(0)) == T && static_cast<std::int64_t>(seen.shape(1)) == ny,
         "seen has the shape of y");
    const std::int64_t N = offsets ? static_cast<std::int64_t>(offsets->shape(0)) - 1 : 1;
    need(N >= 0, "offsets has at least one entry");
    std::vector<std::int64_t> at(N + 1);
    for (std::int64_t i = 0; i <= N; i++) at[i] = offsets ? offsets->data()[i] : (i ? T : 0);
    need(at[0] == 0 && at[N] == T, "offsets begin with 0 and end with the number of rows");
    for (std::int64_t i = 0; i < N; i++) need(at[i + 1] >= at[i], "offsets must not decrease");
    const bool x0_each = x0.ndim() == 2, P0_each = P0.ndim() == 3;
    need(!x0_each || static_cast<std::int64_t>(x0.shape(0)) == N, "x0 has one row per series");
    need((P0.ndim() == 2 || P0.ndim() == 3) && static_cast<std::int64_t>(P0.shape(P0.ndim() - 1)) == nx &&
             static_cast<std::int64_t>(P0.shape(P0.ndim() - 2)) == nx &&
             (!P0_each || static_cast<std::int64_t>(P0.shape(0)) == N),
         "P0 is (nx, nx), or one such matrix per series");

    hw::Kalman k;
    k.T = T;
    k.nx = static_cast<int>(nx);
    k.ny = static_cast<int>(ny);
    k.A = stack(A, iA, T, nx, nx);
    k.C = stack(C, iC, T, ny, nx);
    k.Q = stack(Q, iQ, T, nx, nx);
    k.R = stack(R, iR, T, ny, ny);
    if (u) {
        need(B.has_value(), "u needs B");
        need(u->ndim() == 2 && static_cast<std::int64_t>(u->shape(0)) == T, "u has one row per row of y");
        k.nu = static_cast<int>(u->shape(1));
        k.u = u->data();
        k.B = stack(*B, iB, T, nx, k.nu);
    }
    auto rows_of = [&](const std::optional<Array>& a, std::int64_t n, const char* what) -> const double* {
        if (!a) return nullptr;
        need(a->ndim() == 2 && static_cast<std::int64_t>(a->shape(0)) == T && static_cast<std::int64_t>(a->shape(1)) == n,
             what);
        return a->data();
    };
    k.b = rows_of(b, nx, "b is (T, nx)");
    k.d = rows_of(d, ny, "d is (T, ny)");
    k.y = y.data();
    k.seen = reinterpret_cast<const std::uint8_t*>(seen.data());

    Kernel kernel;
    if (mode == "filter") kernel = HW_PICK(kalman_filter);
    else if (mode == "smooth") kernel = HW_PICK(kalman_smooth);
    else if (mode == "lag") kernel = HW_PICK(kalman_lag);
    else throw nb::value_error("mode is one of filter, smooth, lag");
    if (mode == "lag") {
        need(lag >= 0, "lag is 0 or more");
        k.lag = lag < T ? lag : T;
    }
    need(mode == "smooth" || !(initial || lag_one || sums), "these outputs need mode smooth");
    need(!sums || !k.Q.step || k.Q.index || entries(Q) == T, "sums need one entry of Q for each row");

    nb::dict out;
    Fresh x({T, nx}), P({T, nx, nx}), loglik({N});
    out["x"] = x.array;
    out["P"] = P.array;
    out["loglik"] = loglik.array;
    k.x = x.a;
    k.P = P.a;
    auto want = [&](bool wanted, const char* name, std::initializer_list<std::int64_t> shape) -> double* {
        if (!wanted) return nullptr;
        Fresh f(shape);
        out[name] = f.array;
        return f.a;
    };
    k.xp = want(predicted, "xp", {T, nx});
    k.Pp = want(predicted, "Pp", {T, nx, nx});
    k.yp = want(outputs, "yp", {T, ny});
    k.S = want(outputs, "S", {T, ny, ny});
    k.ll = want(rows, "ll", {T});
    k.nis = want(rows, "nis", {T});
    k.x0s = want(initial, "x0", {N, nx});
    k.P0s = want(initial, "P0", {N, nx, nx});
    k.Pl = want(lag_one, "Pl", {T, nx, nx});

    // Sums of each series apart, added in order at the end: the result does not depend on the threads.
    const std::int64_t KQ = entries(Q), KR = entries(R), nu = k.nu;
    const std::int64_t size[11] = {KQ * nx * nx, KQ, nx * nx, nx * nu, nx * nx, nx * nu, nu * nu, KR * ny * ny, KR,
                                   ny * nx, nx * nx};
    std::int64_t each = 0;
    for (auto s : size) each += s;
    std::vector<double> parts(sums ? static_cast<std::size_t>(each * N) : 0, 0.0);

    std::vector<int> code(N, 0);
    std::vector<std::int64_t> row(N, -1), n_seen(N, 0), n_reduced(N, 0);
    {
        nb::gil_scoped_release release;
        std::atomic<std::int64_t> next{0};
        auto one = [&](std::int64_t i, hw::Kalman& s, hw::KalmanSums& sum, double* room) {
            s = k;
            const std::int64_t t = at[i];
            s.T = at[i + 1] - t;
            s.A = shifted(k.A, t); s.B = shifted(k.B, t); s.C = shifted(k.C, t);
            s.Q = shifted(k.Q, t); s.R = shifted(k.R, t);
            s.x0 = x0.data() + (x0_each ? i * nx : 0);
            s.P0 = P0.data() + (P0_each ? i * nx * nx : 0);
            auto move = [&](auto*& p, std::int64_t n) { if (p) p += t * n; };
            move(s.u, nu); move(s.b, nx); move(s.d, ny); move(s.y, ny); move(s.seen, ny);
            move(s.x, nx); move(s.P, nx * nx); move(s.xp, nx); move(s.Pp, nx * nx); move(s.yp, ny);
            move(s.S, ny * ny); move(s.ll, 1); move(s.nis, 1); move(s.Pl, nx * nx);
            if (s.x0s) { s.x0s += i * nx; s.P0s += i * nx * nx; }
            if (sums) {
                double* p = parts.data() + i * each;
                double** to[11] = {&sum.W, &sum.nW, &sum.Wx, &sum.Wu, &sum.Xx, &sum.Xu, &sum.Uu, &sum.V, &sum.nV,
                                   &sum.Vx, &sum.Xy};
                for (int j = 0; j < 11; j++) {
                    *to[j] = p;
                    p += size[j];
                }
                s.sums = &sum;
            }
            s.work = room;
        };
        auto work = [&] {
            const std::size_t each_room = static_cast<std::size_t>(hw::kalman_work(nx, ny, k.lag));
            std::vector<double> room(2 * each_room);
            hw::Kalman s[2];
            hw::KalmanSums sum[2];
            // two series in turns fill the machine better than one; a pair at a time is handed out
            for (std::int64_t i; (i = 2 * next.fetch_add(1)) < N;) {
                const int both = i + 1 < N ? 2 : 1;
                for (int j = 0; j < both; j++) one(i + j, s[j], sum[j], room.data() + j * each_room);
                kernel(s[0], both == 2 ? &s[1] : nullptr);
                for (int j = 0; j < both; j++) {
                    loglik.a[i + j] = s[j].loglik;
                    code[i + j] = s[j].code;
                    row[i + j] = s[j].row;
                    n_seen[i + j] = s[j].n_seen;
                    n_reduced[i + j] = s[j].n_reduced;
                }
            }
        };
        const std::int64_t wanted = threads > 0 ? threads : static_cast<std::int64_t>(std::thread::hardware_concurrency());
        const std::int64_t pairs = (N + 1) / 2, n_threads = wanted < pairs ? wanted : pairs;
        std::vector<std::thread> others;
        for (std::int64_t i = 1; i < n_threads; i++) others.emplace_back(work);
        work();
        for (auto& o : others) o.join();
    }
    auto ints = [&](const auto& v) {
        nb::list l;
        for (auto e : v) l.append(static_cast<std::int64_t>(e));
        return l;
    };
    out["code"] = ints(code);
    out["row"] = ints(row);
    out["n_seen"] = ints(n_seen);
    out["n_reduced"] = ints(n_reduced);
    if (sums) {
        const char* name[11] = {"W", "nW", "Wx", "Wu", "Xx", "Xu", "Uu", "V", "nV", "Vx", "Xy"};
        Fresh f[11] = {Fresh({KQ, nx, nx}, true), Fresh({KQ}, true), Fresh({nx, nx}, true), Fresh({nx, nu}, true),
                       Fresh({nx, nx}, true), Fresh({nx, nu}, true), Fresh({nu, nu}, true), Fresh({KR, ny, ny}, true),
                       Fresh({KR}, true), Fresh({ny, nx}, true), Fresh({nx, nx}, true)};
        for (std::int64_t i = 0; i < N; i++) {
            const double* p = parts.data() + i * each;
            for (int j = 0; j < 11; j++)
                for (std::int64_t e = 0; e < size[j]; e++) f[j].a[e] += *p++;
        }
        for (int j = 0; j < 11; j++) out[name[j]] = f[j].array;
    }
    return out;
}

// ---- the online object ---------------------------------------------------------------------------------------------

struct Matrices {
    std::vector<double> A, B, C, Q, R;
};

// What a push hands over: one object of variable size, its arrays made only when asked for.
struct Belief {
    PyObject_VAR_HEAD
    std::int64_t rows, row, code, n_seen, nx;
    double t, ll, nis, loglik;
    double data[1];  // x (nx), P (nx, nx)
};

PyObject* array_of(const double* a, std::initializer_list<std::size_t> shape) {
    std::int64_t s[2] = {1, 1};
    int d = 0;
    for (auto v : shape) s[d++] = static_cast<std::int64_t>(v);
    Fresh f = d == 1 ? Fresh({s[0]}) : Fresh({s[0], s[1]});
    std::memcpy(f.a, a, static_cast<std::size_t>(s[0] * s[1]) * 8);
    return f.array.release().ptr();
}

inline Belief& of(PyObject* o) { return *reinterpret_cast<Belief*>(o); }

PyGetSetDef belief_fields[] = {
    {"rows", [](PyObject* o, void*) { return PyLong_FromLongLong(of(o).rows); }, nullptr, "rows pushed so far", nullptr},
    {"row", [](PyObject* o, void*) { return PyLong_FromLongLong(of(o).row); }, nullptr, "row of this belief", nullptr},
    {"code", [](PyObject* o, void*) { return PyLong_FromLongLong(of(o).code); }, nullptr, "KalmanCode", nullptr},
    {"n_seen", [](PyObject* o, void*) { return PyLong_FromLongLong(of(o).n_seen); }, nullptr,
     "seen entries of the row pushed", nullptr},
    {"t", [](PyObject* o, void*) { return PyFloat_FromDouble(of(o).t); }, nullptr, "time of this belief, s", nullptr},
    {"nis", [](PyObject* o, void*) { return PyFloat_FromDouble(of(o).nis); }, nullptr,
     "normalised innovation squared of the row pushed", nullptr},
    {"loglik", [](PyObject* o, void*) { return PyFloat_FromDouble(of(o).loglik); }, nullptr,
     "log-likelihood of all rows", nullptr},
    {"x", [](PyObject* o, void*) { return array_of(of(o).data, {static_cast<std::size_t>(of(o).nx)}); }, nullptr,
     "mean (nx,)", nullptr},
    {"P", [](PyObject* o, void*) {
         const auto n = static_cast<std::size_t>(of(o).nx);
         return array_of(of(o).data + n, {n, n});
     }, nullptr, "covariance (nx, nx)", nullptr},
    {nullptr, nullptr, nullptr, nullptr, nullptr}};

PyType_Slot belief_slots[] = {{Py_tp_getset, belief_fields}, {0, nullptr}};
PyType_Spec belief_spec = {"halfwidth._core.KalmanBelief", static_cast<int>(offsetof(Belief, data)), sizeof(double),
                           Py_TPFLAGS_DEFAULT | Py_TPFLAGS_DISALLOW_INSTANTIATION, belief_slots};
PyTypeObject* belief_type = nullptr;

constexpr char magic[8] = {'H', 'W', 'K', 'S', 't', 'r', 'm', '1'};

struct SnapshotHead {
    char magic[8];
    std::int64_t nx, ny, nu, lag, pushed, n_seen, n_reduced, code, code_row;
    double t, loglik;
};

std::uint64_t fnv1a(const char* p, std::size_t n) {
    std::uint64_t h = 1469598103934665603ULL;
    for (std::size_t i = 0; i < n; i++) h = (h ^ static_cast<unsigned char>(p[i])) * 1099511628211ULL;
    return h;
}

struct Stream {
    int nx, ny, nu;
    std::int64_t lag;
    double dt, t;
    std::int64_t pushed = 0, n_seen = 0, n_reduced = 0, code = 0, code_row = -1;
    double loglik = 0.0;
    Matrices constant;
    const Matrices* now;
    std::map<double, Matrices> of_dt;
    double last_dt;
    Matrices of_row;
    nb::object error;  // the exception of a push that cannot be used
    nb::object given, type;  // callable (row, t, dt) -> matrices, or None; the type of what push returns
    bool every_row;
    std::vector<double> x, P, xl, Pl, y, u, ring, times, work;
    std::vector<std::uint8_t> seen;
    hw::KalmanPush push;
    PyTypeObject* returned = nullptr;

    void point() {
        push.nx = nx; push.ny = ny; push.nu = nu;
        push.lag = lag;
        push.x = x.data(); push.P = P.data(); push.xl = xl.data(); push.Pl = Pl.data();
        push.ring = ring.data(); push.work = work.data();
        push.y = y.data(); push.seen = seen.data();
    }
};

PyObject* belief_name = nullptr;

void fill(std::vector<double>& to, const Array& a, std::size_t m, std::size_t n, const char* what) {
    need(a.ndim() == 2 && a.shape(0) == m && a.shape(1) == n, what);
    to.assign(a.data(), a.data() + m * n);
}

void fill(Matrices& M, const Array& A, const Array& B, const Array& C, const Array& Q, const Array& R, std::size_t nx,
          std::size_t ny, std::size_t nu) {
    fill(M.A, A, nx, nx, "A is (nx, nx)");
    fill(M.B, B, nx, nu, "B is (nx, nu)");
    fill(M.C, C, ny, nx, "C is (ny, nx)");
    fill(M.Q, Q, nx, nx, "Q is (nx, nx)");
    fill(M.R, R, ny, ny, "R is (ny, ny)");
}

void ask(Stream& s, double t, double dt, Matrices& M) {
    nb::object got = s.given(s.pushed, t, dt);
    auto five = nb::cast<nb::tuple>(got);
    need(five.size() == 5, "the callback returns (A, B, C, Q, R)");
    fill(M, nb::cast<Array>(five[0]), nb::cast<Array>(five[1]), nb::cast<Array>(five[2]), nb::cast<Array>(five[3]),
         nb::cast<Array>(five[4]), s.nx, s.ny, s.nu);
}

// One number; None and NaN are missing. Returns false with a Python error set.
inline bool number(PyObject* o, double& v) {
    if (PyFloat_CheckExact(o)) {
        v = PyFloat_AS_DOUBLE(o);
        return true;
    }
    if (o == Py_None) {
        v = NAN;
        return true;
    }
    v = PyFloat_AsDouble(o);
    return !(v == -1.0 && PyErr_Occurred());  // a TypeError that names the type
}

bool wrong_count(PyObject* error, const char* name, Py_ssize_t got, int n) {
    PyErr_Format(error, "`%s` has %zd entries but the model has %d", name, got, n);
    return false;
}

// n numbers from a list, tuple, float, buffer of float64 or anything with the sequence protocol.
bool numbers(PyObject* error, PyObject* o, double* to, int n, const char* name) {
    if (PyList_CheckExact(o) || PyTuple_CheckExact(o)) {
        const Py_ssize_t got = PySequence_Fast_GET_SIZE(o);
        if (got != n) return wrong_count(error, name, got, n);
        PyObject** items = PySequence_Fast_ITEMS(o);
        for (int i = 0; i < n; i++)
            if (!number(items[i], to[i])) return false;
        return true;
    }
    if (PyFloat_CheckExact(o) || PyLong_CheckExact(o)) {
        if (n != 1) return wrong_count(error, name, 1, n);
        return number(o, to[0]);
    }
    if (PyObject_CheckBuffer(o)) {
        Py_buffer v;
        if (PyObject_GetBuffer(o, &v, PyBUF_FORMAT | PyBUF_STRIDES) == 0) {
            if (v.itemsize == 8 && v.format && v.format[0] == 'd' && v.format[1] == 0 && v.ndim <= 2 &&
                (v.ndim < 2 || v.shape[0] == 1)) {
                const Py_ssize_t got = v.ndim == 0 ? 1 : v.shape[v.ndim - 1];
                const Py_ssize_t step = v.ndim == 0 ? 0 : v.strides[v.ndim - 1];
                if (got == n)
                    for (int i = 0; i < n; i++) to[i] = *reinterpret_cast<double*>(static_cast<char*>(v.buf) + i * step);
                PyBuffer_Release(&v);
                return got == n || wrong_count(error, name, got, n);
            }
            PyBuffer_Release(&v);
        } else {
            PyErr_Clear();
        }
    }
    PyObject* f = PySequence_Fast(o, "expected a number or a sequence of numbers");
    if (!f) {
        if (n == 1) {
            PyErr_Clear();
            return number(o, to[0]);
        }
        return false;
    }
    const Py_ssize_t got = PySequence_Fast_GET_SIZE(f);
    bool ok = got == n || wrong_count(error, name, got, n);
    for (int i = 0; ok && i < n; i++) ok = number(PySequence_Fast_GET_ITEM(f, i), to[i]);
    Py_DECREF(f);
    return ok;
}

PyObject* answer(Stream& s, int code, int n_seen, double ll, double nis) {
    const std::size_t nx = s.nx;
    PyObject* belief = belief_type->tp_alloc(belief_type, static_cast<Py_ssize_t>(nx + nx * nx));
    if (!belief) return nullptr;
    Belief& b = of(belief);
    const std::int64_t newest = s.pushed - 1, late = s.lag < newest ? s.lag : newest;
    b.rows = s.pushed;
    b.row = newest - late;
    b.code = code;
    b.n_seen = n_seen;
    b.nx = s.nx;
    b.t = s.times[static_cast<std::size_t>(b.row % (s.lag + 1))];
    b.ll = ll;
    b.nis = nis;
    b.loglik = s.loglik;
    std::memcpy(b.data, late ? s.xl.data() : s.x.data(), nx * 8);
    std::memcpy(b.data + nx, late ? s.Pl.data() : s.P.data(), nx * nx * 8);
    if (!s.returned) return belief;
    PyObject* o = s.returned->tp_alloc(s.returned, 0);
    if (!o || PyObject_GenericSetAttr(o, belief_name, belief) != 0) {
        Py_XDECREF(o);
        o = nullptr;
    }
    Py_DECREF(belief);
    return o;
}

PyObject* push_impl(Stream& s, PyObject* y, PyObject* u, PyObject* dt_) {
    if (y == nullptr || y == Py_None) {
        for (int i = 0; i < s.ny; i++) s.y[i] = NAN;
    } else if (!numbers(s.error.ptr(), y, s.y.data(), s.ny, "y")) {
        return nullptr;
    }
    int n_seen = 0;
    for (int i = 0; i < s.ny; i++) {
        const double v = s.y[i];
        if (v - v == 0.0) {
            s.seen[i] = 1;
            n_seen++;
        } else if (v != v) {
            s.seen[i] = 0;
            s.y[i] = 0.0;
        } else {
            return PyErr_Format(s.error.ptr(), "`y` is infinite in entry %d; a missing entry is None or NaN", i);
        }
    }
    if (s.nu > 0) {
        if (u == nullptr || u == Py_None)
            return PyErr_Format(s.error.ptr(), "`u` is missing; the model has %d inputs", s.nu);
        if (!numbers(s.error.ptr(), u, s.u.data(), s.nu, "u")) return nullptr;
        for (int i = 0; i < s.nu; i++)
            if (!(s.u[i] - s.u[i] == 0.0))
                return PyErr_Format(s.error.ptr(), "`u` is not finite in entry %d; only `y` may be missing", i);
    } else if (u != nullptr && u != Py_None) {
        return PyErr_Format(s.error.ptr(), "`u` was given but the model has no inputs");
    }
    double dt = s.dt;
    if (dt_ != nullptr && dt_ != Py_None) {
        if (!number(dt_, dt)) return nullptr;
        if (!(dt > 0.0) || !(dt - dt == 0.0))
            return PyErr_Format(s.error.ptr(), "`dt` must be a positive time in seconds");
    }
    if (!s.given.is_none()) {
        try {
            if (s.every_row) {
                ask(s, s.t + dt, dt, s.of_row);
                s.now = &s.of_row;
            } else if (dt != s.last_dt) {
                auto it = s.of_dt.find(dt);
                if (it == s.of_dt.end()) {
                    Matrices M;
                    ask(s, s.t + dt, dt, M);
                    if (s.of_dt.size() >= 256) s.of_dt.clear();
                    it = s.of_dt.emplace(dt, std::move(M)).first;
                }
                s.now = &it->second;
                s.last_dt = dt;
            }
        } catch (nb::python_error& e) {
            e.restore();
            return nullptr;
        } catch (const nb::cast_error&) {
            PyErr_SetString(PyExc_TypeError, "the callback returns (A, B, C, Q, R), float64 arrays in C order");
            return nullptr;
        } catch (const std::exception& e) {
            PyErr_SetString(s.error.ptr(), e.what());
            return nullptr;
        }
    }
    hw::KalmanPush& k = s.push;
    const Matrices& M = *s.now;
    k.A = M.A.data(); k.B = M.B.data(); k.C = M.C.data(); k.Q = M.Q.data(); k.R = M.R.data();
    k.u = s.nu > 0 ? s.u.data() : nullptr;
    k.t = s.pushed;
    k.ll = k.nis = 0.0;
    k.code = hw::kalman_ok;
    HW_PICK(kalman_push)(k);
    s.pushed++;
    s.t += dt;
    s.times[static_cast<std::size_t>((s.pushed - 1) % (s.lag + 1))] = s.t;
    s.n_seen += n_seen;
    s.n_reduced += k.code == hw::kalman_reduced || k.code == hw::kalman_contradicted;
    if (k.code != hw::kalman_broken) s.loglik += k.ll;
    if (k.code > s.code) {
        s.code = k.code;
        s.code_row = s.pushed - 1;
    }
    return answer(s, k.code, n_seen, k.ll, k.nis);
}

// push(y, u=None, dt=None), straight on the C API: argument parsing is most of what a push costs.
PyObject* push_call(PyObject* self, PyObject* const* args, Py_ssize_t n, PyObject* names) {
    PyObject* a[3] = {nullptr, nullptr, nullptr};
    static const char* const name[3] = {"y", "u", "dt"};
    if (n > 3) return PyErr_Format(PyExc_TypeError, "push() takes y, u, dt but %zd arguments were given", n);
    for (Py_ssize_t i = 0; i < n; i++) a[i] = args[i];
    if (names) {
        const Py_ssize_t m = PyTuple_GET_SIZE(names);
        for (Py_ssize_t j = 0; j < m; j++) {
            PyObject* key = PyTuple_GET_ITEM(names, j);
            int i = 0;
            while (i < 3 && PyUnicode_CompareWithASCIIString(key, name[i]) != 0) i++;
            if (i == 3) return PyErr_Format(PyExc_TypeError, "push() has no argument %R", key);
            if (a[i]) return PyErr_Format(PyExc_TypeError, "push() got two values for %s", name[i]);
            a[i] = args[n + j];
        }
    }
    if (!a[0]) return PyErr_Format(PyExc_TypeError, "push() needs y; a row without output is push(None)");
    Stream& s = *nb::inst_ptr<Stream>(self);
    PyObject* newest = push_impl(s, a[0], a[1], a[2]);
    if (!newest && PyErr_Occurred() == PyExc_TypeError) {  // something in the row is no number
        PyObject *type, *value, *trace;
        PyErr_Fetch(&type, &value, &trace);
        PyErr_Format(s.error.ptr(), "the row holds something that is no number: %S; numbers, None or NaN were expected",
                     value ? value : Py_None);
        Py_XDECREF(type);
        Py_XDECREF(value);
        Py_XDECREF(trace);
    }
    return newest;
}

PyMethodDef stream_methods[] = {
    {"push", reinterpret_cast<PyCFunction>(reinterpret_cast<void (*)()>(push_call)), METH_FASTCALL | METH_KEYWORDS,
     "push(y, u=None, dt=None)\n--\n\nFold one row in; None or NaN is a missing entry."},
    {nullptr, nullptr, 0, nullptr}};

PyType_Slot stream_slots[] = {{Py_tp_methods, stream_methods}, {0, nullptr}};

void stream_init(Stream* s, const Array& A, const Array& B, const Array& C, const Array& Q, const Array& R,
                 const Array& x0, const Array& P0, nb::object returned, std::int64_t lag, double dt, double t,
                 nb::object matrices, bool every_row, nb::object error) {
    need(A.ndim() == 2 && C.ndim() == 2 && B.ndim() == 2 && x0.ndim() == 1, "A, B, C have 2 axes and x0 has 1");
    need(lag >= 0 && lag <= 1000000, "lag is between 0 and 1000000");
    const std::size_t nx = A.shape(0), ny = C.shape(0), nu = B.shape(1);
    need(nx >= 1 && nx <= 4096 && ny <= 4096 && nu <= 4096, "sizes must be between 1 and 4096");
    need(x0.shape(0) == nx, "x0 is (nx,)");
    Matrices M;
    fill(M, A, B, C, Q, R, nx, ny, nu);
    std::vector<double> P;
    fill(P, P0, nx, nx, "P0 is (nx, nx)");
    new (s) Stream();
    s->nx = static_cast<int>(nx);
    s->ny = static_cast<int>(ny);
    s->nu = static_cast<int>(nu);
    s->lag = lag;
    s->dt = s->last_dt = dt;
    s->t = t;
    s->constant = std::move(M);
    s->now = &s->constant;
    s->given = std::move(matrices);
    s->every_row = every_row;
    s->error = error.is_none() ? nb::borrow(PyExc_ValueError) : std::move(error);
    s->type = std::move(returned);
    if (!s->type.is_none()) {
        need(PyType_Check(s->type.ptr()), "the returned type is a class");
        s->returned = reinterpret_cast<PyTypeObject*>(s->type.ptr());
    }
    s->x.assign(x0.data(), x0.data() + nx);
    s->P = std::move(P);
    s->xl = s->x;
    s->Pl = s->P;
    s->y.assign(ny ? ny : 1, 0.0);
    s->u.assign(nu ? nu : 1, 0.0);
    s->seen.assign(ny ? ny : 1, 0);
    s->ring.assign(lag > 0 ? static_cast<std::size_t>(lag) * (2 * nx * nx + 2 * nx) : 1, 0.0);
    s->times.assign(static_cast<std::size_t>(lag) + 1, t);
    s->work.assign(static_cast<std::size_t>(hw::kalman_work(s->nx, s->ny)) * 2, 0.0);
    s->point();
}

nb::bytes stream_snapshot(const Stream& s) {
    SnapshotHead h{};
    std::memcpy(h.magic, magic, 8);
    h.nx = s.nx; h.ny = s.ny; h.nu = s.nu; h.lag = s.lag; h.pushed = s.pushed; h.n_seen = s.n_seen;
    h.n_reduced = s.n_reduced; h.code = s.code; h.code_row = s.code_row; h.t = s.t; h.loglik = s.loglik;
    std::string b(reinterpret_cast<const char*>(&h), sizeof h);
    auto add = [&](const std::vector<double>& v) { b.append(reinterpret_cast<const char*>(v.data()), v.size() * 8); };
    add(s.x); add(s.P); add(s.xl); add(s.Pl); add(s.ring); add(s.times);
    const std::uint64_t sum = fnv1a(b.data(), b.size());
    b.append(reinterpret_cast<const char*>(&sum), 8);
    return nb::bytes(b.data(), b.size());
}

void stream_restore(Stream& s, const nb::bytes& bytes) {
    const char* p = bytes.c_str();
    const std::size_t n = bytes.size();
    SnapshotHead h;
    need(n >= sizeof h + 8, "the snapshot is too short");
    std::memcpy(&h, p, sizeof h);
    need(std::memcmp(h.magic, magic, 8) == 0, "not a snapshot of a Kalman stream of this version");
    std::uint64_t sum;
    std::memcpy(&sum, p + n - 8, 8);
    need(sum == fnv1a(p, n - 8), "the snapshot is damaged: its check sum is wrong");
    need(h.nx == s.nx && h.ny == s.ny && h.nu == s.nu && h.lag == s.lag, "the snapshot is of a model of another size");
    need(n == sizeof h + 8 + 8 * (2 * s.x.size() + 2 * s.P.size() + s.ring.size() + s.times.size()), "the snapshot has the wrong length");
    p += sizeof h;
    auto take = [&](std::vector<double>& v) {
        std::memcpy(v.data(), p, v.size() * 8);
        p += v.size() * 8;
    };
    take(s.x); take(s.P); take(s.xl); take(s.Pl); take(s.ring); take(s.times);
    s.pushed = h.pushed; s.n_seen = h.n_seen; s.n_reduced = h.n_reduced; s.code = h.code; s.code_row = h.code_row;
    s.t = h.t; s.loglik = h.loglik;
}

}  // namespace

void bind_kalman(nb::module_& m) {
    m.def("kalman_run", &run, "mode"_a, "A"_a, "B"_a.none(), "C"_a, "Q"_a, "R"_a, "y"_a, "seen"_a, "x0"_a, "P0"_a,
          nb::kw_only(), "u"_a.none() = nb::none(), "b"_a.none() = nb::none(), "d"_a.none() = nb::none(),
          "iA"_a.none() = nb::none(), "iB"_a.none() = nb::none(), "iC"_a.none() = nb::none(),
          "iQ"_a.none() = nb::none(), "iR"_a.none() = nb::none(), "offsets"_a.none() = nb::none(), "lag"_a = 0,
          "predicted"_a = false, "outputs"_a = false, "rows"_a = false, "initial"_a = false, "lag_one"_a = false,
          "sums"_a = false, "threads"_a = 0,
          "Filter, smooth or fixed-lag smooth one series, or several one after the other in y (offsets).");
    belief_type = reinterpret_cast<PyTypeObject*>(PyType_FromSpec(&belief_spec));
    if (!belief_type) throw nb::python_error();
    m.attr("KalmanBelief") = nb::borrow(reinterpret_cast<PyObject*>(belief_type));
    belief_name = PyUnicode_InternFromString("_belief");
    nb::class_<Stream>(m, "KalmanStream", nb::type_slots(stream_slots),
                       "A Kalman filter that holds its belief: push rows, snapshot, restore.")
        .def("__init__", &stream_init, "A"_a, "B"_a, "C"_a, "Q"_a, "R"_a, "x0"_a, "P0"_a, "returned"_a.none() = nb::none(),
             nb::kw_only(), "lag"_a = 0, "dt"_a = 1.0, "t"_a = 0.0, "matrices"_a.none() = nb::none(), "every_row"_a = false,
             "error"_a.none() = nb::none())
        .def("snapshot", &stream_snapshot)
        .def("restore", &stream_restore, "snapshot"_a)
        .def_prop_ro("pushed", [](const Stream& s) { return s.pushed; })
        .def_prop_ro("t", [](const Stream& s) { return s.t; })
        .def_prop_ro("loglik", [](const Stream& s) { return s.loglik; })
        .def_prop_ro("n_seen", [](const Stream& s) { return s.n_seen; })
        .def_prop_ro("n_reduced", [](const Stream& s) { return s.n_reduced; })
        .def_prop_ro("code", [](const Stream& s) { return s.code; })
        .def_prop_ro("code_row", [](const Stream& s) { return s.code_row; });
}
