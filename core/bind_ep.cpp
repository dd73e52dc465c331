// Python's door to core/ep.cpp: gathers the arrays of a problem, releases the GIL, holds no logic.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cstring>
#include <initializer_list>
#include <iterator>
#include <new>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "ep_entry.hpp"
#include "window.hpp"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using In = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using InInt = nb::ndarray<const std::int32_t, nb::c_contig, nb::device::cpu>;
using InByte = nb::ndarray<const std::int8_t, nb::c_contig, nb::device::cpu>;
using InBool = nb::ndarray<const bool, nb::c_contig, nb::device::cpu>;

void want(bool ok, const char* what) {
    if (!ok) throw std::invalid_argument(what);
}

nb::object fresh(std::vector<std::size_t> shape, double** p, const double* from = nullptr) {
    std::size_t size = 1;
    for (std::size_t s : shape) size *= s;
    *p = new double[size ? size : 1]();
    if (from && size) std::memcpy(*p, from, size * sizeof(double));
    nb::capsule owner(*p, [](void* q) noexcept { delete[] static_cast<double*>(q); });
    return nb::cast(nb::ndarray<nb::numpy, double>(*p, shape.size(), shape.data(), owner));
}

struct Work {
    explicit Work(std::size_t size)
        : p(static_cast<double*>(::operator new((size + hw::ep_abreast) * sizeof(double), std::align_val_t(64)))) {}
    ~Work() { ::operator delete(p, std::align_val_t(64)); }
    Work(const Work&) = delete;
    Work& operator=(const Work&) = delete;
    double* p;
};

// The arrays of a chain, kept alive with it. `of_window` are those that change from window to window.
class Problem {
  public:
    hw::EpArgs a{};

    Problem(const nb::dict& given, std::size_t members) : given_(given) {
        const In R = array("R");
        const InInt group_w = typed<InInt>("group_w"), start = typed<InInt>("start"), group = typed<InInt>("group");
        const InByte kind = typed<InByte>("kind");
        const std::size_t n = group_w.size(), rows = kind.size();
        want(start.size() >= 2 && n >= 1 && n <= std::size_t(hw::ep_states), "start (T+2,), group_w (n,), n <= 16");
        const std::size_t T = start.size() - 2;
        a.T = static_cast<int>(T);
        a.n = static_cast<int>(n);
        a.rows = static_cast<int>(rows);
        a.groups = nb::cast<int>(given["groups"]);
        a.members = static_cast<int>(members);
        if (T) {
            a.A = stack("A", 3, n * n, T);
            want(a.A.data, "A is missing");
            a.G = stack("G", 3, n * n, T);
            a.Q = stack("Q", 3, n * n, T);
        }
        a.group_w = group_w.data();
        for (std::size_t i = 0; i < n; i++) want(a.group_w[i] < a.groups, "group_w out of range");
        if (has("group_Q")) {
            const InInt of = typed<InInt>("group_Q");
            want(of.size() == n, "group_Q (n,)");
            a.group_Q = of.data();
            for (std::size_t i = 0; i < n; i++) want(a.group_Q[i] < a.groups, "group_Q out of range");
        }
        if (has("group_R")) {
            const InInt of = typed<InInt>("group_R");
            want(of.size() == rows, "group_R (rows,)");
            a.group_R = of.data();
            for (std::size_t k = 0; k < rows; k++) want(a.group_R[k] < a.groups, "group_R out of range");
        }
        a.start = start.data();
        want(a.start[0] == 0 && a.start[T + 1] == static_cast<int>(rows), "start runs from 0 to the number of rows");
        for (std::size_t t = 0; t <= T; t++) want(a.start[t] <= a.start[t + 1], "start must not fall");
        const In lo = array("lo"), hi = array("hi");
        want(group.size() == rows && R.size() == rows && lo.size() == rows && hi.size() == rows, "one entry a row");
        if (rows) {
            a.h = stack("h", 2, rows * n, 1);
            want(a.h.data, "h is missing");
        }
        a.kind = kind.data();
        a.group = group.data();
        a.R = R.data();
        a.lo = lo.data();
        a.hi = hi.data();
        if (has("lost")) {
            const In lost = array("lost");
            want(lost.size() == rows, "lost (rows,)");
            a.lost = lost.data();
        }
        if (has("mix")) {
            const In mix = array("mix");
            want(mix.size() == rows * a.groups, "mix (rows,groups)");
            a.mix = mix.data();
        }
        for (std::size_t k = 0; k < rows; k++) {
            const int what = a.kind[k];
            want(what >= 0 && what <= hw::ep_truncation && a.group[k] < a.groups, "row out of range");
            want(what != hw::noise_maybe_lost || a.lost, "lost is missing");
            want(a.group[k] >= 0 || what == hw::noise_gaussian || what == hw::noise_maybe_lost || what == hw::ep_truncation,
                 "a row needs a half-width");
            want(what != hw::noise_gaussian || a.R[k] > 0 || (a.group_R && a.group_R[k] >= 0), "a Gaussian row needs a variance");
        }
        a.wide = nb::cast<double>(given["wide"]);
    }

    // the same with the data of the dictionary
    static Problem whole(const nb::dict& given, std::size_t members) {
        Problem p(given, members);
        const In m0 = p.array("m0"), P0 = p.array("P0"), half0 = p.array("half0");
        p.of_window(p.a, m0, P0, half0);
        if (p.a.T) p.a.b = p.stack("b", 2, std::size_t(p.a.n) * p.a.T, 1);
        if (p.a.rows) p.a.y = p.stack("y", 1, p.a.rows, 1);
        want((p.a.b.data || !p.a.T) && (p.a.y.data || !p.a.rows), "b, y are missing");
        return p;
    }

    static void of_window(hw::EpArgs& a, const In& m0, const In& P0, const In& half0) {
        const std::size_t n = a.n;
        want(m0.size() == n && P0.size() == n * n && half0.size() == n, "m0, half0 (n,), P0 (n,n)");
        a.m0 = m0.data();
        a.P0 = P0.data();
        a.half0 = half0.data();
    }
    static void of_window(hw::EpArgs& a, const In& m0, const In& P0, const In& half0, const In& b, const In& y) {
        of_window(a, m0, P0, half0);
        want(b.size() == std::size_t(a.T) * a.n && y.size() == std::size_t(a.rows), "b (T,n), y (rows,)");
        a.b = {b.data(), nullptr, 1, 0};
        a.y = {y.data(), nullptr, 1, 0};
    }

    // the sites: given ones are copied
    nb::tuple sites(const std::optional<nb::tuple>& from, std::size_t members) {
        const std::size_t stages = a.T + 1, n = a.n, rows = a.rows;
        const std::size_t sizes[4] = {members * stages * n, members * stages * n, members * rows, members * rows};
        const double* p[4] = {};
        a.warm = from.has_value();
        if (from) {
            want(from->size() == 4, "sites: (m, D, tau, nu)");
            for (std::size_t k = 0; k < 4; k++) {
                reals_.push_back(nb::cast<In>((*from)[k]));
                want(reals_.back().size() == sizes[k], "sites: (m, D, tau, nu)");
                p[k] = reals_.back().data();
            }
        }
        return nb::make_tuple(fresh({members, stages, n}, &a.m, p[0]), fresh({members, stages, n}, &a.D, p[1]),
                              fresh({members, rows}, &a.tau, p[2]), fresh({members, rows}, &a.nu, p[3]));
    }

  private:
    bool has(const char* name) const { return given_.contains(name) && !given_[name].is_none(); }
    In array(const char* name) {
        reals_.push_back(nb::cast<In>(given_[name]));
        return reals_.back();
    }
    template <class Kind>
    Kind typed(const char* name) {
        Kind k = nb::cast<Kind>(given_[name]);
        others_.push_back(nb::cast(k));
        return k;
    }
    // (count, ...) shared by all members, or with one dimension more: (members, count, ...)
    hw::EpStack stack(const char* name, std::size_t ndim, std::size_t size, std::size_t rows) {
        hw::EpStack s{};
        if (!has(name)) return s;
        const std::size_t members = a.members;
        const In given = array(name);
        s.data = given.data();
        want(given.ndim() == ndim || (given.ndim() == ndim + 1 && given.shape(0) == members), name);
        std::size_t total = given.size();
        if (given.ndim() == ndim + 1) {
            total /= members;
            s.member = static_cast<std::ptrdiff_t>(total);
        }
        want(size > 0 && total % size == 0, name);
        s.count = static_cast<int>(total / size);
        const std::string index_name = std::string(name) + "_index";
        if (has(index_name.c_str())) {
            const InInt index = typed<InInt>(index_name.c_str());
            want(index.size() == rows, name);
            s.index = index.data();
            for (std::size_t k = 0; k < rows; k++) want(s.index[k] >= 0 && s.index[k] < s.count, name);
        } else {
            want(s.count == 1 || static_cast<std::size_t>(s.count) == rows, name);
        }
        return s;
    }

    nb::dict given_;
    std::vector<In> reals_;
    std::vector<nb::object> others_;
};

// Named arrays in one piece of memory, which Python looks at when it asks for one.
class EpArrays {
  public:
    EpArrays() = default;
    EpArrays(const EpArrays&) = delete;
    EpArrays& operator=(const EpArrays&) = delete;

    void add(const char* name, std::initializer_list<std::size_t> shape, double** into) {
        Part part{name, shape.size(), {}, total_, into};
        std::size_t size = 1, d = 0;
        for (std::size_t s : shape) size *= part.shape[d++] = s;
        total_ += size;
        parts_.push_back(part);
    }
    void make() {
        memory_ = std::vector<double>(total_ + 1);
        for (Part& part : parts_) *part.into = memory_.data() + part.at;
    }
    // the array of this name, kept alive by `self`; none if there is none
    nb::object get(const char* name, nb::handle self) {
        for (const Part& part : parts_)
            if (std::strcmp(part.name, name) == 0)
                return nb::cast(nb::ndarray<nb::numpy, double>(memory_.data() + part.at, part.ndim, part.shape, self));
        return nb::object();
    }

  private:
    struct Part {
        const char* name;
        std::size_t ndim, shape[3], at;
        double** into;
    };
    std::vector<Part> parts_;
    std::vector<double> memory_;
    std::size_t total_ = 0;
};

// What the next window of a stream may take up: sites of the mode and of every lane, and x_t given what lies up to t.
class EpHanded : public EpArrays {
  public:
    EpHanded(const std::int32_t* starts, std::size_t stages, std::size_t n, std::size_t q, std::size_t columns)
        : start(starts, starts + stages + 1), n(n), q(q), columns(columns) {
        const std::size_t rows = start.back();
        add("m", {stages, n}, &m);
        add("D", {stages, n}, &D);
        add("tau", {rows}, &tau);
        add("nu", {rows}, &nu);
        add("lanes", {2 * (stages * n + rows), columns}, &lanes);
        add("lane_phi", {columns, q}, &lane_phi);
        add("mode", {q}, &mode);
        add("H", {q, q}, &H);
        add("edge_x", {stages, n}, &edge_x);
        add("edge_P", {stages, n, n}, &edge_P);
        make();
    }
    std::vector<std::int32_t> start;
    std::size_t n, q, columns;
    double *m = nullptr, *D = nullptr, *tau = nullptr, *nu = nullptr, *lanes = nullptr, *lane_phi = nullptr;
    double *mode = nullptr, *H = nullptr, *edge_x = nullptr, *edge_P = nullptr;
    double log_mode = 0.0, log_prior = 0.0;
    int since = 0;

    std::size_t stages() const { return start.size() - 1; }
};

// mean and covariance of x_a given what lies up to it, if they are those of a proper Gaussian
nb::object state(const EpHanded& h, std::size_t a) {
    if (a >= h.stages()) return nb::none();
    double *x = nullptr, *P = nullptr;
    nb::object found_x = fresh({h.n}, &x, h.edge_x + a * h.n), found_P = fresh({h.n, h.n}, &P, h.edge_P + a * h.n * h.n);
    if (!hw::window_state(h.n, x, P)) return nb::none();
    return nb::make_tuple(found_x, found_P);
}

constexpr const char* handed_names[] = {"m", "D", "tau", "nu", "lanes", "lane_phi", "mode", "H", "edge_x", "edge_P"};

nb::tuple save(nb::handle self) {
    EpHanded& h = *nb::inst_ptr<EpHanded>(self);
    nb::list starts, found;
    for (std::int32_t s : h.start) starts.append(s);
    for (const char* name : handed_names) found.append(h.get(name, self));
    return nb::make_tuple(starts, h.n, h.q, h.columns, h.log_mode, h.log_prior, h.since, found);
}

void load(EpHanded* into, const std::vector<std::int32_t>& start, std::size_t n, std::size_t q, std::size_t columns, double log_mode,
          double log_prior, int since, const std::vector<In>& arrays) {
    want(start.size() >= 2 && start.front() == 0 && n >= 1 && arrays.size() == std::size(handed_names), "what `save` returned");
    for (std::size_t t = 1; t < start.size(); t++) want(start[t - 1] <= start[t], "start must not fall");
    EpHanded* h = new (into) EpHanded(start.data(), start.size() - 1, n, q, columns);
    double* to[] = {h->m, h->D, h->tau, h->nu, h->lanes, h->lane_phi, h->mode, h->H, h->edge_x, h->edge_P};
    const std::size_t stages = h->stages(), rows = start.back();
    const std::size_t noise = stages * n;
    const std::size_t sizes[] = {noise, noise, rows, rows, 2 * (noise + rows) * columns, columns * q, q, q * q, noise, noise * n};
    bool fits = true;
    for (std::size_t k = 0; k < arrays.size(); k++) {
        fits = fits && arrays[k].size() == sizes[k];
        if (fits && sizes[k]) std::memcpy(to[k], arrays[k].data(), sizes[k] * sizeof(double));
    }
    if (!fits) {
        h->~EpHanded();
        throw std::invalid_argument("what `save` returned");
    }
    h->log_mode = log_mode;
    h->log_prior = log_prior;
    h->since = since;
}

// What a window found: x, P, k3, k4 of the states; out (rows,); of half-widths `s`: at the mode, `widths`: mean, sd, lo, hi,
// and `told`: pull, precision and power, one after the other; of nodes phi, log_weight, slope, second; mode and H; numbers.
class EpFound : public EpArrays {
  public:
    int code = 0, nodes = 0, since = 0;
    long sweeps = 0;
    bool finite = false, with_rate = false;
    double rate = 0.0, effective = 0.0, log_evidence = 0.0, log_prior = 0.0, log_mode = 0.0, residual = 0.0;
};

nb::object item(nb::handle self, const char* name) {
    EpFound& f = *nb::inst_ptr<EpFound>(self);
    const auto is = [&](const char* other) { return std::strcmp(name, other) == 0; };
    if (is("code")) return nb::cast(f.code);
    if (is("nodes")) return nb::cast(f.nodes);
    if (is("sweeps")) return nb::cast(f.sweeps);
    if (is("finite")) return nb::cast(f.finite);
    if (is("effective")) return nb::cast(f.effective);
    if (is("log_evidence")) return nb::cast(f.log_evidence);
    if (is("log_prior")) return nb::cast(f.log_prior);
    if (is("log_mode")) return nb::cast(f.log_mode);
    if (is("residual")) return nb::cast(f.residual);
    if (is("rate")) return f.with_rate ? nb::cast(f.rate) : nb::none();
    if (is("since")) return nb::cast(f.since);
    nb::object found = f.get(name, self);
    if (!found.is_valid()) throw nb::key_error(name);
    return found;
}

nb::dict run(const nb::dict& problem, In s, In eps, int sweeps, double tol, double damping,
             std::optional<nb::tuple> sites) {
    want(s.ndim() == 2 && s.shape(0) >= 1 && eps.size() == s.shape(0), "s (members, groups), eps (members,)");
    const std::size_t members = s.shape(0);
    Problem p = Problem::whole(problem, members);
    hw::EpArgs& a = p.a;
    want(s.shape(1) == static_cast<std::size_t>(a.groups), "s (members, groups)");
    const std::size_t stages = a.T + 1, n = a.n, rows = a.rows;
    a.s = s.data();
    a.eps = eps.data();
    a.sweeps = sweeps;
    a.tol = tol;
    a.damping = damping;
    nb::dict found;
    found["sites"] = p.sites(sites, members);
    found["x"] = fresh({members, stages, n}, &a.x);
    found["P"] = fresh({members, stages, n, n}, &a.P);
    found["k3"] = fresh({members, stages, n}, &a.k3);
    found["k4"] = fresh({members, stages, n}, &a.k4);
    found["log_z"] = fresh({members}, &a.log_z);
    found["slope"] = fresh({members, static_cast<std::size_t>(a.groups) + 1}, &a.slope);
    found["second"] = fresh({members}, &a.more);
    found["learned"] = fresh({members, static_cast<std::size_t>(a.groups)}, &a.learned);
    found["residual"] = fresh({members}, &a.residual);
    found["worst"] = fresh({members}, &a.worst);
    found["out"] = fresh({members, rows}, &a.out);
    std::vector<std::int32_t> used(members);
    a.used = used.data();
    {
        nb::gil_scoped_release release;
        const bool few = 2 * members <= hw::ep_abreast;  // narrow registers answer sooner
        Work work((few ? HW_PICK(ep_workspace) : HW_PICK_WIDE(ep_workspace))(a));
        a.work = work.p;
        (few ? HW_PICK(ep_run) : HW_PICK_WIDE(ep_run))(a);
    }
    nb::list count;
    for (std::int32_t u : used) count.append(u);
    found["sweeps"] = count;
    return found;
}

// A chain without its data whose half-widths are to be found, judged once.
class EpFrame {
  public:
    EpFrame(const nb::dict& problem, InBool free, In cap, In count, InBool squared, bool learn_eps, double rate, double start_eps,
            double power, double beta_a, double beta_b, In z, const nb::dict& limits, const std::optional<nb::dict>& outside)
        : p_(problem, whole_registers(z.shape(0))), free_(free), cap_(cap), count_(count), squared_(squared), z_(z) {
        want(z.ndim() == 2 && z.shape(0) >= 1, "z (nodes, q)");
        if (outside) {
            bounds_.emplace(*outside, whole_registers(z.shape(0)));
            want(bounds_->a.T == p_.a.T && bounds_->a.n == p_.a.n && bounds_->a.groups == p_.a.groups, "outside: another chain");
            none_.resize(bounds_->a.rows);
        }
        const std::size_t groups = p_.a.groups;
        want(free.size() == groups && cap.size() == groups && count.size() == groups && squared.size() == groups, "one entry a half-width");
        q_ = learn_eps ? 1 : 0;
        for (std::size_t g = 0; g < groups; g++) q_ += free.data()[g] ? 1 : 0;
        want(q_ <= std::size_t(hw::ep_free), "at most 16 free parameters");
        want(z.shape(1) == q_, "z (nodes, q)");
        l_.free = free_.data();
        l_.squared = squared_.data();
        l_.cap = cap_.data();
        l_.count = count_.data();
        l_.learn_eps = learn_eps;
        l_.rate = rate;
        l_.start_eps = start_eps;
        l_.power = power;
        l_.beta_a = beta_a;
        l_.beta_b = beta_b;
        l_.z = z_.data();
        l_.nodes = static_cast<int>(z.shape(0));
        l_.columns = static_cast<int>(whole_registers(z.shape(0)));
        const auto whole = [&](const char* name) { return nb::cast<int>(limits[name]); };
        const auto real = [&](const char* name) { return nb::cast<double>(limits[name]); };
        l_.steps = whole("steps");
        l_.few = whole("few");
        l_.many = whole("many");
        l_.most = whole("most");
        l_.tol = real("tol");
        l_.tol_nodes = real("tol_nodes");
        l_.close = real("close");
        l_.near = real("near");
        l_.least = real("least");
        l_.stage = whole("stage");
        l_.enough = real("enough");
        l_.usable = real("usable");
        l_.narrow = real("narrow");
        l_.warp = real("warp");
        l_.reference = real("reference");
        l_.condition = real("condition");
        l_.again = whole("again");
        p_.a.damping = real("damping");
    }

    // one window: `before` as an earlier one handed it on, `drop` rows before this one; `known` in the order of `told`.
    // Returns what was found, and what it hands on.
    nb::tuple learn(In floor, In scale, In start, In m0, In P0, In half0, In b, In y, nb::handle before, int drop, int shaped,
                     std::optional<In> known) const {
        hw::EpLearnArgs l = l_;
        hw::EpArgs a = p_.a, bounds{};
        Problem::of_window(a, m0, P0, half0, b, y);
        const std::size_t stages = a.T + 1, n = a.n, rows = a.rows, groups = a.groups, nodes = l.nodes, abreast = a.members;
        want(floor.size() == groups && scale.size() == groups && start.size() == groups, "floor, scale, start (groups,)");
        want(shaped >= 0, "shaped: a stage");
        l.floor = floor.data();
        std::vector<double> own(2 * groups);
        for (std::size_t g = 0; g < groups; g++) own[g] = std::max(scale.data()[g], 1e-300);
        hw::window_first(groups, l.free, l.floor, l.cap, start.data(), own.data() + groups);
        l.scale = own.data();
        l.start = l.scale + groups;
        l.shaped = shaped;
        if (known) {
            want(known->size() == groups * (groups + 2), "known: pull (groups,), precision (groups,groups), power (groups,)");
            l.pull = known->data();
            l.precision = l.pull + groups;
            l.known_power = l.precision + groups * groups;
        }
        nb::object made = nb::cast(new EpFound, nb::rv_policy::take_ownership);
        EpFound& found = *nb::inst_ptr<EpFound>(made);
        nb::object on = nb::cast(new EpHanded(a.start, stages, n, q_, l.columns), nb::rv_policy::take_ownership);
        EpHanded& handed = *nb::inst_ptr<EpHanded>(on);
        a.m = handed.m;
        a.D = handed.D;
        a.tau = handed.tau;
        a.nu = handed.nu;
        l.lanes = handed.lanes;
        l.lane_phi = handed.lane_phi;
        l.edge_x = handed.edge_x;
        l.edge_P = handed.edge_P;
        l.since = &found.since;
        l.log_mode = &found.log_mode;
        hw::EpBefore old{};
        if (!before.is_none()) {
            const EpHanded& h = *nb::cast<const EpHanded*>(before);
            want(h.n == n && drop >= 0, "before: another chain");
            old.stages = static_cast<int>(h.stages());
            old.drop = drop;
            old.start = h.start.data();
            old.m = h.m;
            old.D = h.D;
            old.tau = h.tau;
            old.nu = h.nu;
            if (h.columns == handed.columns && h.q == q_) {
                old.lanes = h.lanes;
                old.lane_phi = h.lane_phi;
                old.mode = h.mode;
                old.H = h.H;
                old.log_mode = h.log_mode;
                old.log_prior = h.log_prior;
                old.since = h.since;
            }
            l.before = &old;
        }
        const bool outliers = l.learn_eps || l.rate > 0.0;
        double *told = nullptr, *mode = nullptr;
        found.add("x", {stages, n}, &l.x);
        found.add("P", {stages, n, n}, &l.P);
        found.add("k3", {stages, n}, &l.k3);
        found.add("k4", {stages, n}, &l.k4);
        found.add("widths", {4, groups}, &l.mean);
        found.add("s", {groups}, &mode);
        found.add("told", {groups * (groups + 2)}, &told);
        found.add("mode", {q_}, &l.mode);
        l.next = handed.mode;
        found.add("H", {q_, q_}, &l.H);
        found.add("phi", {nodes, q_}, &l.phi);
        found.add("log_weight", {nodes}, &l.log_weight);
        found.add("slope", {nodes, q_}, &l.node_slope);
        found.add("second", {nodes}, &l.second);
        if (outliers) found.add("out", {rows}, &l.out);
        found.make();
        l.sd = l.mean + groups;
        l.quantile_lo = l.sd + groups;
        l.quantile_hi = l.quantile_lo + groups;
        l.told_pull = told;
        l.told_precision = told + groups;
        l.told_power = l.told_precision + groups * groups;
        for (std::size_t g = 0; g < groups; g++)
            l.mean[g] = l.quantile_lo[g] = l.quantile_hi[g] = l.squared[g] ? floor.data()[g] * floor.data()[g] : floor.data()[g];
        l.found_rate = &found.rate;
        l.effective = &found.effective;
        l.log_evidence = &found.log_evidence;
        l.log_prior = &found.log_prior;
        l.residual = &found.residual;
        l.finite = &found.finite;
        l.used = &found.nodes;
        l.sweeps_used = &found.sweeps;
        if (bounds_) {
            bounds = bounds_->a;
            Problem::of_window(bounds, m0, P0, half0);
            bounds.b = a.b;
            bounds.y = {none_.data(), nullptr, 1, 0};
            l.outside = &bounds;
        }
        {
            nb::gil_scoped_release release;
            const std::size_t size = abreast * (stages * n * (n + 3) + rows) + stages * n + 3 * nodes;
            Work lanes(size);
            double* p = lanes.p;
            const auto take = [&](std::size_t count) {
                double* first = p;
                p += count;
                return first;
            };
            a.x = take(abreast * stages * n);
            a.P = take(abreast * stages * n * n);
            a.k3 = take(abreast * stages * n);
            a.k4 = take(abreast * stages * n);
            a.out = outliers ? take(abreast * rows) : nullptr;
            bounds.x = a.x;
            bounds.P = a.P;
            bounds.k3 = a.k3;
            l.centre = take(stages * n);
            l.value = take(nodes);
            l.share = take(nodes);
            l.residuals = take(nodes);
            l.base = a;
            Work work(HW_PICK_WIDE(ep_learn_workspace)(l));
            l.base.work = work.p;
            found.code = HW_PICK_WIDE(ep_learn)(l);
        }
        hw::window_mode(groups, l.free, l.cap, l.mode, mode);
        found.with_rate = l.learn_eps;
        handed.log_prior = found.log_prior;
        handed.log_mode = found.log_mode;
        handed.since = found.since;
        std::copy(l.H, l.H + q_ * q_, handed.H);
        return nb::make_tuple(made, on);
    }

  private:
    static std::size_t whole_registers(std::size_t nodes) { return (nodes + hw::ep_abreast - 1) / hw::ep_abreast * hw::ep_abreast; }

    Problem p_;
    std::optional<Problem> bounds_;
    std::vector<double> none_;  // outputs of bounds
    InBool free_;
    In cap_, count_;
    InBool squared_;
    In z_;
    hw::EpLearnArgs l_{};
    std::size_t q_ = 0;
};

nb::tuple taken(InBool free, In start, In pull, In precision, In power) {
    const std::size_t p = free.size();
    want(start.size() == p && pull.size() == p && precision.size() == p * p && power.size() == p,
         "start, pull, power (p,), precision (p,p)");
    double *h = nullptr, *H = nullptr, *g = nullptr;
    nb::object found_h = fresh({p}, &h), found_H = fresh({p, p}, &H), found_g = fresh({p}, &g);
    Work work(5 * p * (p + 1));
    HW_PICK_WIDE(ep_taken_part)(static_cast<int>(p), free.data(), start.data(), pull.data(), precision.data(), power.data(), h, H, g,
                                work.p);
    return nb::make_tuple(found_h, found_H, found_g);
}

}  // namespace

void bind_ep(nb::module_& mod) {
    mod.def("ep_run", &run, "problem"_a, "s"_a, "eps"_a, "sweeps"_a, "tol"_a, "damping"_a, "sites"_a.none(),
            "Expectation propagation on a chain for given half-widths, one set a member; see core/ep_entry.hpp.");
    mod.def("ep_taken", &taken, "free"_a, "start"_a, "pull"_a, "precision"_a, "power"_a,
            "What is known of the free half-widths alone, whatever the others are; see core/ep_handover.hpp.");
    nb::class_<EpHanded>(mod, "EpHanded", "What the next window of a stream may take up; see core/ep_handover.hpp.")
        .def("__init__", &load, "start"_a, "n"_a, "q"_a, "columns"_a, "log_mode"_a, "log_prior"_a, "since"_a, "arrays"_a)
        .def("state", &state, "a"_a, "Mean and covariance of x_a given what lies up to it, None where they are no Gaussian's.")
        .def("save", &save, "All of it, as the arguments of another one.")
        .def("__getitem__", [](nb::handle self, const char* name) {
            nb::object found = nb::inst_ptr<EpHanded>(self)->get(name, self);
            if (!found.is_valid()) throw nb::key_error(name);
            return found;
        });
    nb::class_<EpFound>(mod, "EpFound", "What a window found, array by array as it is asked for.").def("__getitem__", &item);
    nb::class_<EpFrame>(mod, "EpFrame", "A chain without its data whose half-widths are to be found by evidence; see core/ep_learn.hpp.")
        .def(nb::init<const nb::dict&, InBool, In, In, InBool, bool, double, double, double, double, double, In, const nb::dict&,
                      const std::optional<nb::dict>&>(),
             "problem"_a, "free"_a, "cap"_a, "count"_a, "squared"_a, "learn_eps"_a, "rate"_a, "start_eps"_a, "power"_a, "beta_a"_a,
             "beta_b"_a, "z"_a, "limits"_a, "outside"_a.none() = nb::none())
        .def("learn", &EpFrame::learn, "floor"_a, "scale"_a, "start"_a, "m0"_a, "P0"_a, "half0"_a, "b"_a, "y"_a,
             "before"_a.none() = nb::none(), "drop"_a = 0, "shaped"_a = 0, "known"_a.none() = nb::none());
}
