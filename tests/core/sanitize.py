"""Build the core under the address and undefined-behaviour sanitizers and run its tests with it.

    python tests/core/sanitize.py [arguments of pytest]

The build goes to build/sanitize; the package beside it is the sources by links with the sanitized core among them. The
exit code is that of the tests; any report of a sanitizer fails them.
"""

import importlib.util
import os
import pathlib
import shutil
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parents[2]
BUILD = ROOT / "build" / "sanitize"
PACKAGE = BUILD / "package" / "halfwidth"
NEEDED = {
    "nanobind": "nanobind",
    "numpy": "numpy",
    "scipy": "scipy",
    "pytest": "pytest",
    "pytest_timeout": "pytest-timeout",
}
NEEDED |= {"hypothesis": "hypothesis"}


def tool(name):
    """Return a program from beside this Python or from the path."""
    beside = pathlib.Path(sys.executable).parent / name
    return str(beside) if beside.exists() else shutil.which(name)


def install():
    """Install what is missing to build and test."""
    missing = [package for module, package in NEEDED.items() if importlib.util.find_spec(module) is None]
    missing += [name for name in ("cmake", "ninja") if tool(name) is None]
    if missing:
        subprocess.run([sys.executable, "-m", "pip", "install", "--quiet", *missing], check=True)


def build():
    PACKAGE.mkdir(parents=True, exist_ok=True)
    for old in PACKAGE.iterdir():
        if old.is_symlink():
            old.unlink()
    for source in (ROOT / "src" / "halfwidth").iterdir():
        if not source.name.startswith(("_core", "__pycache__")):
            (PACKAGE / source.name).symlink_to(source)
    configure = [
        tool("cmake"),
        *("-S", str(ROOT), "-B", str(BUILD), "-G", "Ninja", f"-DCMAKE_MAKE_PROGRAM={tool('ninja')}"),
        *("-DHALFWIDTH_SANITIZE=ON", "-DCMAKE_BUILD_TYPE=Release"),
        *(f"-DPython_EXECUTABLE={sys.executable}", f"-DCMAKE_LIBRARY_OUTPUT_DIRECTORY={PACKAGE}"),
    ]
    subprocess.run(configure, check=True, stdout=subprocess.DEVNULL)
    subprocess.run([tool("cmake"), "--build", str(BUILD)], check=True)


def runtime(name):
    found = subprocess.run(["g++", f"-print-file-name={name}"], check=True, capture_output=True, text=True)
    return found.stdout.strip()


def test(arguments):
    env = os.environ | {
        # the sanitizer's own allocator must come first; libstdc++ with it, so that exceptions are seen
        "LD_PRELOAD": f"{runtime('libasan.so')} {runtime('libstdc++.so')}",
        "ASAN_OPTIONS": "detect_leaks=0",  # the interpreter itself never frees everything
        "UBSAN_OPTIONS": "print_stacktrace=1:halt_on_error=1",
        "PYTHONMALLOC": "malloc",
        "PYTHONPATH": str(BUILD / "package"),
    }
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", *(arguments or ["tests/core"])]
    return subprocess.run(command, cwd=ROOT, env=env).returncode


if __name__ == "__main__":
    install()
    build()
    sys.exit(test(sys.argv[1:]))
