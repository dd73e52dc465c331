// Python's door to core/ep.cpp: gathers the arrays of a problem, releases the GIL, holds no logic.
#include "bind_ep_problem.hpp"

namespace {

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
}
