// Python's door to what core/ep.cpp learns of a chain, window by window: releases the GIL, holds no logic.
#include <algorithm>
#include <initializer_list>
#include <iterator>

#include "bind_ep_problem.hpp"
#include "window.hpp"

namespace {

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
        add("m", {stages, n}, &held.m);
        add("D", {stages, n}, &held.D);
        add("tau", {rows}, &held.tau);
        add("nu", {rows}, &held.nu);
        add("lanes", {2 * (stages * n + rows), columns}, &held.lanes);
        add("lane_phi", {columns, q}, &held.lane_phi);
        add("centre", {q}, &held.centre);
        add("H", {q, q}, &held.H);
        add("edge_x", {stages, n}, &held.edge_x);
        add("edge_P", {stages, n, n}, &held.edge_P);
        make();
        held.stages = static_cast<int>(stages);
        held.start = start.data();
    }
    std::vector<std::int32_t> start;
    std::size_t n, q, columns;
    hw::EpHeld held{};

    std::size_t stages() const { return start.size() - 1; }
};

// mean and covariance of x_a given what lies up to it, if they are those of a proper Gaussian
nb::object state(const EpHanded& h, std::size_t a) {
    if (a >= h.stages()) return nb::none();
    double *x = nullptr, *P = nullptr;
    nb::object found_x = fresh({h.n}, &x, h.held.edge_x + a * h.n), found_P = fresh({h.n, h.n}, &P, h.held.edge_P + a * h.n * h.n);
    if (!hw::window_state(h.n, x, P)) return nb::none();
    return nb::make_tuple(found_x, found_P);
}

constexpr const char* handed_names[] = {"m", "D", "tau", "nu", "lanes", "lane_phi", "centre", "H", "edge_x", "edge_P"};

nb::tuple save(nb::handle self) {
    EpHanded& h = *nb::inst_ptr<EpHanded>(self);
    nb::list starts, found;
    for (std::int32_t s : h.start) starts.append(s);
    for (const char* name : handed_names) found.append(h.get(name, self));
    return nb::make_tuple(starts, h.n, h.q, h.columns, h.held.log_mode, h.held.log_prior, h.held.doubt, h.held.since, found);
}

void load(EpHanded* into, const std::vector<std::int32_t>& start, std::size_t n, std::size_t q, std::size_t columns, double log_mode,
          double log_prior, double doubt, int since, const std::vector<In>& arrays) {
    want(start.size() >= 2 && start.front() == 0 && n >= 1 && arrays.size() == std::size(handed_names), "what `save` returned");
    for (std::size_t t = 1; t < start.size(); t++) want(start[t - 1] <= start[t], "start must not fall");
    EpHanded* h = new (into) EpHanded(start.data(), start.size() - 1, n, q, columns);
    hw::EpHeld& held = h->held;
    double* to[] = {held.m, held.D, held.tau, held.nu, held.lanes, held.lane_phi, held.centre, held.H, held.edge_x, held.edge_P};
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
    held.log_mode = log_mode;
    held.log_prior = log_prior;
    held.doubt = doubt;
    held.since = since;
}

// What a window found: x, P, k3, k4 of the states; out (rows,); of half-widths `s`: at the mode, `widths`: mean, sd, lo, hi,
// and `told`: pull, precision and power, one after the other; of nodes phi, log_weight, slope, second; mode and H; numbers.
class EpFound : public EpArrays {
  public:
    int code = 0, nodes = 0, since = 0;
    long sweeps = 0;
    bool finite = false, with_rate = false, tells = false;
    double rate = 0.0, effective = 0.0, log_evidence = 0.0, log_prior = 0.0, log_mode = 0.0, residual = 0.0;
};

nb::object item(nb::handle self, const char* name) {
    EpFound& f = *nb::inst_ptr<EpFound>(self);
    const auto is = [&](const char* other) { return std::strcmp(name, other) == 0; };
    if (is("code")) return nb::cast(f.code);
    if (is("nodes")) return nb::cast(f.nodes);
    if (is("sweeps")) return nb::cast(f.sweeps);
    if (is("finite")) return nb::cast(f.finite);
    if (is("tells")) return nb::cast(f.tells);
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
        l_.light = whole("light");
        l_.stage = whole("stage");
        want(l_.light >= 0 && l_.light < l_.nodes && l_.light % hw::ep_abreast == 0, "light: whole registers, and not all nodes");
        l_.enough = real("enough");
        l_.usable = real("usable");
        l_.narrow = real("narrow");
        l_.warp = real("warp");
        l_.reference = real("reference");
        l_.condition = real("condition");
        l_.again = whole("again");
        l_.calm = whole("calm");
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
        a.m = handed.held.m;
        a.D = handed.held.D;
        a.tau = handed.held.tau;
        a.nu = handed.held.nu;
        l.held = &handed.held;
        l.tells = &found.tells;
        hw::EpBefore old{};
        if (!before.is_none()) {
            const EpHanded& h = *nb::cast<const EpHanded*>(before);
            want(h.n == n && drop >= 0, "before: another chain");
            static_cast<hw::EpHeld&>(old) = h.held;
            old.drop = drop;
            if (h.columns != handed.columns || h.q != q_) old.lanes = nullptr;
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
        found.log_prior = handed.held.log_prior;
        found.log_mode = handed.held.log_mode;
        found.since = handed.held.since;
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

}  // namespace

void bind_ep_learn(nb::module_& mod) {
    nb::class_<EpHanded>(mod, "EpHanded", "What the next window of a stream may take up; see core/ep_handover.hpp.")
        .def("__init__", &load, "start"_a, "n"_a, "q"_a, "columns"_a, "log_mode"_a, "log_prior"_a, "doubt"_a, "since"_a, "arrays"_a)
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
