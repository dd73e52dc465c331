// Python's door to core/ep.cpp: gathers the arrays of a problem, releases the GIL, holds no logic.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <cstring>
#include <initializer_list>
#include <new>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "ep_entry.hpp"

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

// The arrays of a problem, kept alive while the kernel runs.
class Problem {
  public:
    hw::EpArgs a{};

    Problem(const nb::dict& given, std::size_t members) : given_(given) {
        const In m0 = array("m0"), P0 = array("P0"), half0 = array("half0"), R = array("R");
        const InInt group_w = typed<InInt>("group_w"), start = typed<InInt>("start"), group = typed<InInt>("group");
        const InByte kind = typed<InByte>("kind");
        const std::size_t n = m0.size(), rows = kind.size();
        want(start.size() >= 2 && n >= 1 && n <= std::size_t(hw::ep_states), "start (T+2,), m0 (n,), n <= 16");
        const std::size_t T = start.size() - 2;
        a.T = static_cast<int>(T);
        a.n = static_cast<int>(n);
        a.rows = static_cast<int>(rows);
        a.groups = nb::cast<int>(given["groups"]);
        a.members = static_cast<int>(members);
        if (T) {
            a.A = stack("A", 3, n * n, T, members);
            want(a.A.data, "A is missing");
            a.G = stack("G", 3, n * n, T, members);
            a.Q = stack("Q", 3, n * n, T, members);
            a.b = stack("b", 2, n * T, 1, members);
            want(a.b.data, "b is missing");
        }
        want(P0.size() == n * n && half0.size() == n && group_w.size() == n, "m0, half0, group_w (n,), P0 (n,n)");
        a.m0 = m0.data();
        a.P0 = P0.data();
        a.half0 = half0.data();
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
            a.h = stack("h", 2, rows * n, 1, members);
            a.y = stack("y", 1, rows, 1, members);
            want(a.h.data && a.y.data, "h, y are missing");
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

    bool has(const char* name) const { return given_.contains(name) && !given_[name].is_none(); }
    In array(const char* name) {
        reals_.push_back(nb::cast<In>(given_[name]));
        return reals_.back();
    }

  private:
    template <class Kind>
    Kind typed(const char* name) {
        Kind k = nb::cast<Kind>(given_[name]);
        others_.push_back(nb::cast(k));
        return k;
    }
    // (count, ...) shared by all members, or with one dimension more: (members, count, ...)
    hw::EpStack stack(const char* name, std::size_t ndim, std::size_t size, std::size_t rows, std::size_t members) {
        hw::EpStack s{};
        if (!has(name)) return s;
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

nb::dict run(const nb::dict& problem, In s, In eps, int sweeps, double tol, double damping,
             std::optional<nb::tuple> sites) {
    want(s.ndim() == 2 && s.shape(0) >= 1 && eps.size() == s.shape(0), "s (members, groups), eps (members,)");
    const std::size_t members = s.shape(0);
    Problem p(problem, members);
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

nb::dict learn(const nb::dict& problem, InBool free, In floor, In cap, In scale, In start, In count,
               InBool squared, bool learn_eps, double rate, double start_eps, double power, double beta_a, double beta_b, In z,
               const nb::dict& limits, std::optional<nb::tuple> before, int drop, int shaped, std::optional<In> pull,
               std::optional<In> precision, std::optional<In> known_power, std::optional<nb::dict> outside) {
    want(z.ndim() == 2 && z.shape(0) >= 1, "z (nodes, q)");
    const std::size_t nodes = z.shape(0), abreast = (nodes + hw::ep_abreast - 1) / hw::ep_abreast * hw::ep_abreast;
    Problem p(problem, abreast);
    std::optional<Problem> bounds;
    if (outside) bounds.emplace(*outside, abreast);
    hw::EpLearnArgs l{};
    hw::EpArgs& a = p.a;
    const std::size_t stages = a.T + 1, n = a.n, rows = a.rows, groups = a.groups;
    want(free.size() == groups && floor.size() == groups && cap.size() == groups && scale.size() == groups &&
             start.size() == groups && count.size() == groups && squared.size() == groups, "one entry a half-width");
    std::size_t q = learn_eps ? 1 : 0;
    for (std::size_t g = 0; g < groups; g++) q += free.data()[g] ? 1 : 0;
    want(q <= std::size_t(hw::ep_free), "at most 16 free parameters");
    want(z.shape(1) == q, "z (nodes, q)");
    l.free = free.data();
    l.squared = squared.data();
    l.floor = floor.data();
    l.cap = cap.data();
    l.scale = scale.data();
    l.start = start.data();
    l.count = count.data();
    want(pull.has_value() == precision.has_value() && pull.has_value() == known_power.has_value(),
         "pull, precision and known_power go together");
    if (pull) {
        want(pull->size() == groups && precision->size() == groups * groups && known_power->size() == groups,
             "pull (groups,), precision (groups,groups), known_power (groups,)");
        l.pull = pull->data();
        l.precision = precision->data();
        l.known_power = known_power->data();
    }
    l.learn_eps = learn_eps;
    l.rate = rate;
    l.start_eps = start_eps;
    l.power = power;
    l.beta_a = beta_a;
    l.beta_b = beta_b;
    l.z = z.data();
    l.nodes = static_cast<int>(nodes);
    const auto whole = [&](const char* name) { return nb::cast<int>(limits[name]); };
    const auto real = [&](const char* name) { return nb::cast<double>(limits[name]); };
    l.steps = whole("steps");
    l.few = whole("few");
    l.many = whole("many");
    l.most = whole("most");
    l.tol = real("tol");
    l.tol_nodes = real("tol_nodes");
    l.close = real("close");
    l.near = real("near");
    l.least = real("least");
    l.stage = whole("stage");
    l.enough = real("enough");
    l.usable = real("usable");
    l.narrow = real("narrow");
    l.warp = real("warp");
    l.reference = real("reference");
    l.condition = real("condition");
    a.damping = real("damping");
    nb::dict found;
    found["sites"] = p.sites(std::nullopt, 1);
    const std::size_t columns = (nodes + abreast - 1) / abreast * abreast;
    int since = 0;
    bool sound = false;
    l.finite = &sound;
    l.since = &since;
    l.again = whole("again");
    l.columns = static_cast<int>(columns);
    found["lanes"] = fresh({2 * (stages * n + rows), columns}, &l.lanes);
    found["lane_phi"] = fresh({columns, q}, &l.lane_phi);
    hw::EpBefore old{};
    InInt old_start;
    In old_sites[8];
    if (before) {
        want(before->size() == 12 && drop >= 0,
             "before: (start, m, D, tau, nu, lanes, lane_phi, mode, H, log_mode, log_prior, since)");
        old_start = nb::cast<InInt>((*before)[0]);
        want(old_start.size() >= 2, "before: start");
        old.stages = static_cast<int>(old_start.size()) - 1;
        old.drop = drop;
        old.start = old_start.data();
        for (int t = 0; t < old.stages; t++) want(old.start[t] >= 0 && old.start[t] <= old.start[t + 1], "before: start");
        const double** into[4] = {&old.m, &old.D, &old.tau, &old.nu};
        for (int k = 0; k < 4; k++) {
            old_sites[k] = nb::cast<In>((*before)[k + 1]);
            want(old_sites[k].size() == (k < 2 ? old.stages * n : std::size_t(old.start[old.stages])), "before: sites");
            *into[k] = old_sites[k].data();
        }
        for (int k = 4; k < 8; k++) old_sites[k] = nb::cast<In>((*before)[k + 1]);
        const std::size_t old_columns = old_sites[4].size() / (2 * (old.stages * n + old.start[old.stages]));
        if (old_columns == columns && old_sites[5].size() == columns * q && old_sites[6].size() == q &&
            old_sites[7].size() == q * q && old_sites[4].size() == 2 * columns * (old.stages * n + old.start[old.stages])) {
            old.lanes = old_sites[4].data();
            old.lane_phi = old_sites[5].data();
            old.mode = old_sites[6].data();
            old.H = old_sites[7].data();
            old.log_mode = nb::cast<double>((*before)[9]);
            old.log_prior = nb::cast<double>((*before)[10]);
            old.since = nb::cast<int>((*before)[11]);
        }
        l.before = &old;
    }
    want(shaped >= 0, "shaped: a stage");
    l.shaped = shaped;
    const bool outliers = learn_eps || rate > 0.0;
    double* of_lanes[5];
    nb::object held[5] = {fresh({abreast, stages, n}, of_lanes), fresh({abreast, stages, n, n}, of_lanes + 1),
                          fresh({abreast, stages, n}, of_lanes + 2), fresh({abreast, stages, n}, of_lanes + 3),
                          fresh({abreast, rows}, of_lanes + 4)};
    a.x = of_lanes[0];
    a.P = of_lanes[1];
    a.k3 = of_lanes[2];
    a.k4 = of_lanes[3];
    a.out = outliers ? of_lanes[4] : nullptr;
    if (bounds) {
        want(bounds->a.T == a.T && bounds->a.n == a.n && bounds->a.groups == a.groups, "outside: another chain");
        bounds->a.x = a.x;
        bounds->a.P = a.P;
        l.outside = &bounds->a;
    }
    found["mode"] = fresh({q}, &l.mode);
    found["H"] = fresh({q, q}, &l.H);
    found["phi"] = fresh({nodes, q}, &l.phi);
    found["log_weight"] = fresh({nodes}, &l.log_weight);
    found["slope"] = fresh({nodes, q}, &l.node_slope);
    found["second"] = fresh({nodes}, &l.second);
    std::vector<double> of_nodes(3 * nodes);
    l.value = of_nodes.data();
    l.share = l.value + nodes;
    l.residuals = l.share + nodes;
    found["x"] = fresh({stages, n}, &l.x);
    found["P"] = fresh({stages, n, n}, &l.P);
    found["k3"] = fresh({stages, n}, &l.k3);
    found["k4"] = fresh({stages, n}, &l.k4);
    nb::object centre = fresh({stages, n}, &l.centre);
    found["out"] = nb::none();
    if (outliers) found["out"] = fresh({rows}, &l.out);
    found["mean"] = fresh({groups}, &l.mean, floor.data());
    found["sd"] = fresh({groups}, &l.sd);
    found["lo"] = fresh({groups}, &l.quantile_lo, floor.data());
    found["hi"] = fresh({groups}, &l.quantile_hi, floor.data());
    for (std::size_t g = 0; g < groups; g++)
        if (squared.data()[g])
            for (double* v : {l.mean, l.quantile_lo, l.quantile_hi}) v[g] *= v[g];
    found["told_pull"] = fresh({groups}, &l.told_pull);
    found["told_precision"] = fresh({groups, groups}, &l.told_precision);
    found["told_power"] = fresh({groups}, &l.told_power);
    found["edge_x"] = fresh({stages, n}, &l.edge_x);
    found["edge_P"] = fresh({stages, n, n}, &l.edge_P);
    double found_rate = 0.0, effective = 0.0;
    l.found_rate = &found_rate;
    l.effective = &effective;
    double log_evidence = 0.0, log_prior = 0.0, log_mode = 0.0, residual = 0.0;
    std::int32_t used = 0;
    long sweeps = 0;
    l.log_evidence = &log_evidence;
    l.log_prior = &log_prior;
    l.log_mode = &log_mode;
    l.residual = &residual;
    l.used = &used;
    l.sweeps_used = &sweeps;
    int code;
    {
        nb::gil_scoped_release release;
        l.base = a;
        Work work(HW_PICK_WIDE(ep_learn_workspace)(l));
        l.base.work = work.p;
        code = HW_PICK_WIDE(ep_learn)(l);
    }
    found["code"] = code;
    found["effective"] = effective;
    found["since"] = since;
    found["finite"] = sound;
    found["rate"] = nb::none();
    if (learn_eps) found["rate"] = found_rate;
    found["log_evidence"] = log_evidence;
    found["log_prior"] = log_prior;
    found["log_mode"] = log_mode;
    found["residual"] = residual;
    found["nodes"] = used;
    found["sweeps"] = sweeps;
    return found;
}

nb::tuple known(InBool free, In start, In pull, In precision, In power) {
    const std::size_t p = free.size();
    want(start.size() == p && pull.size() == p && precision.size() == p * p && power.size() == p,
         "start, pull, power (p,), precision (p,p)");
    double *h = nullptr, *H = nullptr, *g = nullptr;
    nb::object found_h = fresh({p}, &h), found_H = fresh({p, p}, &H), found_g = fresh({p}, &g);
    Work work(5 * p * (p + 1));
    HW_PICK_WIDE(ep_known_part)(static_cast<int>(p), free.data(), start.data(), pull.data(), precision.data(), power.data(), h, H, g, work.p);
    return nb::make_tuple(found_h, found_H, found_g);
}

}  // namespace

void bind_ep(nb::module_& mod) {
    mod.def("ep_run", &run, "problem"_a, "s"_a, "eps"_a, "sweeps"_a, "tol"_a, "damping"_a, "sites"_a.none(),
            "Expectation propagation on a chain for given half-widths, one set a member; see core/ep_entry.hpp.");
    mod.def("ep_known", &known, "free"_a, "start"_a, "pull"_a, "precision"_a, "power"_a,
            "What is known of the free half-widths alone, whatever the others are; see core/ep_handover.hpp.");
    mod.def("ep_learn", &learn, "problem"_a, "free"_a, "floor"_a, "cap"_a, "scale"_a, "start"_a, "count"_a,
            "squared"_a, "learn_eps"_a,
            "rate"_a, "start_eps"_a, "power"_a, "beta_a"_a, "beta_b"_a, "z"_a, "limits"_a,
            "before"_a.none() = nb::none(), "drop"_a = 0, "shaped"_a = 0, "pull"_a.none() = nb::none(), "precision"_a.none() = nb::none(),
            "known_power"_a.none() = nb::none(), "outside"_a.none() = nb::none(),
            "The same with half-widths found by evidence and what is not known of them carried into the answer.");
}
