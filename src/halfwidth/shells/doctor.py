"""What is installed and whether it works: versions, the core's build, the solvers on a known problem."""

import importlib
import importlib.metadata
import platform
from collections.abc import Mapping
from typing import Any

#: Libraries by distribution, and whether the package cannot do without.
_LIBRARIES = {
    "numpy": True,
    "scipy": True,
    "narwhals": True,
    "highspy": True,
    "piqp": True,
    "typer": False,
    "pyarrow": False,
    "pandas": False,
    "polars": False,
    "matplotlib": False,
    "pymap3d": False,
    "clarabel": False,
}


def examine() -> dict[str, Any]:
    """Look at everything.

    Returns
    -------
    dict
        Plain data: ``good`` is whether all that is needed is there and works.
    """
    from halfwidth import __version__

    libraries = {name: _version(name) or "not installed" for name in _LIBRARIES}
    tests = {"core": _core_test(), "highs": _highs_test(), "piqp": _piqp_test()}
    lacking = [name for name, needed in _LIBRARIES.items() if needed and libraries[name] == "not installed"]
    good = not lacking and all(verdict == "good" for verdict in tests.values())
    parquet = "yes" if _version("pyarrow") else "no (pip install 'halfwidth[formats]')"
    return {
        "version": __version__,
        "good": good,
        "platform": {"python": platform.python_version(), "system": platform.system(), "machine": platform.machine()},
        "core": _core(),
        "libraries": libraries,
        "self_test": tests,
        "readers": {"csv": "yes", "csv.gz": "yes", "parquet": parquet},
    }


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _core() -> dict[str, str]:
    try:
        from halfwidth import _core
    except ImportError as error:
        return {"built": f"no ({error})"}
    return {"built": "yes", "instructions": str(_core.isa())}


def _core_test() -> str:
    """Filter a random walk whose answer is known: prior 0 +- 1, noise 1 and 1, one output of 3."""
    try:
        import numpy as np

        import halfwidth as hw

        walk = hw.Linear([[1]], None, [[1]], hw.Gaussian(1.0), hw.Gaussian(1.0), hw.Normal([0.0], 1.0))
        found = float(hw.estimate(walk, hw.Record(np.zeros(1), np.full(1, 3.0))).x[0, 0])
    except Exception as error:
        return f"failed ({type(error).__name__}: {error})"
    return "good" if abs(found - 2.0) < 1e-9 else f"wrong (2 is right, {found!r} came out)"


def _highs_test() -> str:
    """Minimise -x - 2y over x + y <= 4, x + 3y <= 6 and x, y >= 0: -5 at (3, 1)."""
    try:
        import numpy as np
        from scipy.optimize import linprog

        found = linprog([-1, -2], A_ub=np.array([[1, 1], [1, 3]]), b_ub=[4, 6], method="highs").fun
    except Exception as error:
        return f"failed ({type(error).__name__}: {error})"
    return "good" if abs(found + 5) < 1e-7 else f"wrong (-5 is right, {found!r} came out)"


def _piqp_test() -> str:
    """Minimise x^2 + y^2 subject to x + y = 1: (1/2, 1/2)."""
    try:
        import numpy as np
        import piqp

        solver = piqp.DenseSolver()
        solver.setup(P=2 * np.eye(2), c=np.zeros(2), A=np.ones((1, 2)), b=np.ones(1))
        solver.solve()
        found = np.asarray(solver.result.x)
    except Exception as error:
        return f"failed ({type(error).__name__}: {error})"
    return "good" if np.abs(found - 0.5).max() < 1e-6 else f"wrong (0.5 is right, {found!r} came out)"


def text(found: Mapping[str, Any]) -> str:
    """Lay out what `examine` found."""
    lines = [f"halfwidth {found['version']}: {'all good' if found['good'] else 'something is wrong'}", ""]
    for title in ("platform", "core", "libraries", "self_test", "readers"):
        lines.append(title.replace("_", " "))
        lines += [f"  {name:<14}{value}" for name, value in found[title].items()]
    return "\n".join(lines) + "\n"
