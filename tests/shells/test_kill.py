"""`kill -9` at fifty instants of `fill`: the old file or the new one, never part of one."""

import json
import subprocess
import sys

from tests.vehicle.drives import drive, save

#: Loads everything once, then lets a child fill and kills it after a while; many times.
SCRIPT = """
import json, os, signal, sys, time

log, out, page, count = sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4])

from halfwidth.shells import cli


def fill():
    args = ["fill", log, "-o", out, "--report", page, "--force", "--quiet", "--method", "linear"]
    sys.argv = ["halfwidth", *args]
    return cli.run(args)


def content():
    return [open(path, "rb").read() for path in (out, page)]


def child():
    pid = os.fork()
    if pid == 0:
        os._exit(fill())
    return pid


assert fill() == 0  # everything is loaded now
fresh = content()
assert fill() == 0
assert content() == fresh  # the same run gives the same bytes

started = time.perf_counter()
for _ in range(3):
    assert os.waitstatus_to_exitcode(os.waitpid(child(), 0)[1]) == 0
length = (time.perf_counter() - started) / 3

old = [b"old track", b"old report"]
seen = {"killed": 0, "old": 0, "new": 0, "mixed": 0, "part": 0, "litter": 0}
folder = os.path.dirname(out)
tries = 0
while seen["killed"] < count and tries < 10 * count:
    tries += 1
    for path, words in zip((out, page), old):
        with open(path, "wb") as file:
            file.write(words)
    # odd instants go over the whole run, even ones over its end, where files are written
    share = (tries % 17) / 17
    pid = child()
    time.sleep(length * (share if tries % 2 else 0.6 + 0.4 * share))
    os.kill(pid, signal.SIGKILL)
    if os.waitpid(pid, 0)[1] != signal.SIGKILL:
        continue  # it was done before
    seen["killed"] += 1
    found = content()
    for one, before, after in zip(found, old, fresh):
        seen["part"] += one not in (before, after)
    kinds = {"old" if one == before else "new" for one, before in zip(found, old)}
    seen["mixed" if len(kinds) > 1 else kinds.pop()] += 1
    left = set(os.listdir(folder)) - {os.path.basename(path) for path in (log, out, page)}
    seen["litter"] += len(left)
    # what is left cannot be taken for an output, whatever is looked for by name
    assert all(name.startswith(".") and name.endswith(".tmp") for name in left), left
# the next run clears away what killed ones left, as does its own process: a new one sees a new folder
pid = os.fork()
if pid == 0:
    from halfwidth import store

    store._sweep.cache_clear()
    os._exit(fill())
assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
seen["after"] = sorted(os.listdir(folder))
seen["good"] = content() == fresh
seen["length"] = length
print(json.dumps(seen))
"""


def test_fifty_kills_leave_whole_files(tmp_path):
    log = save(tmp_path / "log.csv", drive(800, every=2) | {"t_s": drive(800)["t_s"]})
    found = subprocess.run(
        [sys.executable, "-c", SCRIPT, log, str(tmp_path / "out.gpx"), str(tmp_path / "out.html"), "50"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    seen = json.loads(found.stdout)
    assert seen["part"] == 0
    assert seen["killed"] == seen["old"] + seen["new"] + seen["mixed"] == 50
    assert seen["after"] == ["log.csv", "out.gpx", "out.html"]
    assert seen["good"]
