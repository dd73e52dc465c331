"""Stock solvers of sparse programs: one adapter a library, from a program to a claim that `lp.py` judges."""

from typing import Any

import numpy as np

from halfwidth.solvers.program import TINY, TOLERANCE, Claim, Program, Solver, Verdict


def _piqp(program: Program) -> Claim:
    """Interior point with proximal multipliers: fast on sparse programs, LP and QP alike."""
    import piqp
    import scipy.sparse as sp

    m, n = program.G.shape
    # Fixed variables leave an interior point no interior: they are substituted.
    fixed = program.lo == program.hi
    keep = np.flatnonzero(~fixed)
    base = np.where(fixed, program.lo, 0.0)
    shift = program.G @ base
    lo, hi = program.row_lo - shift, program.row_hi - shift
    equal = program.row_lo == program.row_hi
    rows = np.flatnonzero((np.isfinite(lo) | np.isfinite(hi)) & ~equal)
    equations = np.flatnonzero(equal)
    G = program.G[:, keep] if keep.size < n else program.G
    P = sp.csc_matrix((keep.size, keep.size))
    c = program.c[keep]
    if program.P is not None:
        c = c + (program.P @ base)[keep]
        P = sp.csc_matrix(program.P[keep][:, keep])

    solver = piqp.SparseSolver()
    solver.settings.eps_abs = 1e-10
    solver.settings.eps_rel = 1e-10
    solver.settings.eps_duality_gap_abs = 1e-2 * TOLERANCE * max(TINY, program.floor)
    solver.settings.eps_duality_gap_rel = 1e-10 if program.P is None else 1e-12
    solver.setup(
        P,
        c,
        sp.csc_matrix(G[equations]) if equations.size else None,
        lo[equations] if equations.size else None,
        sp.csc_matrix(G[rows]) if rows.size else None,
        lo[rows] if rows.size else None,
        hi[rows] if rows.size else None,
        program.lo[keep],
        program.hi[keep],
    )
    status = solver.solve()
    answer = solver.result
    x, z = base.copy(), np.zeros(m)
    x[keep] = answer.x
    if rows.size:
        z[rows] = answer.z_l - answer.z_u
    if equations.size:
        z[equations] = -answer.y
    verdict = {
        piqp.PIQP_SOLVED: Verdict.OPTIMAL,
        piqp.PIQP_PRIMAL_INFEASIBLE: Verdict.INFEASIBLE,
        piqp.PIQP_DUAL_INFEASIBLE: Verdict.UNBOUNDED,
    }.get(status, Verdict.FAILED)
    return Claim(verdict, x, z, np.where(fixed, 0.0, x), int(answer.info.iter))


def highs(*, solver: str = "choose", time_limit: float = 120.0) -> Solver:
    """Return HiGHS as a solver, the reference: slower than PIQP, with vertices and proofs.

    Parameters
    ----------
    solver : {"choose", "simplex", "ipm"}
    time_limit : float
        Seconds after which it gives up.
    """

    def run(program: Program) -> Claim:
        import highspy

        kind = highspy.HighsModelStatus
        engine: Any = highspy.Highs()  # type: ignore[no-untyped-call]
        for option, value in (
            ("output_flag", False),
            ("presolve", "off"),  # it prints on stdout, and decides without a proof
            ("solver", solver),
            ("threads", 1),
            ("time_limit", float(time_limit)),
            ("primal_feasibility_tolerance", 1e-9),
            ("dual_feasibility_tolerance", 1e-9),
            ("qp_regularization_value", 1e-10),
        ):
            engine.setOptionValue(option, value)
        engine.passModel(_highs_model(program))
        engine.run()
        status = engine.getModelStatus()
        unproved = (kind.kInfeasible, kind.kUnbounded, kind.kUnboundedOrInfeasible)
        if status in unproved and program.P is None:
            # Presolve decides without a proof; the simplex method alone ends with one.
            engine.setOptionValue("presolve", "off")
            engine.setOptionValue("solver", "simplex")
            engine.clearSolver()
            engine.run()
            status = engine.getModelStatus()
        info = engine.getInfo()
        count = max(0, info.simplex_iteration_count, info.ipm_iteration_count, info.qp_iteration_count)
        if status == kind.kInfeasible:
            _, there, ray = engine.getDualRay()
            return Claim(Verdict.INFEASIBLE, z=np.array(ray) if there else None, iterations=count)
        if status == kind.kUnbounded:
            _, there, ray = engine.getPrimalRay()
            return Claim(Verdict.UNBOUNDED, ray=np.array(ray) if there else None, iterations=count)
        answer = engine.getSolution()
        good = status in (kind.kOptimal, kind.kModelEmpty)
        return Claim(
            Verdict.OPTIMAL if good else Verdict.FAILED,
            np.array(answer.col_value),
            np.array(answer.row_dual),
            iterations=count,
        )

    return Solver("highs", run)


def _highs_model(program: Program) -> Any:
    import highspy
    import scipy.sparse as sp

    m, n = program.G.shape
    model, lp = highspy.HighsModel(), highspy.HighsLp()
    lp.num_col_, lp.num_row_ = n, m
    lp.col_cost_ = program.c
    lp.col_lower_, lp.col_upper_ = program.lo, program.hi
    lp.row_lower_, lp.row_upper_ = program.row_lo, program.row_hi
    lp.a_matrix_.format_ = highspy.MatrixFormat.kRowwise
    lp.a_matrix_.num_col_, lp.a_matrix_.num_row_ = n, m
    lp.a_matrix_.start_ = program.G.indptr.astype(np.int32)
    lp.a_matrix_.index_ = program.G.indices.astype(np.int32)
    lp.a_matrix_.value_ = program.G.data
    model.lp_ = lp
    if program.P is not None:
        lower = sp.csc_array(sp.tril(program.P))
        lower.sort_indices()
        model.hessian_.dim_ = n
        model.hessian_.format_ = highspy.HessianFormat.kTriangular
        model.hessian_.start_ = lower.indptr.astype(np.int32)
        model.hessian_.index_ = lower.indices.astype(np.int32)
        model.hessian_.value_ = lower.data
    return model


PIQP = Solver("piqp", _piqp)
HIGHS = highs()
